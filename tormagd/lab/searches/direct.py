"""A second network that learned the inverse of the first: one pass, no search."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from tormagd.inverse.scan import FieldScan
from tormagd.inverse.solution import FieldSolution, answer
from tormagd.model.features import FIELD
from tormagd.model.force_curve import ForceCurve
from tormagd.model.model_file import ForceModel
from tormagd.physics.errors import DomainError

SCAN_INTERVALS = 16
LATTICE = 7
FIELD_POINTS = 49


class DirectInverse:
    """Field from (displacement, rate, CIP, share of the force between its two ends) by a 4-h-1 network of its own.

    Trained here, on samples of `model` over its training ranges (full-batch L-BFGS; the same `seed` gives the same
    network). A function has one value, so only a model whose force rises with the field at every sample has a direct
    inverse: `DomainError` otherwise. Outside the training ranges it extrapolates; the answer stays in the field range.
    """

    def __init__(
        self,
        model: ForceModel,
        *,
        field_range_mT: tuple[float, float],
        hidden: int = 50,
        seed: int = 0,
        iterations: int = 300,
    ) -> None:
        if hidden < 1:
            raise DomainError("hidden", hidden, "1 or more")
        low_mT, high_mT = field_range_mT
        self._scan = FieldScan(
            field_range_mT=field_range_mT, step_mT=(high_mT - low_mT) / SCAN_INTERVALS, dtype=np.float64
        )
        self._low_mT, self._span_mT = low_mT, high_mT - low_mT
        inputs, targets = self._samples(model)
        self._centre, span = inputs.mean(axis=0), np.ptp(inputs, axis=0)
        # a feature that never varied must not decide anything
        self._gain = np.divide(2.0, span, out=np.zeros_like(span), where=span > 0)
        network = _fit((inputs - self._centre) * self._gain, targets, hidden, seed, iterations)
        weight, bias, output, constant = (parameter.detach().numpy() for parameter in network.parameters())
        self._weight = weight * self._gain
        self._bias = bias - self._weight @ self._centre
        self._output = output[0]
        self._constant = float(constant[0])

    def _samples(self, model: ForceModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        axes = [np.linspace(low, high, LATTICE if high > low else 1) for low, high in model.feature_ranges]
        axes[FIELD] = np.linspace(self._low_mT, self._low_mT + self._span_mT, FIELD_POINTS)
        # the field last, so that each row of the reshaped forces is one curve over it
        axes.append(axes.pop(FIELD))
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 4)
        features = np.insert(grid[:, :3], FIELD, grid[:, 3], axis=1)
        curves = model.predict(features).reshape(-1, FIELD_POINTS)
        if not (np.diff(curves, axis=1) > 0).all():
            raise DomainError("model", "not rising with the field", "a force that rises with the field everywhere")
        share = (curves - curves[:, :1]) / (curves[:, -1:] - curves[:, :1])
        return np.column_stack((grid[:, :3], share.ravel())), (grid[:, 3] - self._low_mT) / self._span_mT

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`; the last field only decides where the force is flat."""
        look = self._scan.look(curve, force_N, last_field_mT)
        field_mT = look.candidate_mT
        if field_mT is None:
            low_N, high_N = look.ends_N
            share = -low_N / (high_N - low_N) if high_N != low_N else 0.5
            hidden = self._weight.dot((curve.displacement_mm, curve.rate_mm_s, curve.cip_percent, share)) + self._bias
            found = float(self._output.dot(np.tanh(hidden, hidden))) + self._constant
            field_mT = self._low_mT + self._span_mT * min(max(found, 0.0), 1.0)
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), look.iterations + 2, look.reach)


def _fit(
    inputs: NDArray[np.float64], targets: NDArray[np.float64], hidden: int, seed: int, iterations: int
) -> nn.Sequential:
    """Fit a tanh network with one hidden layer by L-BFGS on all rows at once."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = nn.Sequential(nn.Linear(inputs.shape[1], hidden), nn.Tanh(), nn.Linear(hidden, 1)).double()
    features, wanted = torch.from_numpy(inputs), torch.from_numpy(targets)
    optimiser = torch.optim.LBFGS(
        network.parameters(),
        max_iter=iterations,
        history_size=30,
        line_search_fn="strong_wolfe",
        tolerance_change=0.0,
        tolerance_grad=0.0,
    )

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        error = torch.square(network(features)[:, 0] - wanted).mean()
        error.backward()  # type: ignore[no-untyped-call]
        return error

    optimiser.step(loss)  # type: ignore[no-untyped-call]
    return network
