"""The thesis's search (Eq. 44), row by row and as one array: the baselines against which the others are measured."""

from collections.abc import Callable

import torch

from tormagd.inverse.nearest import field_grid
from tormagd.inverse.solution import FieldSolution, Reach, answer, checked_near_mT
from tormagd.model.features import FEATURES, FIELD, require_number
from tormagd.model.force_curve import ForceCurve
from tormagd.model.model_file import ForceModel
from tormagd.model.network import to_network
from tormagd.physics.errors import DomainError

THESIS_EPSILON_N = 1.26
"""Radius of the neighbourhood in the thesis: the mean error of its network."""

TIE = 64
"""Units of rounding within which the force of the nearest row counts as the force asked."""


class LinearFieldSearch:
    """Try the fields of a grid from the least upwards and stop at |F - NN| <= epsilon.

    With `epsilon_N` = 0 it sees every row and answers with the nearest. It knows no continuity: the last field is
    checked and not used. `predict_one` is how one row is evaluated: by the curve itself by default, `torch_row(model)`
    as the thesis did it. Raises `DomainError` on parameters it cannot use.
    """

    def __init__(
        self,
        *,
        field_range_mT: tuple[float, float],
        step_mT: float = 1.0,
        epsilon_N: float = THESIS_EPSILON_N,
        predict_one: Callable[[float, float, float, float], float] | None = None,
    ) -> None:
        require_number("epsilon_N", epsilon_N)
        if epsilon_N < 0:
            raise DomainError("epsilon_N", epsilon_N, "0 N or more")
        self._fields_mT: list[float] = field_grid(field_range_mT, step_mT).tolist()
        self._epsilon_N = epsilon_N
        self._predict_one = predict_one

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`; a force within epsilon of what some field gives counts as inside."""
        checked_near_mT(force_N, last_field_mT, self._fields_mT[0])

        best_mT, best_N, above, below, rows = self._fields_mT[0], 0.0, False, False, 0
        best_error_N = float("inf")
        for field_mT in self._fields_mT:
            predicted_N = self._force_N(curve, field_mT)
            rows += 1
            error_N = abs(force_N - predicted_N)
            if error_N < best_error_N:
                best_mT, best_N, best_error_N = field_mT, predicted_N, error_N
            if error_N <= self._epsilon_N:
                break
            above |= predicted_N > force_N
            below |= predicted_N < force_N

        if best_error_N <= self._epsilon_N or (above and below):
            reach = Reach.INSIDE
        else:
            reach = Reach.BELOW if above else Reach.ABOVE
        return answer(curve, best_mT, force_N, best_N, rows, reach)

    def _force_N(self, curve: ForceCurve, field_mT: float) -> float:
        if self._predict_one is None:
            return curve.force_N(field_mT)
        return self._predict_one(curve.displacement_mm, curve.rate_mm_s, field_mT, curve.cip_percent)


def torch_row(model: ForceModel, dtype: torch.dtype = torch.float64) -> Callable[[float, float, float, float], float]:
    """Return the forward pass of `model` in torch, one row at a time: what the thesis's loop calls."""
    network = to_network(model).to(dtype)

    def predict_one(displacement_mm: float, rate_mm_s: float, field_mT: float, cip_percent: float) -> float:
        with torch.inference_mode():
            row = torch.tensor(((displacement_mm, rate_mm_s, field_mT, cip_percent),), dtype=dtype)
            return float(network(row))

    return predict_one


class GridArgmin:
    """The same search as one array: the whole network on every field of the grid, then the row nearest in force.

    It knows no continuity and does not interpolate: the last field is checked and not used, the answer is a grid point.
    Raises `DomainError` on parameters it cannot use.
    """

    def __init__(
        self,
        model: ForceModel,
        *,
        field_range_mT: tuple[float, float],
        step_mT: float = 1.0,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        fields_mT = field_grid(field_range_mT, step_mT)
        self._network = to_network(model).to(dtype)
        self._rows = torch.zeros((len(fields_mT), len(FEATURES)), dtype=dtype)
        self._rows[:, FIELD] = torch.from_numpy(fields_mT)
        self._others = torch.tensor([column for column in range(len(FEATURES)) if column != FIELD])
        self._fields_mT: list[float] = fields_mT.tolist()

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`."""
        checked_near_mT(force_N, last_field_mT, self._fields_mT[0])

        with torch.inference_mode():
            given = torch.tensor((curve.displacement_mm, curve.rate_mm_s, curve.cip_percent), dtype=self._rows.dtype)
            self._rows[:, self._others] = given
            excess = self._network(self._rows) - force_N
            best = int(excess.abs().argmin())
            least_N, most_N = (float(end) for end in torch.aminmax(excess))
        field_mT = self._fields_mT[best]
        predicted_N = curve.force_N(field_mT)
        tie_N = TIE * torch.finfo(self._rows.dtype).eps * (abs(force_N) + abs(predicted_N))
        reach = Reach.ABOVE if most_N < -tie_N else Reach.BELOW if least_N > tie_N else Reach.INSIDE
        return answer(curve, field_mT, force_N, predicted_N, 1, reach)
