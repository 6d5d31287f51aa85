"""The k-nearest search: the force at every field of a grid, the fields nearest in force, and one branch of them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tormagd.inverse.solution import FieldSolution, Reach, answer, checked_near_mT, tie_N
from tormagd.model.features import require_number
from tormagd.model.force_curve import Floats, ForceCurve
from tormagd.physics.errors import require_that

MAX_GRID_POINTS = 100_000

Batch = Callable[[ForceCurve], Floats]
"Returns the force, N, at every field of a grid, for the state of the handle that a curve is for."


def field_grid(field_range_mT: tuple[float, float], step_mT: float) -> NDArray[np.float64]:
    """Return fields from least to greatest, mT, evenly spaced by `step_mT` or a little less, both ends included.

    `field_range_mT` is the least and the greatest field. Raises `DomainError` unless both are finite and the least is
    below the greatest. Also for a step that is NaN, not above 0, greater than the range, or makes more than
    MAX_GRID_POINTS.
    """
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
    """Nearest-neighbour search of the field (section 4.2.6 of the thesis), vectorised and continuous.

    The force is evaluated at every field of a grid at once. Candidates are the `neighbours` points of the grid that are
    nearest in force. Where predicted and asked force cross beside a candidate, the root takes its place, by linear
    interpolation: the answer is not bound to the grid. Without a crossing, candidates count that are as near as the
    best within rounding, and so does the point nearest the last field. That is so on plateaus, at touching points and
    at the ends of reach.

    The candidate nearest the last field wins; without a last field the lowest, which is the opener gap. Where the force
    rises with the field there is one root, and one neighbour finds it. Where it also falls there are several, each on a
    branch of its own. With too few neighbours all candidates may then lie on another branch than the last field's.

    `fields_mT` is an even grid, as `field_grid` makes it. `batch` gives the forces on the grid; None: the curve does.
    Raises `DomainError` unless `neighbours` is 1 to the number of grid points.
    """

    def __init__(self, fields_mT: NDArray[np.float64], neighbours: int = 8, batch: Batch | None = None) -> None:
        self._fields_mT, self._batch = fields_mT, batch
        points = len(self._fields_mT)
        require_that(1 <= neighbours <= points, "neighbours", neighbours, f"1 to the number of grid points, {points}")
        self._neighbours = neighbours
        self._per_mT = 1 / float(self._fields_mT[1] - self._fields_mT[0])

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """Return the field for `force_N`; of several the one nearest `last_field_mT`, or the least where that is None.

        A force out of reach gets the field of the grid that comes nearest; `reach` says so. A last field may lie out of
        range; the answer does not. The predicted force is the curve's there, also where a `batch` searched.
        `iterations` is 2. Keeps nothing from call to call. Raises `DomainError` for numbers that are not finite or too
        large.
        """
        near = checked_near_mT(force_N, last_field_mT, float(self._fields_mT[0]))
        forces_N = curve.forces_N(self._fields_mT) if self._batch is None else self._batch(curve)
        candidates, reach = self._candidates(forces_N - force_N, near, tie_N(curve))
        field_mT = float(candidates[np.abs(candidates - near).argmin()])
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), 2, reach)

    def _candidates(self, excess_N: Floats, near_mT: float, same_N: float) -> tuple[NDArray[np.float64], Reach]:
        """Return the fields that fit equally well, mT, and whether the force asked is in reach.

        `excess_N` is the predicted less the asked force at each grid point. Forces within `same_N` of each other are
        equal. Roots between grid points are among the fields; the grid point nearest `near_mT` is, where it fits as
        well. The fields come in no order, and may repeat; there is one at least.
        """
        fields = self._fields_mT
        below = excess_N < 0
        crosses = below[1:] != below[:-1]
        error_N = np.abs(excess_N)
        nearest = np.argpartition(error_N, self._neighbours - 1)[: self._neighbours]
        beside = np.concatenate((nearest[nearest > 0] - 1, nearest[nearest < len(crosses)]))
        left = beside[crosses[beside]]
        best_N = 0.0 if left.size else float(error_N[nearest].min())
        candidates = fields[nearest[error_N[nearest] <= best_N + same_N]]
        # on a plateau of more points than `neighbours` chance decides which are candidates
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
