"""The thesis's search (Eq. 44), row by row: the baseline against which the others are measured."""

from tormagd.inverse.nearest import field_grid
from tormagd.inverse.solution import FieldSolution, Reach, confidence
from tormagd.learning.features import require_inputs, require_number
from tormagd.learning.model_file import ForceModel
from tormagd.physics.errors import DomainError

THESIS_EPSILON_N = 1.26
"""Radius of the neighbourhood in the thesis: the mean error of its network."""


class LinearFieldSearch:
    """Try the fields of a grid from the least upwards and stop at |F - NN| <= epsilon.

    With `epsilon_N` = 0 it sees every row and answers with the nearest. It knows no continuity: the last field is
    checked and not used. Raises `DomainError` on parameters it cannot use.
    """

    def __init__(
        self,
        model: ForceModel,
        *,
        field_range_mT: tuple[float, float],
        step_mT: float = 1.0,
        epsilon_N: float = THESIS_EPSILON_N,
    ) -> None:
        require_number("epsilon_N", epsilon_N)
        if epsilon_N < 0:
            raise DomainError("epsilon_N", epsilon_N, "0 N or more")
        self._model = model
        self._fields_mT: list[float] = field_grid(field_range_mT, step_mT).tolist()
        self._epsilon_N = epsilon_N

    def solve(
        self,
        displacement_mm: float,
        rate_mm_s: float,
        force_N: float,
        cip_percent: float,
        last_field_mT: float | None,
    ) -> FieldSolution:
        """See `FieldSolver.solve`; a force within epsilon of what some field gives counts as inside."""
        near = self._fields_mT[0] if last_field_mT is None else last_field_mT
        require_inputs(displacement_mm, rate_mm_s, near, cip_percent)
        require_number("force_N", force_N)

        best_mT, best_N, above, below, rows = self._fields_mT[0], 0.0, False, False, 0
        best_error_N = float("inf")
        for field_mT in self._fields_mT:
            predicted_N = self._model.predict_one(displacement_mm, rate_mm_s, field_mT, cip_percent)
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
        trust = confidence(self._model, (displacement_mm, rate_mm_s, best_mT, cip_percent), force_N, best_N)
        return FieldSolution(best_mT, best_N, trust, rows, reach)
