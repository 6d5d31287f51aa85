"""Table 2.4: friction fitted to the measured force ranges of the inserts, and how far the force law then errs.

The table gives only *ranges*, F(45 mm) - F(95 mm), to which friction is proportional. So the coefficient of a matrix
with the least mean relative error is a weighted median, found exactly. The one further parameter is the exponent n of
the field's growth with permeability, b ~ (mu_r / 4)^n, 1 in the thesis.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tormag_lab.design.brake import CLOSED_MM, OPEN_MM
from tormagd.element.physics.field import REFERENCE_PERMEABILITY, FieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.element.physics.inserts import Insert, relative_permeability

MIN_EXPONENT, MAX_EXPONENT = 0.0, 3.0
_GRID = 61


class RangeFit(NamedTuple):
    """Friction coefficient by the matrix's Shore 00 hardness, and the permeability exponent."""

    field: FieldLaw
    friction: Mapping[int, float]
    exponent: float

    def range_N(self, insert: Insert) -> float:
        return self.friction[insert.shore_hardness] * frictionless_range_N(insert, self.field, self.exponent)

    def relative_error(self, insert: Insert) -> float:
        return abs(self.range_N(insert) / insert.force_range.measured_N - 1.0)


def frictionless_range_N(insert: Insert, field: FieldLaw, exponent: float = 1.0) -> float:
    """Return an insert's F(45 mm) - F(95 mm) for a friction coefficient of one."""
    mu_r = relative_permeability(insert.cip_fraction)
    elastomer = Elastomer(insert.shear_modulus_Pa, mu_r, friction_coefficient=1.0)
    # the force law takes b ~ (mu_r / 4) a, so another exponent is another moment
    scale: float = (mu_r / REFERENCE_PERMEABILITY) ** (exponent - 1.0)
    most_N = brake_force_N(scale * field.radial_moment_Tm(CLOSED_MM), elastomer, TORMAG)
    return most_N - brake_force_N(scale * field.radial_moment_Tm(OPEN_MM), elastomer, TORMAG)


def fit_friction(inserts: Sequence[Insert], field: FieldLaw, exponent: float = 1.0) -> RangeFit:
    """Fit each matrix's friction for the least mean relative error of range."""
    ratios: dict[int, list[float]] = {}
    for item in inserts:
        ratio = frictionless_range_N(item, field, exponent) / item.force_range.measured_N
        ratios.setdefault(item.shore_hardness, []).append(ratio)
    return RangeFit(field, {shore: _friction(values) for shore, values in ratios.items()}, exponent)


def fit_exponent(inserts: Sequence[Insert], field: FieldLaw) -> RangeFit:
    """Fit each matrix's friction and one permeability exponent, 0..3, to 1e-4."""
    # the mean error has many kinks, hence a grid, then finer grids about its best point
    low, high = MIN_EXPONENT, MAX_EXPONENT
    while True:
        exponents = np.linspace(low, high, _GRID)
        fits = [fit_friction(inserts, field, float(exponent)) for exponent in exponents]
        best = min(fits, key=lambda fit: mean_relative_error(fit, inserts))
        step = float(exponents[1] - exponents[0])
        if step < 1e-4:
            return best
        low, high = max(MIN_EXPONENT, best.exponent - step), min(MAX_EXPONENT, best.exponent + step)


def mean_relative_error(fit: RangeFit, inserts: Sequence[Insert]) -> float:
    return float(np.mean([fit.relative_error(item) for item in inserts]))


def leave_one_out(inserts: Sequence[Insert], field: FieldLaw, *, free_exponent: bool) -> dict[str, float]:
    """Return each insert's relative error under the fit to all the others, by name."""
    fit = fit_exponent if free_exponent else fit_friction
    return {
        left_out.name: fit([item for item in inserts if item is not left_out], field).relative_error(left_out)
        for left_out in inserts
    }


def _friction(ratios: list[float]) -> float:
    # the minimum of sum |mu r - 1| = sum r |mu - 1/r| is the median of 1/r, weighted by r
    ordered = sorted(ratios, reverse=True)
    reached = np.cumsum(ordered)
    return 1.0 / ordered[int(np.searchsorted(reached, 0.5 * reached[-1]))]
