"""Devices and loads out to the extremes, and their values in 50 digits or more."""

import math
from typing import Any, NamedTuple

import mpmath as mp
import numpy as np

from tormagd.element.physics.errors import FloatArray
from tormagd.element.physics.field import REFERENCE_PERMEABILITY, FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.element.physics.force import Elastomer, Geometry, max_radial_moment_Tm

DIGITS = 65
"""50 are wanted, and differences over a step near the end of Eq. 7 lose the others."""

GRAIN = mp.mpf(10) ** -10


class Batch(NamedTuple):
    """Inputs x of one device: gaps (mm) through a field law, or radial moments (T m) if `field` is None."""

    elastomer: Elastomer
    geometry: Geometry
    field: FieldLaw | None
    x: FloatArray


class Reference(NamedTuple):
    """At one x in 50 digits: is lambda1 >= 0.05; the quantities' values and condition numbers."""

    admissible: bool
    stretch: float
    values: dict[str, Any]
    conditions: dict[str, float]


def draw_batch(rng: np.random.Generator, size: int) -> Batch:
    """Draw one device and `size` inputs; every required range is reached, its ends often."""

    def log_uniform(low: float, high: float) -> float:
        pick = rng.uniform(-0.1, 1.1)
        return float(low * (high / low) ** min(max(pick, 0.0), 1.0))

    inner_m = log_uniform(1e-3, 20e-3)
    geometry = Geometry(inner_m, inner_m + log_uniform(1e-4, 0.05), log_uniform(0.5e-3, 50e-3), 0.02)
    mu_r = min(max(float(rng.uniform(0.5, 10.5)), 1.0), 10.0)
    elastomer = Elastomer(log_uniform(1e3, 1e7), mu_r, log_uniform(0.05, 1.0))
    kind = rng.integers(4)
    share = rng.uniform(0.0, 1.0, size)
    if kind == 0:
        return Batch(elastomer, geometry, PowerFieldLaw(), 5.0 * 200.0**share)
    if kind == 1:
        near_the_end = 95.0 - 10.0 ** rng.uniform(-9.0, 1.0, size)
        return Batch(elastomer, geometry, ThesisFieldLaw(), np.where(share < 0.3, near_the_end, 45.0 + 50.0 * share))
    if kind == 2:
        field_T = np.where(share < 0.5, 3.0 * rng.uniform(0.0, 1.0, size), 3.0 * 10.0 ** rng.uniform(-9.0, 0.0, size))
        return Batch(elastomer, geometry, None, field_T / (mu_r / (REFERENCE_PERMEABILITY * inner_m)))
    # up to the edge of the domain, where the force is steepest, and a little beyond
    most_Tm = max_radial_moment_Tm(elastomer, geometry)
    to_the_edge = 1.0 - 10.0 ** rng.uniform(-12.0, 0.0, size)
    return Batch(elastomer, geometry, None, most_Tm * np.where(share < 0.9, to_the_edge, 1.0 + 0.1 * share))


def reference(batch: Batch, x: float) -> Reference:
    """Evaluate the thesis's formulas as printed."""
    with mp.workdps(DIGITS):
        # Eq. 7 bends at 95 mm, so a step is measured from there
        scale = min(mp.mpf(x), 95 - mp.mpf(x)) if isinstance(batch.field, ThesisFieldLaw) else mp.mpf(x)
        step = scale * GRAIN
        points = [_force(batch, mp.mpf(x) + place * step) for place in (-1, 0, 1)] if scale > 0 else []
        centre = points[1] if points else _force(batch, mp.mpf(x))
        if centre is None or None in points or not points:
            stretch = float(centre[0]) if centre is not None else -math.inf
            return Reference(False, stretch, {}, {})
        stretches, forces = zip(*points, strict=True)
        slope, curvature = _differences(forces, step)
        stretch_slope = _differences(stretches, step)[0]
        compression = 1 - stretches[1]
        values = {"stretch": stretches[1] - 1, "force": forces[1], "slope": slope}
        conditions = {
            "stretch": _ratio(x * stretch_slope, compression),
            "force": _ratio(x * slope, forces[1]),
            "slope": _ratio(x * curvature, slope),
        }
        return Reference(bool(stretches[1] >= mp.mpf("0.05")), float(stretches[1]), values, conditions)


def _moment(field: FieldLaw | None, x: Any) -> Any:
    if isinstance(field, PowerFieldLaw):
        return mp.mpf(field.coefficient) * x ** mp.mpf(field.exponent)
    if isinstance(field, ThesisFieldLaw):
        return (mp.mpf(1.206) * (95 - x) ** mp.mpf(1.867) + 1256) / 10**6
    return x


def _force(batch: Batch, x: Any) -> tuple[Any, Any] | None:
    """Return (lambda1, F), or None if lambda1 is not real and positive."""
    g0, mu_r = mp.mpf(batch.elastomer.shear_modulus_Pa), mp.mpf(batch.elastomer.relative_permeability)
    geometry = batch.geometry
    r_i, r_o, t = (mp.mpf(v) for v in (geometry.inner_radius_m, geometry.outer_radius_m, geometry.thickness_m))
    mu, a2 = 4 * mp.pi * mp.mpf(10) ** -7 * mu_r, (mu_r / 4 * _moment(batch.field, x)) ** 2
    d = 1 / r_i**2 - 1 / (r_i * r_o)
    gamma_1 = a2 / (r_o * r_i) / mu - t * a2 * (mu_r - 1) / (2 * mu) * d
    gamma_2 = -a2 / r_i**2 / mu - t * a2 * (mu_r - 1) / mu * d
    discriminant = (gamma_1 - 4 * g0) ** 2 - 8 * g0 * (gamma_1 + gamma_2)
    if discriminant < 0:
        return None
    stretch = (8 * g0 - gamma_1 - mp.sqrt(discriminant)) / (4 * g0)
    if not stretch > 0:
        return None
    friction, roller = mp.mpf(batch.elastomer.friction_coefficient), mp.mpf(geometry.roller_radius_m)
    xi = 2 * mp.pi * t * r_i**2 * friction / (roller * stretch)
    return stretch, xi * (g0 * (stretch**-4 - 1) + a2 / (r_i**2 * mu * stretch**2))


def _differences(values: Any, step: Any) -> tuple[Any, Any]:
    below, centre, above = values
    return (above - below) / (2 * step), (above - 2 * centre + below) / step**2


def _ratio(numerator: Any, denominator: Any) -> float:
    return float(abs(numerator / denominator)) if denominator != 0 else math.inf
