"""The k-nearest search: the force at every field of a grid, the fields nearest in force, and one branch of them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tormagd.element.inverse.solution import FieldSolution, Reach, answer, checked_near_mT, tie_N
from tormagd.element.model.features import require_number
from tormagd.element.model.force_curve import Floats, ForceCurve
from tormagd.element.physics.errors import require_that

MAX_GRID_POINTS = 100_000

Batch = Callable[[ForceCurve], Floats]


def field_grid(field_range_mT: tuple[float, float], step_mT: float) -> NDArray[np.float64]:
    """Return evenly spaced fields with both ends included, at most `step_mT` apart."""
    low, high = field_range_mT
    require_number("field_range_mT", low)
    require_number("field_range_mT", high)
    require_that(low < high, "field_range_mT", field_range_mT, "a least field below the greatest")
    require_that(
        0 < step_mT <= high - low and (high - low) / step_mT <= MAX_GRID_POINTS - 1,
        "step_mT",
        step_mT,
        f"above 0, at most the range ({high - low:g} mT), at most {MAX_GRID_POINTS} points",
    )
    return np.linspace(low, high, int(np.ceil((high - low) / step_mT)) + 1)


class NearestFieldSearch:
    """Nearest-neighbour search of the field (section 4.2.6 of the thesis), vectorised and continuous."""

    def __init__(self, fields_mT: NDArray[np.float64], neighbours: int = 8, batch: Batch | None = None) -> None:
        self._fields_mT, self._batch = fields_mT, batch
        points = len(self._fields_mT)
        require_that(1 <= neighbours <= points, "neighbours", neighbours, f"1 to the number of grid points, {points}")
        self._neighbours = neighbours
        self._per_mT = 1 / float(self._fields_mT[1] - self._fields_mT[0])

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        near = checked_near_mT(force_N, last_field_mT, float(self._fields_mT[0]))
        forces_N = curve.forces_N(self._fields_mT) if self._batch is None else self._batch(curve)
        candidates, reach = self._candidates(forces_N - force_N, near, tie_N(curve))
        field_mT = float(candidates[np.abs(candidates - near).argmin()])
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), 2, reach)

    def _candidates(self, excess_N: Floats, near_mT: float, same_N: float) -> tuple[NDArray[np.float64], Reach]:
        """Return the fields that fit equally well, and whether the force is in reach."""
        fields = self._fields_mT
        below = excess_N < 0
        crosses = below[1:] != below[:-1]
        error_N = np.abs(excess_N)
        nearest = np.argpartition(error_N, self._neighbours - 1)[: self._neighbours]
        beside = np.concatenate((nearest[nearest > 0] - 1, nearest[nearest < len(crosses)]))
        left = beside[crosses[beside]]
        best_N = 0.0 if left.size else float(error_N[nearest].min())
        candidates = fields[nearest[error_N[nearest] <= best_N + same_N]]
        # on a plateau chance decides which points are candidates
        here = min(max(round((near_mT - fields[0]) * self._per_mT), 0), len(fields) - 1)
        if error_N[here] <= best_N + same_N:
            candidates = np.append(candidates, fields[here])
        if left.size:
            at, to = excess_N[left], excess_N[left + 1]
            roots = fields[left] + (fields[left + 1] - fields[left]) * (at / (at - to))
            return np.concatenate((roots, candidates)), Reach.INSIDE
        if best_N <= same_N or crosses.any():
            return candidates, Reach.INSIDE
        return candidates, Reach.ABOVE if below[0] else Reach.BELOW
