"""Training: its data and splits; the network's derivatives, noise floor, determinism, scaling; the command."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from torch.func import functional_call, jacrev

from tormagd.lab.errors import LabError
from tormagd.lab.training.dataset import ALLOWED, COLUMNS, Dataset, read_csv, write_csv
from tormagd.lab.training.fitting import scaling_of
from tormagd.lab.training.levenberg_marquardt import jacobian, train
from tormagd.lab.training.metrics import leave_cycles_out, leave_one_out, random_split
from tormagd.model.features import FIELD
from tormagd.model.network import ForceNetwork
from tormagd.physics.errors import DomainError

# -- data: what is read is what was written, what is wrong is refused by row, column and value -------------------------


HEADER = "displacement_mm,rate_mm_s,field_mT,cip_percent,force_N"
GOOD = "0.5,10,300,40,1.5"


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def dataset(rows: int = 40, cycles: int | None = 8) -> Dataset:
    rng = np.random.default_rng(1)
    features = rng.uniform((0, 0, 100, 40), (1, 60, 800, 40.0001), (rows, 4))
    cycle = None if cycles is None else np.arange(rows) * cycles // rows
    return Dataset(features, rng.uniform(0, 6, rows), cycle, np.arange(rows) * 0.01)


@given(
    st.lists(
        st.tuples(*(st.floats(*ALLOWED[name]) for name in COLUMNS), st.integers(0, 10**9), st.floats(0, 1e9)),
        min_size=2,
        max_size=20,
    )
)
def test_round_trip_keeps_every_bit(tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]) -> None:
    path = tmp_path_factory.mktemp("csv") / "data.csv"
    table = np.array(rows)
    written = Dataset(table[:, :4], table[:, 4], table[:, 5].astype(np.int64), table[:, 6])
    write_csv(path, written)
    read = read_csv(path)
    for name, column in written.columns().items():
        np.testing.assert_array_equal(read.columns()[name], column)
    assert read.sha256() == written.sha256()


@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "", "1e9", "-1e9", "abc", "1_0", "0x10", "1e999"])
def test_a_bad_value_is_named(tmp_path: Path, column: str, value: str) -> None:
    cells = GOOD.split(",")
    cells[COLUMNS.index(column)] = value
    path = write(tmp_path / "d.csv", HEADER, GOOD, ",".join(cells), GOOD)
    low, high = ALLOWED[column]
    with pytest.raises(LabError, match=rf"row 3, {column}: .*{value}.* only numbers {low:g} to {high:g}"):
        read_csv(path)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((), "row 1: header"),
        (("",), "row 1: header"),
        ((HEADER,), "0 rows"),
        ((HEADER, GOOD), "1 rows"),
        ((HEADER + ",colour", GOOD + ",1"), "row 1: header"),
        ((HEADER + ",cycle,cycle", GOOD + ",1,1"), "row 1: header"),
        (("rate_mm_s,displacement_mm,field_mT,cip_percent,force_N", GOOD, GOOD), "row 1: header"),
        ((HEADER, GOOD, "1,2,3"), "row 3: 3 values; needed are 5"),
        ((HEADER, GOOD, GOOD + ",1"), "row 3: 6 values; needed are 5"),
        ((HEADER, GOOD, ""), "row 3: 0 values"),
        ((HEADER + ",cycle", GOOD + ",1.5"), "row 2, cycle: '1.5' is not allowed, only whole numbers"),
        ((HEADER + ",time_s", GOOD + ",-1"), "row 2, time_s"),
        ((HEADER, GOOD, '"' + "1" * 200_000), "row 3: not CSV"),
        ((HEADER, GOOD, '"0.5"x,10,300,40,1'), "row 3: not CSV"),
    ],
)
def test_a_malformed_file_is_refused(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises(LabError, match=message):
        read_csv(write(tmp_path / "d.csv", *lines))


def test_a_file_that_is_no_text_or_missing_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.csv"
    with pytest.raises(LabError, match=r"d\.csv: cannot be read: No such file"):
        read_csv(path)
    path.write_bytes(HEADER.encode() + b"\n\xff\xfe\x00\x01")
    with pytest.raises(LabError, match="UTF-8"):
        read_csv(path)


def test_a_split_keeps_cycles_whole() -> None:
    data = dataset()
    training, validation = data.split(0.25, seed=3)
    assert set(training.cycle) & set(validation.cycle) == set()
    assert len(set(validation.cycle)) == 2
    assert len(training) + len(validation) == len(data)


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, float("nan"), 0.01])
def test_a_split_without_two_sides_is_refused(share: float) -> None:
    with pytest.raises(LabError, match="validation_share"):
        dataset().split(share, seed=0)


# -- splits by group hold out whole groups, once each ------------------------------------------------------------------


@pytest.fixture
def data() -> Dataset:
    field, cip = np.repeat([0.0, 50.0, 99.0], 20), np.tile(np.repeat([25.0, 45.0], 10), 3)
    features = np.column_stack((np.linspace(0, 4, 60), np.ones(60), field, cip))
    return Dataset(features, np.linspace(0, 1, 60), np.arange(60) // 4)


def test_random_split_has_its_share_and_its_seed() -> None:
    held = random_split(1000, 3)
    assert held.sum() == 300
    assert (held == random_split(1000, 3)).all()
    assert (held != random_split(1000, 4)).any()


@pytest.mark.parametrize(("feature", "column", "values"), [("field_mT", 2, [0, 50, 99]), ("cip_percent", 3, [25, 45])])
def test_each_value_is_left_out_once(data: Dataset, feature: str, column: int, values: list[float]) -> None:
    folds = list(leave_one_out(data, feature))
    assert [value for value, _ in folds] == values
    for value, held in folds:
        assert set(data.features[held, column]) == {value}
        assert value not in data.features[~held, column]
    assert (np.sum([held for _, held in folds], axis=0) == 1).all()


def test_cycles_stay_whole(data: Dataset) -> None:
    folds = [held for _, held in leave_cycles_out(data, 4, seed=0)]
    assert (np.sum(folds, axis=0) == 1).all()
    assert data.cycle is not None
    assert not any(set(data.cycle[held]) & set(data.cycle[~held]) for held in folds)


# -- the network and its training --------------------------------------------------------------------------------------


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
