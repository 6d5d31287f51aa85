"""Training of one force model: network, scaling, Levenberg-Marquardt, and the metadata of the result."""

import datetime
from collections.abc import Sequence

import msgspec
import numpy as np
import torch

from tormag_lab.arrays import Mask
from tormag_lab.training.dataset import Dataset, random_split, trained_metrics
from tormag_lab.training.levenberg_marquardt import Training, train
from tormagd.element.model.features import CIP, Element, Scaling
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.model.model_file import ForceModel, ModelMetadata, Ranges
from tormagd.element.model.network import ForceNetwork, to_model
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.inserts import insert

VALIDATION_SHARE = 0.1
"Share of the training rows that decides when training stops; test rows have no part in that."


def fit_model(
    training: Dataset,
    validation: Dataset,
    *,
    element: Element,
    inserts: Sequence[str],
    data_sha256: str,
    created: datetime.date,
    memory: Memory = NO_MEMORY,
    hidden: int = 50,
    epochs: int = 200,
    seed: int = 0,
    scaled_by: Dataset | None = None,
    start: ForceModel | None = None,
    rising: bool = False,
) -> tuple[ForceModel, Training]:
    """Train on `training`, stop by `validation`, and return the model with its metrics, and how it went."""
    ranging = scaled_by or training
    scaling = ranging.scaling()
    network = ForceNetwork(scaling, hidden, seed=seed)
    if start is not None:
        _begin_with(network, scaling, start)
    metadata = ModelMetadata(  # first, so that a wrong name does not wait for the training
        element=element,
        insert=inserts[0] if len(inserts) == 1 else inserts[0].rpartition("-")[0],
        hidden=hidden,
        ranges=ranging.ranges(),
        scaling=scaling,
        training_data_sha256=data_sha256,
        metrics={},
        created=created,
        memory=memory,
        boxes=msgspec.UNSET if len(inserts) == 1 else {name: _box(training, name) for name in inserts},
    )
    result = train(network, training, validation, epochs=epochs, rising=rising)
    model = to_model(network, metadata)
    metrics = {
        **trained_metrics(model, training, validation),
        "epochs": float(len(result.history)),
        "best_epoch": float(result.best.epoch),
    }
    return to_model(network, msgspec.structs.replace(metadata, metrics=metrics)), result


def fit_network(
    data: Dataset, known: Mask, hidden: int = 50, epochs: int = 162, start: ForceModel | None = None
) -> tuple[ForceModel, Training]:
    """Train the thesis's network (section 4.2.5) for the tactile element on the rows `known`."""
    rows = data.subset(known)
    stop = random_split(len(rows), 0, VALIDATION_SHARE)
    return fit_model(
        rows.subset(~stop),
        rows.subset(stop),
        element=Element.TACTILE,
        inserts=("MRE-ABC",),
        data_sha256=rows.sha256(),
        created=datetime.date.today(),
        hidden=hidden,
        epochs=epochs,
        scaled_by=rows,
        start=start,
    )


def _box(data: Dataset, name: str) -> Ranges:
    is_own = data.features[:, CIP] == 100.0 * insert(name).cip_fraction
    if is_own.sum() < 2:
        raise DomainError("insert", name, "one that there are rows of, by cip_percent")
    return data.subset(is_own).ranges()


@torch.no_grad()
def _begin_with(network: ForceNetwork, scaling: Scaling, start: ForceModel) -> None:
    """Give `network` the weights of `start`, converted to the network's own scaling."""
    weight, bias, output, constant = start.physical
    gain = np.array(scaling.input_gain)
    network.hidden_weight.copy_(torch.tensor(np.divide(weight, gain, out=np.zeros_like(weight), where=gain != 0)))
    network.hidden_bias.copy_(torch.tensor(bias + weight @ np.array(scaling.input_offset)))
    network.output_weight.copy_(torch.tensor(output * scaling.output_gain))
    network.output_bias.fill_((constant - scaling.output_offset) * scaling.output_gain)
