"""Training of one force model: network, scaling, Levenberg-Marquardt as in the thesis (section 4.2.5), and metadata.

The package torch-levenberg-marquardt differentiates the network for each row (vmap over jacrev). That takes 3.5 times
as long as one hidden layer's closed form (4096 rows, 50 units). The damping schedule, early stop and determinism are
part of the published result, so they are readable here.
"""

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from tormag_lab.arrays import Mask
from tormag_lab.training.dataset import Dataset, random_split, trained_metrics
from tormagd.element.model.features import CIP, FIELD, Element, Scaling
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.model.model_file import ForceModel, ModelMetadata, Ranges
from tormagd.element.model.network import ForceNetwork, to_model
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.inserts import insert

VALIDATION_SHARE = 0.1
"Share of the training rows that decides when training stops; test rows have no part in that."

BATCH_ROWS = 4096
"10 MB of the Jacobian at 50 hidden units."

INITIAL_DAMPING = 1e-3
DAMPING_DOWN = 0.1
DAMPING_UP = 10.0
MIN_POSITIVE = 1e-3
"Least start of a weight that has to stay positive."
MIN_IMPROVEMENT = 1e-4
MIN_DAMPING = 1e-15
GREATEST_DAMPING = 1e10
"Marquardt's schedule with trainlm's usual factors; errors are means, so they fit any number of rows."


class Epoch(NamedTuple):
    epoch: int
    train_rmse_N: float
    validation_rmse_N: float


@dataclass(frozen=True)
class Training:
    """A training's accepted steps, the one whose weights were kept, and why it ended."""

    history: tuple[Epoch, ...]
    best: Epoch
    stopped_by: str


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


def jacobian(network: ForceNetwork, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return the scaled force (n) and its derivatives (n x p) by every weight."""
    hidden = torch.sigmoid(torch.addmm(network.hidden_bias, inputs, network.hidden_weight.T))
    by_bias = hidden * (1 - hidden) * network.output_weight
    by_weight = (by_bias[:, :, None] * inputs[:, None, :]).flatten(start_dim=1)
    by_constant = torch.ones_like(hidden[:, :1])
    output = hidden @ network.output_weight + network.output_bias
    return output, torch.cat((by_weight, by_bias, hidden, by_constant), dim=1)


@torch.no_grad()
def train(
    network: ForceNetwork,
    training: Dataset,
    validation: Dataset,
    *,
    epochs: int = 200,
    patience: int = 10,
    rising: bool = False,
) -> Training:
    """Fit `network` to `training` in place, and leave it with the weights that did best on `validation`."""
    for name, count in (("epochs", epochs), ("patience", patience)):
        if count < 1:
            raise DomainError(name, count, "1 or more")
    inputs, targets = _scaled(network, training)
    check_inputs, check_targets = _scaled(network, validation)
    to_N = 1 / float(network.output_gain)

    is_positive = _made_rising(network) if rising else torch.zeros((), dtype=torch.bool)
    weights = torch.nn.utils.parameters_to_vector(network.parameters())
    best_weights = weights
    error = _mean_square(network, inputs, targets)
    check_error = _mean_square(network, check_inputs, check_targets)
    best = Epoch(0, to_N * math.sqrt(error), to_N * math.sqrt(check_error))
    reference, improved = best.validation_rmse_N, 0  # what the patience is measured against
    history: list[Epoch] = []
    damping, stopped_by = INITIAL_DAMPING, "epochs"
    for epoch in tqdm(range(1, epochs + 1), desc="training", unit="epoch", disable=None, leave=False):
        normal, gradient = _normal_equations(network, inputs, targets)
        per_change = torch.where(is_positive, weights, 1.0)
        normal, gradient = per_change[:, None] * normal * per_change, per_change * gradient
        while damping <= GREATEST_DAMPING:
            change = _step(normal, gradient, damping)
            if change is not None:
                candidate = torch.where(is_positive, weights * change.exp(), weights + change)
                torch.nn.utils.vector_to_parameters(candidate, network.parameters())
                candidate_error = _mean_square(network, inputs, targets)
                if candidate_error < error:
                    break
            damping *= DAMPING_UP
        else:
            stopped_by = "damping"
            break
        weights, error = candidate, candidate_error
        check_error = _mean_square(network, check_inputs, check_targets)
        step = Epoch(epoch, to_N * math.sqrt(error), to_N * math.sqrt(check_error))
        damping = max(damping * DAMPING_DOWN, MIN_DAMPING)
        history.append(step)
        if step.validation_rmse_N < best.validation_rmse_N:
            best, best_weights = step, weights
        if step.validation_rmse_N < reference * (1 - MIN_IMPROVEMENT):
            reference, improved = step.validation_rmse_N, epoch
        elif epoch - improved == patience:
            stopped_by = "validation"
            break
    torch.nn.utils.vector_to_parameters(best_weights, network.parameters())
    return Training(tuple(history), best, stopped_by)


def _made_rising(network: ForceNetwork) -> Tensor:
    """Turn each unit to rise with the field, in place, and return which parameters must stay positive."""
    weight, output = network.hidden_weight, network.output_weight
    side = torch.where(weight[:, FIELD] < 0.0, -1.0, 1.0).double()
    weight.mul_(side[:, None])
    network.hidden_bias.mul_(side)
    weight[:, FIELD].clamp_(min=MIN_POSITIVE)
    output.abs_().clamp_(min=MIN_POSITIVE)
    network.output_bias.fill_(-output.sum() / 2)
    is_positive = [torch.zeros_like(each, dtype=torch.bool) for each in network.parameters()]
    is_positive[0][:, FIELD] = True
    is_positive[2][:] = True
    return torch.cat([each.flatten() for each in is_positive])


def _scaled(network: ForceNetwork, dataset: Dataset) -> tuple[Tensor, Tensor]:
    features, force_N = torch.tensor(dataset.features), torch.tensor(dataset.force_N)
    return network.scale_inputs(features), network.scale_output(force_N)


def _mean_square(network: ForceNetwork, inputs: Tensor, targets: Tensor) -> float:
    return float((network.forward_scaled(inputs) - targets).square().mean())


def _normal_equations(network: ForceNetwork, inputs: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return J'J / n (p x p) and J'r / n (p) of the scaled force, with r = output - target."""
    size = sum(parameter.numel() for parameter in network.parameters())
    normal = torch.zeros(size, size, dtype=inputs.dtype)
    gradient = torch.zeros(size, dtype=inputs.dtype)
    for rows, wanted in zip(torch.split(inputs, BATCH_ROWS), torch.split(targets, BATCH_ROWS), strict=True):
        output, derivatives = jacobian(network, rows)
        normal.addmm_(derivatives.T, derivatives)
        gradient.addmv_(derivatives.T, output - wanted)
    return normal / len(inputs), gradient / len(inputs)


def _step(normal: Tensor, gradient: Tensor, damping: float) -> Tensor | None:
    """Return the step (p) -(J'J + damping I)^-1 J'r, or None where rounding made the matrix indefinite."""
    damped = normal + damping * torch.eye(len(gradient), dtype=normal.dtype)
    factor, failed = torch.linalg.cholesky_ex(damped)
    if int(failed):
        return None
    return -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
