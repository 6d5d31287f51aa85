"""Forward models behind one interface, and the thesis's network as the first of them."""

import datetime
from typing import Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from tormagd.model.features import Element, Scaling
from tormagd.model.model_file import ForceModel, ModelMetadata
from tormagd.physics.errors import DomainError
from tormagd.training.dataset import Dataset
from tormagd.training.levenberg_marquardt import Training, train
from tormagd.training.mlp import ForceNetwork, to_model
from tormagd.training.splits import Mask, random_split

Array = NDArray[np.float64]

VALIDATION_SHARE = 0.1
"""Of the training rows, to say when the training stops; the test rows have no part in that."""


class ForwardModel(Protocol):
    """A model of force over time that is fitted to data and then asked about other data.

    `fit` may look at the features of every row, because a memory runs through them, but at the force of `training`
    rows only. `predict` gives the force of every row; models with memory need `time_s` and rows in the order of time,
    and start a new record wherever time goes back. Raise `DomainError` on data they cannot use.
    """

    def fit(self, data: Dataset, training: Mask) -> object:
        """Learn from the rows of `data` (n) that `training` (n) marks; returns what a prediction needs of it.

        Whatever was learned before is forgotten.
        """
        ...

    def predict(self, data: Dataset) -> Array:
        """Return the force (n), N, of every row. Raises `DomainError` before `fit`."""
        ...


Fitted = TypeVar("Fitted")


def require_fitted(model: Fitted | None) -> Fitted:
    """Return `model`; raise `DomainError` when there is none yet."""
    if model is None:
        raise DomainError("model", model, "a fitted one: call fit first")
    return model


class NetworkForward:
    """The 4-h-1 network of section 4.2.5 by Levenberg-Marquardt. It sees one row at a time and has no memory.

    Every fit begins with the weights of `start`, if given. Raises `DomainError` when that has another number of units.
    """

    def __init__(
        self,
        hidden: int = 50,
        *,
        epochs: int = 162,
        seed: int = 0,
        insert: str = "MRE-ABC",
        start: ForceModel | None = None,
    ) -> None:
        if start is not None and start.metadata.hidden != hidden:
            raise DomainError("start", f"a model of {start.metadata.hidden} hidden units", f"one of {hidden}")
        self._hidden = hidden
        self._epochs = epochs
        self._seed = seed
        self._insert = insert
        self._start = start
        self._model: ForceModel | None = None
        self.training: Training | None = None

    def fit(self, data: Dataset, training: Mask) -> ForceModel:
        """See `ForwardModel.fit`; `training` tells afterwards how it went."""
        known = data.subset(training)
        stop = random_split(len(known), self._seed, VALIDATION_SHARE)
        scaling = Scaling.fit(known.features, known.force_N)
        metadata = ModelMetadata(
            element=Element.TACTILE,
            insert=self._insert,
            hidden=self._hidden,
            ranges=known.ranges(),
            scaling=scaling,
            training_data_sha256=known.sha256(),
            metrics={},
            created=datetime.date.today(),
        )
        network = self._network(scaling)
        self.training = train(network, known.subset(~stop), known.subset(stop), epochs=self._epochs)
        self._model = to_model(network, metadata)
        return self._model

    def _network(self, scaling: Scaling) -> ForceNetwork:
        """New, or with the weights of `start` folded into the scaling of these data."""
        network = ForceNetwork(scaling, self._hidden, seed=self._seed)
        if self._start is None:
            return network
        weight, bias, output, constant = self._start.physical
        gain = np.array(scaling.input_gain)
        with torch.no_grad():
            scaled = np.divide(weight, gain, out=np.zeros_like(weight), where=gain != 0)
            network.hidden_weight.copy_(torch.tensor(scaled))
            network.hidden_bias.copy_(torch.tensor(bias + weight @ np.array(scaling.input_offset)))
            network.output_weight.copy_(torch.tensor(output * scaling.output_gain))
            network.output_bias.fill_((constant - scaling.output_offset) * scaling.output_gain)
        return network

    def predict(self, data: Dataset) -> Array:
        """See `ForwardModel.predict`."""
        return require_fitted(self._model).predict(data.features)
