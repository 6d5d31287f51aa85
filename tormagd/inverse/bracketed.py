"""Coarse look, then refinement of the bracket nearest the last field: by a finer grid, or by Newton."""

from bisect import bisect_left
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from tormagd.inverse.nearest import field_grid
from tormagd.inverse.newton import ACCURACY_MT
from tormagd.inverse.solution import FieldSolution, Reach, answer, checked_near_mT, tie_N
from tormagd.model.force_curve import ForceCurve

FINEST_MT = 2.0
"""Grids are refined until their step is this small: around the nearest point where nothing crosses, too."""

ZOOM_POINTS = 9

MOST_STEPS = 40
"""Bisection alone needs 20 from 1000 mT to `ACCURACY_MT`; twice that is for steps that alternate with it."""

FINE_INTERVALS = 16
"""Intervals of a finer grid: 20 mT become 1.25 mT, on which a straight line is 1e-3 mT from the network."""


class Bracket(NamedTuple):
    """Two fields between which the force crosses the one asked, and the force above it at each."""

    left_mT: float
    right_mT: float
    left_N: float
    right_N: float

    def distance_mT(self, field_mT: float) -> float:
        """How far a field lies outside."""
        return max(self.left_mT - field_mT, field_mT - self.right_mT, 0.0)

    @property
    def crossing_mT(self) -> float:
        """Where a straight line through both ends crosses."""
        return self.left_mT + (self.right_mT - self.left_mT) * (self.left_N / (self.left_N - self.right_N))


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
    and the field that comes nearest is the answer. A dip or a bump narrower than the step can go unseen, except where
    it decides over reach. Raises `DomainError` on parameters it cannot use.
    """

    def __init__(self, *, field_range_mT: tuple[float, float], refine: Refinement, step_mT: float = 20.0) -> None:
        self._refine = refine
        self._fields_mT = field_grid(field_range_mT, step_mT)
        self._list_mT: list[float] = self._fields_mT.tolist()

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`."""
        near = checked_near_mT(force_N, last_field_mT, self._list_mT[0])
        near = min(max(near, self._list_mT[0]), self._list_mT[-1])
        brackets, field_mT, reach, iterations = self._look(curve, force_N, near)
        for bracket in brackets:
            if field_mT is not None and abs(field_mT - near) <= bracket.distance_mT(near):
                break  # nothing in this bracket or a farther one can be nearer
            root_mT, evaluations = self._refine(curve, bracket, force_N)
            iterations += evaluations
            if field_mT is None or abs(root_mT - near) < abs(field_mT - near):
                field_mT = root_mT
        assert field_mT is not None, "a look shows a bracket or a candidate"
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), iterations + 1, reach)

    def _look(self, curve: ForceCurve, force_N: float, near: float) -> tuple[list[Bracket], float | None, Reach, int]:
        """Brackets to refine, the nearest to `near` first; a field that fits or comes nearest; whether the force is
        within reach, where a field comes nearest and nothing crosses; and the evaluations made."""
        fields = self._list_mT
        excess = [predicted_N - force_N for predicted_N in curve.forces_N(self._fields_mT).tolist()]
        place = bisect_left(fields, near)
        if fields[place] == near:
            here_N = excess[place]
        else:
            here_N = curve.force_N(near) - force_N
            # the last field is one of the points: a crossing beside it is seen, and a flat force does not move it
            fields = [*fields[:place], near, *fields[place:]]
            excess.insert(place, here_N)
        iterations, same_N = 2, tie_N(curve)
        while True:
            brackets = sorted(_brackets(fields, excess), key=lambda bracket: bracket.distance_mT(near))
            best_N = min(map(abs, excess))
            if brackets and best_N > same_N:
                return brackets, None, Reach.INSIDE, iterations
            tied = [field for field, error in zip(fields, excess, strict=True) if abs(error) <= best_N + same_N]
            nearest = min(tied, key=lambda field: abs(field - near))
            if best_N <= same_N:
                return brackets, nearest, Reach.INSIDE, iterations
            at = fields.index(nearest)
            low, high = fields[max(at - 1, 0)], fields[min(at + 1, len(fields) - 1)]
            if high - low <= 2 * FINEST_MT:
                reach = Reach.ABOVE if excess[at] < 0 else Reach.BELOW
                return [], near if abs(here_N) <= best_N + same_N else nearest, reach, iterations
            zoomed = np.linspace(low, high, ZOOM_POINTS)
            fields, iterations = zoomed.tolist(), iterations + 1
            excess = (curve.forces_N(zoomed) - force_N).tolist()


def _brackets(fields: list[float], excess: list[float]) -> list[Bracket]:
    return [
        Bracket(fields[left], fields[left + 1], at, excess[left + 1])
        for left, at in enumerate(excess[:-1])
        if (at < 0) != (excess[left + 1] < 0)
    ]
