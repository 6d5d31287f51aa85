"""Coarse look, then refinement of the bracket nearest the last field: by a finer grid, or by Newton."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from tormagd.inverse.newton import ACCURACY_MT
from tormagd.inverse.scan import FINEST_MT, Bracket, FieldScan
from tormagd.inverse.solution import FieldSolution, answer
from tormagd.model.force_curve import ForceCurve

MOST_STEPS = 40
"""Bisection alone needs 20 from 1000 mT to `ACCURACY_MT`; twice that is for steps that alternate with it."""

FINE_INTERVALS = 16
"""Intervals of a finer grid: 20 mT become 1.25 mT, on which a straight line is 1e-3 mT from the network."""

Refinement: TypeAlias = Callable[[ForceCurve, Bracket, float], tuple[float, int]]
"""(curve, bracket, force_N) -> field in mT within the bracket, and how often the curve was evaluated."""


def newton(curve: ForceCurve, bracket: Bracket, force_N: float) -> tuple[float, int]:
    """Newton's steps on the exact slope; one that leaves the shrinking bracket is replaced by bisection."""
    left, right, left_N, _ = bracket
    field = bracket.crossing_mT
    for step in range(1, MOST_STEPS + 1):
        predicted_N, slope = curve.force_and_slope(field)
        excess_N = predicted_N - force_N
        if excess_N == 0:
            return field, step
        if (excess_N < 0) == (left_N < 0):
            left = field
        else:
            right = field
        # a slope of zero gives no direction: inf and NaN are not inside the bracket either
        following = field - excess_N / slope if slope else left - 1.0
        if not left <= following <= right:
            following = 0.5 * (left + right)
        if abs(following - field) <= ACCURACY_MT:
            return following, step
        field = following
    return field, MOST_STEPS


def finer_grid(curve: ForceCurve, bracket: Bracket, force_N: float) -> tuple[float, int]:
    """Finer grids inside the bracket, each evaluated at once, down to `FINEST_MT`; then a straight line across."""
    rises, evaluations = bracket.left_N < 0, 0
    while bracket.right_mT - bracket.left_mT > FINEST_MT:
        fields = np.linspace(bracket.left_mT, bracket.right_mT, FINE_INTERVALS + 1).tolist()
        excess = (curve.forces_N(np.array(fields)) - force_N).tolist()
        # the ends keep the signs that were seen before: rounding may see others
        excess[0], excess[-1] = bracket.left_N, bracket.right_N
        at = next(index for index, value in enumerate(excess) if (value < 0) != rises)
        bracket = Bracket(fields[at - 1], fields[at], excess[at - 1], excess[at])
        evaluations += 1
    return bracket.crossing_mT, evaluations


class BracketedSearch:
    """A look at every `step_mT`, then `refine` on the bracket whose root lies nearest the last field.

    Without a last field the lowest root wins, which is the opener gap. The answer is the curve's own root to
    `ACCURACY_MT` (`finer_grid`: to a straight line over 2 mT). Where nothing crosses, the force is out of reach,
    and the field that comes nearest is the answer. Raises `DomainError` on parameters it cannot use.
    """

    def __init__(self, *, field_range_mT: tuple[float, float], refine: Refinement, step_mT: float = 20.0) -> None:
        self._refine = refine
        self._scan = FieldScan(field_range_mT=field_range_mT, step_mT=step_mT)

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`."""
        look = self._scan.look(curve, force_N, last_field_mT)
        field_mT, iterations = look.candidate_mT, look.iterations
        for bracket in look.brackets:
            if field_mT is not None and abs(field_mT - look.near_mT) <= bracket.distance_mT(look.near_mT):
                break  # nothing in this bracket or a farther one can be nearer
            root_mT, evaluations = self._refine(curve, bracket, force_N)
            iterations += evaluations
            if field_mT is None or abs(root_mT - look.near_mT) < abs(field_mT - look.near_mT):
                field_mT = root_mT
        assert field_mT is not None, "a look shows a bracket or a candidate"
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), iterations + 1, look.reach)
