"""The searches of the order: the network in torch on the CPU, as one batch over the grid, or row by row (Eq. 44)."""

import math
from collections.abc import Callable

import torch

from tormagd.element.inverse.nearest import Batch
from tormagd.element.inverse.solution import FieldSolution, Reach, answer, checked_near_mT
from tormagd.element.model.features import FEATURES, FIELD, require_number
from tormagd.element.model.force_curve import Floats, ForceCurve
from tormagd.element.model.model_file import ForceModel
from tormagd.element.model.network import to_network
from tormagd.element.physics.errors import require_that

torch.set_num_threads(1)  # a second thread costs more than it saves at these sizes


def batch(model: ForceModel, fields_mT: Floats) -> Batch:
    """Return a function from a curve to the model's forces at all `fields_mT`, in one pass."""
    network, rows = to_network(model), torch.zeros((len(fields_mT), len(FEATURES)), dtype=torch.float64)
    rows[:, FIELD] = torch.from_numpy(fields_mT)
    others = torch.tensor([column for column in range(len(FEATURES)) if column != FIELD])

    def forces_N(curve: ForceCurve) -> Floats:
        with torch.inference_mode():
            given = curve.displacement_mm, curve.rate_mm_s, curve.cip_percent
            rows[:, others] = torch.tensor(given, dtype=torch.float64)
            forces: Floats = network(rows).numpy()
        return forces

    return forces_N


def row(model: ForceModel) -> Callable[[ForceCurve, float], float]:
    network = to_network(model)

    def force_N(curve: ForceCurve, field_mT: float) -> float:
        with torch.inference_mode():
            inputs = (curve.displacement_mm, curve.rate_mm_s, field_mT, curve.cip_percent)
            return float(network(torch.tensor((inputs,), dtype=torch.float64)))

    return force_N


class RowByRow:
    """The thesis's search: one field of a grid after the other, until |F - NN| <= epsilon."""

    def __init__(self, fields_mT: Floats, epsilon_N: float, predict_N: Callable[[ForceCurve, float], float]) -> None:
        require_number("epsilon_N", epsilon_N)
        require_that(epsilon_N >= 0, "epsilon_N", epsilon_N, "0 N or more")
        self._fields_mT: list[float] = fields_mT.tolist()
        self._epsilon_N, self._predict_N = epsilon_N, predict_N

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        checked_near_mT(force_N, last_field_mT, self._fields_mT[0])
        best_mT, best_N, above, below, rows = self._fields_mT[0], math.inf, False, False, 0
        for field_mT in self._fields_mT:
            predicted_N = self._predict_N(curve, field_mT)
            rows += 1
            if abs(force_N - predicted_N) < abs(force_N - best_N):
                best_mT, best_N = field_mT, predicted_N
            if abs(force_N - predicted_N) <= self._epsilon_N:
                return answer(curve, best_mT, force_N, best_N, rows, Reach.INSIDE)
            above |= predicted_N > force_N
            below |= predicted_N < force_N
        reach = Reach.INSIDE if above and below else Reach.BELOW if above else Reach.ABOVE
        return answer(curve, best_mT, force_N, best_N, rows, reach)
