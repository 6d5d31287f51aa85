"""The plant's laws that know no time, from the gap to the field, the magnets' pull and the force of a fresh element.

They are formulas over arrays, evaluated once when a device is made; a tick reads them as a `Curve`.
"""

import math
from functools import lru_cache

import numpy as np

from tormagd.element.physics.errors import FloatArray, Real
from tormagd.element.physics.field import PowerFieldLaw, ThesisFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.element.physics.magnets import CuboidMagnet, attraction_N
from tormagd.simulation.curve import Curve
from tormagd.simulation.parameters import PlantParameters

GRID_MM = 2e-3
MOMENT_POINTS = 20_000
JOIN_MM = 10.0
"Over this width Eq. 7 goes over into the power law beyond 95 mm."


def radial_moment_Tm(gap_mm: FloatArray, plant: PlantParameters) -> FloatArray:
    """Return the radial moment at each gap (n), without hysteresis."""
    power = PowerFieldLaw(plant.field.coefficient, plant.field.exponent).radial_moment_Tm(gap_mm)
    if plant.field.law == "power":
        return power
    thesis = ThesisFieldLaw()
    low_mm, high_mm = thesis.gap_range_mm
    # in the half millimetre before the stops Eq. 7 is continued along its tangent
    inside_mm = np.clip(gap_mm, low_mm, high_mm)
    tangent = thesis.d_radial_moment_d_gap(low_mm) * np.minimum(gap_mm - low_mm, 0.0)
    share = np.clip((gap_mm - high_mm) / JOIN_MM, 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    joined: FloatArray = (1.0 - share) * (thesis.radial_moment_Tm(inside_mm) + tangent) + share * power
    return joined


def pull_of_magnets_N(gap_mm: Real, plant: PlantParameters) -> Real:
    """Return the attraction between the magnets: that in air times the factor for the iron shaft."""
    return plant.assumed.attraction_factor * attraction_N(gap_mm, _magnet(plant))


def moment_over_gap(plant: PlantParameters) -> Curve:
    ends_mm = _reached_mm(plant)
    return Curve(radial_moment_Tm(_gaps_mm(*ends_mm), plant).tolist(), *ends_mm)


def pull_over_gap(plant: PlantParameters) -> Curve:
    ends_mm = _reached_mm(plant)
    return Curve((plant.assumed.attraction_factor * _attraction_N(_magnet(plant), *ends_mm)).tolist(), *ends_mm)


def force_over_moment(plant: PlantParameters, weakest_Tm: float, strongest_Tm: float) -> Curve:
    """Return the fresh, cool insert's kinetic friction over the radial moment."""
    return Curve(_brake_force_N(plant.elastomer.law, weakest_Tm, strongest_Tm).tolist(), weakest_Tm, strongest_Tm)


def _magnet(plant: PlantParameters) -> CuboidMagnet:
    width_mm, depth_mm, thickness_mm = plant.magnets.size_mm
    return CuboidMagnet(width_mm * 1e-3, depth_mm * 1e-3, thickness_mm * 1e-3, plant.magnets.remanence_T)


def _reached_mm(plant: PlantParameters) -> tuple[float, float]:
    return 2.0 * plant.closed_stop_mm, 2.0 * plant.open_stop_mm


def _gaps_mm(start_mm: float, end_mm: float) -> FloatArray:
    return np.linspace(start_mm, end_mm, math.ceil((end_mm - start_mm) / GRID_MM) + 1)


# these two take most of the time to make a device, and many devices share them
@lru_cache(maxsize=8)
def _attraction_N(magnet: CuboidMagnet, start_mm: float, end_mm: float) -> FloatArray:
    return attraction_N(_gaps_mm(start_mm, end_mm), magnet)


@lru_cache(maxsize=8)
def _brake_force_N(elastomer: Elastomer, weakest_Tm: float, strongest_Tm: float) -> FloatArray:
    return brake_force_N(np.linspace(weakest_Tm, strongest_Tm, MOMENT_POINTS), elastomer, TORMAG)
