"""The search by default: the force at every field of a grid at once, the nearest of them, then interpolation."""

from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from tormagd.inverse.solution import FieldSolution, Reach, answer, checked_near_mT
from tormagd.learning.features import FEATURES, FIELD, require_number
from tormagd.learning.model_file import ForceModel
from tormagd.physics.errors import DomainError

MAX_GRID_POINTS = 100_000
Floats: TypeAlias = NDArray[np.floating]


def field_grid(field_range_mT: tuple[float, float], step_mT: float) -> NDArray[np.float64]:
    """Fields from least to greatest, evenly spaced by `step_mT` or a little less, both ends included.

    Raises `DomainError` on an empty or non-finite range, a step that is not positive, or more than 100,000 points.
    """
    low, high = field_range_mT
    require_number("field_range_mT", low)
    require_number("field_range_mT", high)
    if not low < high:
        raise DomainError("field_range_mT", field_range_mT, "a least field below the greatest")
    if not 0 < step_mT <= high - low or (high - low) / step_mT >= MAX_GRID_POINTS:
        allowed = f"above 0, at most the range ({high - low:g} mT), at most {MAX_GRID_POINTS} points"
        raise DomainError("step_mT", step_mT, allowed)
    return np.linspace(low, high, int(np.ceil((high - low) / step_mT)) + 1)


class NearestFieldSearch:
    """Nearest-neighbour search of the field (section 4.2.6 of the thesis), vectorised and continuous.

    The first layer is linear, so its part that depends on the field is computed once for the grid; a solve adds the
    rest, applies the sigmoid and the output layer, and has the force at every field. Candidates are

    - the root in every grid interval where predicted and asked force cross, by linear interpolation, so that the answer
      is not bound to the grid;
    - of the `neighbours` grid points nearest in force and the one nearest the last field, those as near as the best
      answer within the rounding of `dtype`: the plateaus and touching points that no crossing marks.

    The candidate nearest the last field wins; without a last field the lowest, which is the opener gap. Where nothing
    crosses, the force is out of reach, and the nearest end is the answer.

    Parameters: `field_range_mT` and `step_mT` make the grid; `dtype` is torch.float32 or torch.float64. The default is
    float64 every 2 mT, which takes the time of float32 every 1 mT and is ten times nearer the network's own root.
    Raises `DomainError` on parameters it cannot use. Sets torch to one thread for the whole process: a second thread
    costs more than it saves at this size, and disturbs the loop. An instance is not reentrant: it owns its work space.
    """

    def __init__(
        self,
        model: ForceModel,
        *,
        field_range_mT: tuple[float, float],
        step_mT: float = 2.0,
        neighbours: int = 8,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise DomainError("dtype", dtype, "torch.float32 or torch.float64")
        self._fields_mT = field_grid(field_range_mT, step_mT)
        points = len(self._fields_mT)
        if not 1 <= neighbours <= points:
            raise DomainError("neighbours", neighbours, f"1 to the number of grid points, {points}")
        torch.set_num_threads(1)
        self._model = model
        self._neighbours = neighbours
        self._per_mT = 1 / float(self._fields_mT[1] - self._fields_mT[0])
        weight, bias, output, constant = model.physical
        others = [column for column in range(len(FEATURES)) if column != FIELD]
        self._other_weight = np.ascontiguousarray(weight[:, others])
        self._bias = bias
        self._constant_N = constant
        self._field_half = torch.from_numpy(np.outer(self._fields_mT, weight[:, FIELD])).to(dtype)
        self._output = torch.from_numpy(output.copy()).to(dtype)
        self._other_half = torch.empty(len(bias), dtype=dtype)
        self._hidden = torch.empty_like(self._field_half)
        self._force = torch.empty(points, dtype=dtype)
        # the same memory, seen by numpy: its small operations cost less than torch's
        self._other_half_view: Floats = self._other_half.numpy()
        self._force_view: Floats = self._force.numpy()
        # sums of h terms, each wrong by a few units of rounding
        self._tie_N = 16 * torch.finfo(dtype).eps * (float(np.abs(output).sum()) + abs(constant))

    def solve(
        self,
        displacement_mm: float,
        rate_mm_s: float,
        force_N: float,
        cip_percent: float,
        last_field_mT: float | None,
    ) -> FieldSolution:
        """See `FieldSolver.solve`."""
        least_mT = float(self._fields_mT[0])
        near = checked_near_mT(displacement_mm, rate_mm_s, force_N, cip_percent, last_field_mT, least_mT)

        self._other_half_view[:] = self._other_weight.dot((displacement_mm, rate_mm_s, cip_percent)) + self._bias
        with torch.inference_mode():
            torch.add(self._field_half, self._other_half, out=self._hidden)
            torch.sigmoid(self._hidden, out=self._hidden)
            torch.mv(self._hidden, self._output, out=self._force)
        excess_N = self._force_view - self._force_view.dtype.type(force_N - self._constant_N)

        candidates, reach = self._candidates(excess_N, near)
        field_mT = float(candidates[np.abs(candidates - near).argmin()])
        features = displacement_mm, rate_mm_s, field_mT, cip_percent
        return answer(self._model, features, force_N, self._model.predict_one(*features), 2, reach)

    def _candidates(self, excess_N: Floats, near_mT: float) -> tuple[NDArray[np.float64], Reach]:
        """Fields in mT that fit equally well, and whether they fit, from the force above the one asked on the grid."""
        fields = self._fields_mT
        below = excess_N < 0
        left = np.flatnonzero(below[1:] != below[:-1])
        error_N = np.abs(excess_N)
        nearest = np.argpartition(error_N, self._neighbours - 1)[: self._neighbours]
        best_N = 0.0 if left.size else float(error_N[nearest].min())
        candidates = fields[nearest[error_N[nearest] <= best_N + self._tie_N]]
        # on a plateau of more points than `neighbours` it is chance which of them were taken
        here = min(max(round((near_mT - fields[0]) * self._per_mT), 0), len(fields) - 1)
        if error_N[here] <= best_N + self._tie_N:
            candidates = np.append(candidates, fields[here])
        if left.size:
            at, to = excess_N[left], excess_N[left + 1]
            roots = fields[left] + (fields[left + 1] - fields[left]) * (at / (at - to))
            return np.concatenate((roots, candidates)), Reach.INSIDE
        if best_N <= self._tie_N:
            return candidates, Reach.INSIDE
        return candidates, Reach.ABOVE if below[0] else Reach.BELOW
