"""The network and its training: derivatives, noise floor, determinism, scaling."""

import math

import numpy as np
import pytest
import torch
from torch.func import functional_call, jacrev

from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.fitting import scaling_of
from tormagd.lab.training.levenberg_marquardt import jacobian, train
from tormagd.model.features import FIELD
from tormagd.model.network import ForceNetwork
from tormagd.physics.errors import DomainError

NOISE_N = 0.02


def synthetic(rows: int, seed: int, noise_N: float = NOISE_N) -> Dataset:
    """A smooth synthetic brake: saturating in displacement, rising with the field, falling a little with the rate."""
    rng = np.random.default_rng(seed)
    features = np.column_stack(
        (rng.uniform(0, 1, rows), rng.uniform(0, 60, rows), rng.uniform(100, 800, rows), np.full(rows, 40.0))
    )
    displacement, rate, field, _ = features.T
    force = (1 - np.exp(-displacement / 0.3)) * (0.3 + 4 * (field / 800) ** 2) * (1 + 0.2 * np.exp(-rate / 20))
    return Dataset(features, force + noise_N * rng.normal(size=rows))


def network_for(data: Dataset, hidden: int = 10, seed: int = 0) -> ForceNetwork:
    return ForceNetwork(scaling_of(data), hidden, seed=seed)


def test_the_jacobian_is_that_of_automatic_differentiation() -> None:
    network = network_for(synthetic(50, 0), hidden=7)
    inputs = torch.randn(20, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    output, derivatives = jacobian(network, inputs)
    shadow = _Scaled(network)
    parameters = {name: value.detach() for name, value in shadow.named_parameters()}
    expected = jacrev(lambda weights: functional_call(shadow, weights, (inputs,)))(parameters)
    columns = torch.cat([expected[name].reshape(20, -1) for name in parameters], dim=1)
    torch.testing.assert_close(output, network.forward_scaled(inputs), rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(derivatives, columns, rtol=1e-12, atol=1e-14)


def test_every_accepted_step_lowers_the_training_error() -> None:
    training, validation = synthetic(500, 1), synthetic(200, 2)
    result = train(network_for(training), training, validation, epochs=30)
    errors = [step.train_rmse_N for step in result.history]
    assert errors == sorted(errors, reverse=True)
    assert [step.epoch for step in result.history] == list(range(1, len(errors) + 1))


def test_the_weights_left_are_the_best_on_validation() -> None:
    training, validation = synthetic(60, 1, noise_N=0.3), synthetic(400, 2, noise_N=0.3)  # few rows: it overfits
    network = network_for(training, hidden=20)
    result = train(network, training, validation, epochs=100, patience=5)
    assert result.stopped_by == "validation"
    assert result.best.epoch < len(result.history)
    assert result.best.validation_rmse_N == min(step.validation_rmse_N for step in result.history)
    with torch.no_grad():
        error = network(torch.tensor(validation.features)) - torch.tensor(validation.force_N)
    assert math.sqrt(float(error.square().mean())) == pytest.approx(result.best.validation_rmse_N, rel=1e-9)


def test_a_constant_column_neither_divides_by_zero_nor_matters() -> None:
    training, validation = synthetic(400, 1), synthetic(200, 2)
    network = network_for(training)
    train(network, training, validation, epochs=15)
    row = torch.tensor([[0.5, 10.0, 400.0, 40.0], [0.5, 10.0, 400.0, 12.0]], dtype=torch.float64)
    with torch.no_grad():
        force = network(row)
    assert torch.isfinite(force).all()
    assert float(force[0]) == pytest.approx(float(force[1]), rel=1e-13)
    assert (network.hidden_weight[:, 3] == 0).all()


def test_a_rising_force_rises_everywhere_and_fits() -> None:
    training, fresh = synthetic(2000, 1), synthetic(1000, 3, noise_N=0.0)
    network = network_for(training, hidden=12)
    train(network, training, synthetic(500, 2), epochs=150, rising=True)
    with torch.no_grad():
        error = network(torch.tensor(fresh.features)).numpy() - fresh.force_N
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.ptp(fresh.force_N)
    corners = np.random.default_rng(0).uniform((-1, -100, -500, 0), (3, 400, 2000, 80), (2000, 4))
    features = torch.tensor(corners, requires_grad=True)
    (slope,) = torch.autograd.grad(network(features).sum(), features)
    assert float(slope[:, FIELD].min()) >= 0.0


def test_a_rising_force_rises_where_the_data_fall() -> None:
    data = synthetic(500, 1)
    falling = Dataset(data.features, -data.force_N)
    network = network_for(falling, hidden=6)
    train(network, falling, falling, epochs=20, rising=True)
    assert bool((network.hidden_weight[:, FIELD] * network.output_weight > 0.0).all())


def test_what_cannot_be_trained_is_refused() -> None:
    data = synthetic(50, 1)
    with pytest.raises(DomainError, match="force_N"):
        scaling_of(Dataset(data.features, np.ones(50)))
    with pytest.raises(DomainError, match="hidden"):
        network_for(data, hidden=0)
    for wrong in ({"epochs": 0}, {"patience": 0}):
        with pytest.raises(DomainError, match=next(iter(wrong))):
            train(network_for(data), data, data, **wrong)


class _Scaled(torch.nn.Module):
    """The network on scaled inputs, for torch.func."""

    def __init__(self, network: ForceNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return self.network.forward_scaled(inputs)
