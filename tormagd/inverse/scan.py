"""The coarse look that precedes a refinement: where along the field the learned force meets the force asked."""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

from tormagd.inverse.nearest import field_grid
from tormagd.inverse.solution import Reach, checked_near_mT, tie_N
from tormagd.model.force_curve import ForceCurve

FINEST_MT = 2.0
"""Grids are refined until their step is this small: around the nearest point where nothing crosses, too."""

ZOOM_POINTS = 9


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


class Look(NamedTuple):
    """What a look shows: brackets to refine, nearest first, and `candidate_mT`, a field that fits or comes nearest.

    `near_mT` is the field from which distance counts. Out of reach there are no brackets, but a candidate.
    """

    near_mT: float
    brackets: list[Bracket]
    candidate_mT: float | None
    reach: Reach
    iterations: int


class FieldScan:
    """Looks at the force on a coarse grid of fields (`step_mT`).

    A dip or a bump narrower than the grid's step can go unseen, except where it decides over reach. Raises
    `DomainError` on parameters it cannot use.
    """

    def __init__(self, *, field_range_mT: tuple[float, float], step_mT: float) -> None:
        self._fields_mT = field_grid(field_range_mT, step_mT)
        self._list_mT: list[float] = self._fields_mT.tolist()

    def look(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> Look:
        """Where the force is met, seen from the last field, or else from the least. `DomainError` on NaN."""
        least_mT = self._list_mT[0]
        near = checked_near_mT(force_N, last_field_mT, least_mT)
        near = min(max(near, least_mT), self._list_mT[-1])
        excess = [predicted_N - force_N for predicted_N in curve.forces_N(self._fields_mT).tolist()]
        fields = self._list_mT
        place = bisect_left(fields, near)
        if fields[place] == near:
            here_N = excess[place]
        else:
            here_N = curve.force_N(near) - force_N
            # the last field is one of the points: a crossing beside it is seen, and a flat force does not move it
            fields = [*fields[:place], near, *fields[place:]]
            excess.insert(place, here_N)
        return self._search(curve, near, here_N, fields, excess, force_N)

    def _search(
        self, curve: ForceCurve, near: float, here_N: float, fields: list[float], excess: list[float], force_N: float
    ) -> Look:
        iterations, same_N = 2, tie_N(curve)
        while True:
            brackets = _brackets(fields, excess)
            best_N = min(map(abs, excess))
            if brackets and best_N > same_N:
                brackets.sort(key=lambda bracket: bracket.distance_mT(near))
                return Look(near, brackets, None, Reach.INSIDE, iterations)
            tied = [field for field, error in zip(fields, excess, strict=True) if abs(error) <= best_N + same_N]
            nearest = min(tied, key=lambda field: abs(field - near))
            if best_N <= same_N:
                brackets.sort(key=lambda bracket: bracket.distance_mT(near))
                return Look(near, brackets, nearest, Reach.INSIDE, iterations)
            at, last = fields.index(nearest), len(fields) - 1
            low, high = fields[max(at - 1, 0)], fields[min(at + 1, last)]
            if high - low <= 2 * FINEST_MT:
                if abs(here_N) <= best_N + same_N:
                    nearest = near
                reach = Reach.ABOVE if excess[at] < 0 else Reach.BELOW
                return Look(near, [], nearest, reach, iterations)
            zoomed = np.linspace(low, high, ZOOM_POINTS)
            fields, iterations = zoomed.tolist(), iterations + 1
            excess = (curve.forces_N(zoomed) - force_N).tolist()


def _brackets(fields: list[float], excess: list[float]) -> list[Bracket]:
    return [
        Bracket(fields[left], fields[left + 1], at, excess[left + 1])
        for left, at in enumerate(excess[:-1])
        if (at < 0) != (excess[left + 1] < 0)
    ]
