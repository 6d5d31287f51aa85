"""A recurrent network (GRU) over the four features and the time step: memory learned instead of written down."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tormagd.model.features import FEATURES, Scaling
from tormagd.training.dataset import Dataset
from tormagd.training.forward import require_fitted
from tormagd.training.memory import records, times_of
from tormagd.training.splits import Mask

Array = NDArray[np.float64]

CHUNK_ROWS = 350
"""Length over which gradients flow: two cycles of 175 samples. What lasts longer it can carry but hardly learn."""
BATCH_CHUNKS = 16
LEAST_STEP_S = 1e-3
DECADES = 3.0


class RecurrentForward:
    """nn.GRU with a linear output, by Adam, in float32. `holds` are further training records, all known.

    It is not told of what went before a record: its state begins at zero there.
    """

    def __init__(self, holds: Dataset | None = None, hidden: int = 24, *, epochs: int = 40, seed: int = 0) -> None:
        self._holds = holds
        self._hidden = hidden
        self._epochs = epochs
        self._seed = seed
        self._fitted: tuple[Scaling, _Recurrent] | None = None

    def fit(self, data: Dataset, training: Mask) -> nn.Module:
        """See `ForwardModel.fit`."""
        known = data.subset(training)
        scaling = Scaling.fit(known.features, known.force_N)
        parts = [(data, training)]
        if self._holds is not None:
            parts.append((self._holds, np.ones(len(self._holds), dtype=np.bool_)))
        chunks = [chunk for part, mask in parts for chunk in _chunks(scaling, part, mask)]
        inputs, targets, weights = (torch.stack(tensors) for tensors in zip(*chunks, strict=True))
        generator = torch.Generator().manual_seed(self._seed)
        network = _Recurrent(self._hidden, generator)
        batches = math.ceil(len(inputs) / BATCH_CHUNKS)
        optimizer = torch.optim.Adam(network.parameters())
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, max_lr=2e-2, epochs=self._epochs, steps_per_epoch=batches
        )
        for _ in range(self._epochs):
            for rows in torch.randperm(len(inputs), generator=generator).tensor_split(batches):
                output, _ = network(inputs[rows])
                loss = (weights[rows] * (output - targets[rows]).square()).sum() / weights[rows].sum().clamp_min(1.0)
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
        self._fitted = scaling, network
        return network

    @torch.no_grad()
    def predict(self, data: Dataset) -> Array:
        """See `ForwardModel.predict`."""
        scaling, network = require_fitted(self._fitted)
        inputs = _inputs(scaling, data)
        forces = np.empty(len(data))
        for rows in records(data):
            output, _ = network(inputs[rows][None])
            forces[rows] = output[0].double().numpy() / scaling.output_gain + scaling.output_offset
        return forces


class _Recurrent(nn.Module):
    def __init__(self, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        self.cell = nn.GRU(len(FEATURES) + 1, hidden, batch_first=True)
        self.output = nn.Linear(hidden, 1)
        with torch.no_grad():
            for parameter in self.parameters():  # by this generator, so that a fit depends on no global state
                parameter.uniform_(-(hidden**-0.5), hidden**-0.5, generator=generator)

    def forward(self, inputs: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        hidden, last = self.cell(inputs, state)
        return self.output(hidden)[..., 0], last


def _inputs(scaling: Scaling, data: Dataset) -> Tensor:
    """Scaled features and the logarithm of the time step (n x 5)."""
    times = times_of(data)
    steps = np.diff(times, prepend=times[0])
    logarithm = np.log10(np.maximum(steps, LEAST_STEP_S) / LEAST_STEP_S) / DECADES
    return torch.tensor(np.column_stack((scaling.scaled(data.features), logarithm)), dtype=torch.float32)


def _chunks(scaling: Scaling, data: Dataset, training: Mask) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Inputs, scaled targets and weights (0 for rows that are not to be learned from) in pieces of `CHUNK_ROWS`."""
    inputs = _inputs(scaling, data)
    targets = torch.tensor((data.force_N - scaling.output_offset) * scaling.output_gain, dtype=torch.float32)
    weights = torch.tensor(training, dtype=torch.float32)
    chunks = []
    for rows in records(data):
        for first in range(rows.start, rows.stop, CHUNK_ROWS):
            piece = slice(first, min(first + CHUNK_ROWS, rows.stop))
            short = CHUNK_ROWS - (piece.stop - piece.start)
            chunks.append(
                (
                    nn.functional.pad(inputs[piece], (0, 0, 0, short)),
                    nn.functional.pad(targets[piece], (0, short)),
                    nn.functional.pad(weights[piece], (0, short)),
                )
            )
    return chunks
