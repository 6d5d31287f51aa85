"""The torque element: from the magnets' gap and the handle's motion to the friction force at the roller.

The chain is richer than any model the controller uses: field with hysteresis, elastomer, relaxation, temperature,
pre-sliding friction with a Stribeck level.
"""

import math
from collections.abc import Callable

import numpy as np

from tormagd.physics.errors import FloatArray
from tormagd.physics.field import PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.physics.friction import Friction
from tormagd.physics.relaxation import PronySeries
from tormagd.simulation.parameters import PlantParameters

GRID_MM = 2e-3
MOMENT_POINTS = 20_000
SMALLEST_GAP_MM = 45.0
JOIN_MM = 10.0
"""Width over which Eq. 7 goes over into the power law beyond 95 mm."""


class Curve:
    """A function tabulated on a uniform grid, linear between points; plain floats, because numpy scalars are slow."""

    __slots__ = ("_last", "_per_unit", "_start", "_values")

    def __init__(
        self,
        function: Callable[[FloatArray], FloatArray],
        start: float,
        end: float,
        points: int,
    ) -> None:
        self._start = start
        self._per_unit = (points - 1) / (end - start)
        self._last = points - 2
        self._values: list[float] = function(np.linspace(start, end, points)).tolist()

    def at(self, x: float) -> float:
        """Value at x; the outermost pieces continue beyond the ends."""
        place = (x - self._start) * self._per_unit
        index = int(place)
        if index < 0:
            index = 0
        elif index > self._last:
            index = self._last
        values = self._values
        low = values[index]
        return low + (values[index + 1] - low) * (place - index)

    @classmethod
    def over_gap(cls, function: Callable[[FloatArray], FloatArray], plant: PlantParameters) -> "Curve":
        """Tabulate over every gap the device can reach."""
        start, end = 2.0 * plant.closed_stop_mm, 2.0 * plant.open_stop_mm
        return cls(function, start, end, math.ceil((end - start) / GRID_MM) + 1)


def radial_moment_Tm(gap_mm: FloatArray, plant: PlantParameters) -> FloatArray:
    """The plant's field law on an array of gaps, T m, without its hysteresis."""
    power = PowerFieldLaw(plant.field.coefficient, plant.field.exponent).radial_moment_Tm(gap_mm)
    if plant.field.law == "power":
        return power
    thesis = ThesisFieldLaw()
    low_mm, high_mm = thesis.gap_range_mm
    # under 45 mm, in the half millimetre before the stops, Eq. 7 is continued along its tangent
    inside_mm = np.clip(gap_mm, low_mm, high_mm)
    tangent = thesis.d_radial_moment_d_gap(low_mm) * np.minimum(gap_mm - low_mm, 0.0)
    share = np.clip((gap_mm - high_mm) / JOIN_MM, 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    joined: FloatArray = (1.0 - share) * (thesis.radial_moment_Tm(inside_mm) + tangent) + share * power
    return joined


class Element:
    """State of the element: the field's branch, the elastomer's memory, the bristles, the temperature.

    Advances in equal steps of `dt_s`. `force_N` is the rendered force, the friction at the roller surface as a torque
    sensor feels it: positive resists positive motion, negative resists negative motion, and just after a reversal the
    bristles still point the old way. `kinetic_N`, never negative, is the level it slides at. Raises
    tormagd.physics.errors.DomainError when the parameters leave the force law's domain somewhere in the stroke.
    """

    def __init__(self, plant: PlantParameters, gap_mm: float, dt_s: float) -> None:
        self._dt_s = dt_s
        self._moment = Curve.over_gap(lambda gap: radial_moment_Tm(gap, plant), plant)
        largest_Tm = self._moment.at(SMALLEST_GAP_MM)
        self._branch_Tm = plant.field.hysteresis_percent / 100.0 * largest_Tm
        self._turn_Tm = plant.assumed.hysteresis_scale * largest_Tm
        elastomer = Elastomer(
            shear_modulus_Pa=plant.elastomer.shear_modulus_kPa * 1e3,
            relative_permeability=plant.elastomer.relative_permeability,
            friction_coefficient=plant.elastomer.kinetic_friction,
        )
        weakest_Tm = self._moment.at(2.0 * plant.open_stop_mm) - self._branch_Tm
        strongest_Tm = self._moment.at(2.0 * plant.closed_stop_mm) + self._branch_Tm
        self._force = Curve(
            lambda moment: brake_force_N(moment, elastomer, TORMAG), weakest_Tm, strongest_Tm, MOMENT_POINTS
        )
        friction = plant.friction
        self._friction = Friction(
            presliding_stiffness_N_mm=friction.presliding_stiffness_N_mm,
            viscous_N_s_mm=friction.viscous_N_s_mm,
            static_ratio=friction.static_to_kinetic,
            stribeck_speed_mm_s=friction.stribeck_speed_mm_s,
        )
        self._force_per_K = plant.thermal.force_percent_K / 100.0
        self._ambient_C = plant.assumed.ambient_C
        self._warming_K = plant.assumed.warm_C - plant.assumed.ambient_C
        self._drift_K_s = plant.thermal.drift_K_h / 3600.0
        series = PronySeries(plant.relaxation.fractions, plant.relaxation.times_s)
        self._relax = series.discretise(dt_s)

        self.temperature_C = self._ambient_C
        self._moment_Tm = self._moment.at(gap_mm)
        self._lag_Tm = 0.0
        # the device has been standing at this gap for long before the power came
        self._memory = series.relaxed(self._force.at(self._moment_Tm))
        self._deflection_mm = 0.0
        self.force_N = 0.0
        self.kinetic_N, self._memory = self._relax.advance(self._memory, self._memory[0])

    def advance(self, time_s: float, gap_mm: float, speed_mm_s: float) -> None:
        """One step that ends at that time, at that gap, with the handle at that mean speed."""
        moment_Tm = self._moment.at(gap_mm)
        change_Tm = moment_Tm - self._moment_Tm
        if change_Tm != 0.0:
            # rate-independent: the lag moves along |change| towards the branch that change leads to
            branch_Tm = -self._branch_Tm if change_Tm > 0.0 else self._branch_Tm
            self._lag_Tm += (self._lag_Tm - branch_Tm) * math.expm1(-abs(change_Tm) / self._turn_Tm)
            self._moment_Tm = moment_Tm
        if self._warming_K > 0.0:
            self.temperature_C = self._ambient_C - self._warming_K * math.expm1(
                -self._drift_K_s * time_s / self._warming_K
            )
        warm = 1.0 + self._force_per_K * (self.temperature_C - self._ambient_C)
        driving_N = self._force.at(moment_Tm + self._lag_Tm) * warm
        relaxed_N, self._memory = self._relax.advance(self._memory, driving_N)
        # relaxing from a high force may pull the insert off the shaft, but never push the handle on
        self.kinetic_N = max(relaxed_N, 0.0)
        self.force_N, self._deflection_mm = self._friction.advance(
            self._deflection_mm, speed_mm_s, self.kinetic_N, self._dt_s
        )
