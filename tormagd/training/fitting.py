"""Training one force model: network, scaling, Levenberg-Marquardt, and what is written down about it."""

import datetime
from collections.abc import Callable

import msgspec

from tormagd.model.features import Element, Scaling
from tormagd.model.memory import NO_MEMORY, Memory
from tormagd.model.model_file import ForceModel, ModelMetadata
from tormagd.model.rising import not_rising_share
from tormagd.training.dataset import Dataset
from tormagd.training.levenberg_marquardt import Epoch, Training, train
from tormagd.training.metrics import fit_metrics
from tormagd.training.mlp import ForceNetwork, to_model


def fit_model(
    training: Dataset,
    validation: Dataset,
    *,
    element: Element,
    insert: str,
    data_sha256: str,
    created: datetime.date,
    memory: Memory = NO_MEMORY,
    hidden: int = 50,
    epochs: int = 200,
    seed: int = 0,
    progress: Callable[[Epoch], None] | None = None,
) -> tuple[ForceModel, Training]:
    """Train on `training`, stop by `validation`, and return the model with its metrics on both, and how it went. What
    was taken out of the data before is their `memory`.

    Deterministic for given data and seed. Raises `DomainError` on a name or a count that a model file may not have.
    """
    scaling = Scaling.fit(training.features, training.force_N)
    network = ForceNetwork(scaling, hidden, seed=seed)
    metadata = ModelMetadata(  # before the training, which a wrong name should not have to wait for
        element=element,
        insert=insert,
        hidden=hidden,
        ranges=training.ranges(),
        scaling=scaling,
        training_data_sha256=data_sha256,
        metrics={},
        created=created,
        memory=memory,
    )
    result = train(network, training, validation, epochs=epochs, progress=progress)
    model = to_model(network, metadata)
    metrics = {
        **{f"train_{name}": value for name, value in fit_metrics(model, training).items()},
        **{f"validation_{name}": value for name, value in fit_metrics(model, validation).items()},
        "not_rising_share": not_rising_share(model),
        "train_rows": float(len(training)),
        "validation_rows": float(len(validation)),
        "epochs": float(len(result.history)),
        "best_epoch": float(result.best.epoch),
    }
    return to_model(network, msgspec.structs.replace(metadata, metrics=metrics)), result
