"""Training: data, the network, the law, the commands, the relaxation-aware model."""

import datetime
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from tormag_lab.arrays import rms
from tormag_lab.errors import LabError
from tormag_lab.main import main
from tormag_lab.training import train_model
from tormag_lab.training.bench_sweep import LOADED_MM, LOADED_STEP_MM, loading, sliding, strokes
from tormag_lab.training.dataset import (
    ALLOWED,
    COLUMNS,
    Dataset,
    fit_metrics,
    leave_cycles_out,
    leave_one_out,
    not_rising_share,
    random_split,
    read_csv,
    write_csv,
)
from tormag_lab.training.fitting import fit_network, jacobian, train
from tormag_lab.training.grey_box import GreyBox, GreyBoxMemory, fit_series, relaxed_N
from tormag_lab.training.law import Law, fit_bend, fit_law, fit_law_model
from tormag_lab.training.unremembered import identify
from tormagd.config import Config, Rates
from tormagd.control.assembly.build import build_core
from tormagd.control.believe.memory import ElementMemory
from tormagd.control.records import Handle, Measured
from tormagd.element.model.displacement import MOBILISED_MM, Turn
from tormagd.element.model.features import FIELD
from tormagd.element.model.memory import NO_MEMORY, Memory
from tormagd.element.model.model_file import ForceModel, load_model, model_path
from tormagd.element.model.network import ForceNetwork
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.friction import Friction
from tormagd.element.physics.inserts import insert
from tormagd.element.physics.relaxation import PronySeries
from tormagd.ground.table import TableError

HEADER = "displacement_mm,rate_mm_s,field_mT,cip_percent,force_N"
GOOD = "0.5,10,300,40,1.5"


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


def with_a_bad_value(column: str, value: str) -> tuple[tuple[str, ...], str]:
    """The lines of a file, and what is said of its third."""
    cells = dict(zip(COLUMNS, GOOD.split(","), strict=True)) | {column: value}
    low, high = ALLOWED[column]
    says = {
        **dict.fromkeys(("nan", ""), "row 3 lacks a value"),
        **dict.fromkeys(("1e9", "-1e9"), f"row 3, {column}: .* only numbers {low:g} to {high:g}"),
    }
    lines = HEADER, GOOD, ",".join(cells.values()), GOOD
    return lines, says.get(value, f"row 3, {column} = '{value}'.* a finite number")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((), "no numbers stand right below a row of names"),
        ((HEADER,), "no numbers stand right below a row of names"),
        ((HEADER, GOOD), "1 rows"),
        ((HEADER + ",cycle,cycle", GOOD + ",1,1"), "'cycle' and 'cycle' may both be cycle"),
        ((HEADER.removesuffix(",force_N") + ",time_s", GOOD, GOOD), "no column is force_N"),
        ((HEADER, GOOD, "1,2,3"), "row 3 has 3 values: allowed is 5"),
        ((HEADER, GOOD, GOOD + ",1"), "row 3 has 6 values: allowed is 5"),
        ((HEADER + ",cycle", GOOD + ",1.5", GOOD + ",1"), "row 2, cycle: '1.5' is not allowed, only whole numbers"),
        ((HEADER + ",time_s", GOOD + ",-1", GOOD + ",1"), "row 2, time_s"),
        ((HEADER, GOOD, '"' + "1" * 200_000), "not CSV"),
        ((HEADER, GOOD, '"0.5"x,10,300,40,1'), "not CSV"),
        ((HEADER, "\xff\xfe\x00\x01"), "UTF-8"),
        *(
            with_a_bad_value(column, value)
            for column in COLUMNS
            for value in ("nan", "inf", "-inf", "", "1e9", "-1e9", "abc", "1_0", "0x10", "1e999")
        ),
    ],
)
def test_a_malformed_file_is_refused(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    path = tmp_path / "d.csv"
    path.write_text("".join(f"{line}\n" for line in lines), "latin-1")
    with pytest.raises((LabError, TableError), match=message):
        read_csv(path)


def test_a_split_keeps_cycles_whole() -> None:
    data = dataset()
    training, validation = data.split(0.25, seed=3)
    assert set(training.cycle) & set(validation.cycle) == set()
    assert (len(set(validation.cycle)), len(training) + len(validation)) == (2, len(data))


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, float("nan"), 0.01])
def test_a_split_without_two_sides_is_refused(share: float) -> None:
    with pytest.raises(LabError, match="validation_share"):
        dataset().split(share, seed=0)


def test_random_split_has_its_share_and_its_seed() -> None:
    held = random_split(1000, 3)
    assert held.sum() == 300
    assert (held == random_split(1000, 3)).all()
    assert (held != random_split(1000, 4)).any()


def test_each_row_is_left_out_once_beside_all_of_its_group() -> None:
    field, cip = np.repeat([0.0, 50.0, 99.0], 20), np.tile(np.repeat([25.0, 45.0], 10), 3)
    features = np.column_stack((np.linspace(0, 4, 60), np.ones(60), field, cip))
    cycle = np.arange(60) // 4
    grouped = Dataset(features, np.linspace(0, 1, 60), cycle)
    for folds, labels in (
        (leave_one_out(grouped, "field_mT"), field),
        (leave_cycles_out(grouped, 4, seed=0), cycle),
    ):
        assert (np.sum(folds, axis=0) == 1).all()
        assert not any(set(labels[held]) & set(labels[~held]) for held in folds)


NOISE_N = 0.02


def forces_N(features: np.ndarray) -> np.ndarray:
    """Saturates in displacement, rises with the field, falls a little with the rate."""
    displacement, rate, field, _ = features.T
    return (1 - np.exp(-displacement / 0.3)) * (0.3 + 4 * (field / 800) ** 2) * (1 + 0.2 * np.exp(-rate / 20))


def synthetic(rows: int, seed: int, noise_N: float = NOISE_N) -> Dataset:
    rng = np.random.default_rng(seed)
    features = np.column_stack(
        (rng.uniform(0, 1, rows), rng.uniform(0, 60, rows), rng.uniform(100, 800, rows), np.full(rows, 40.0))
    )
    return Dataset(features, forces_N(features) + noise_N * rng.normal(size=rows), np.arange(rows) // 50)


def network_for(data: Dataset, hidden: int = 10, seed: int = 0) -> ForceNetwork:
    return ForceNetwork(data.scaling(), hidden, seed=seed)


def test_the_jacobian_is_that_of_automatic_differentiation() -> None:
    network = network_for(synthetic(50, 0), hidden=7)
    inputs = torch.randn(20, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    output, derivatives = jacobian(network, inputs)
    expected = network.forward_scaled(inputs)
    slopes = [torch.autograd.grad(row, list(network.parameters()), retain_graph=True) for row in expected]
    rows = torch.stack([torch.cat([each.flatten() for each in row]) for row in slopes])
    torch.testing.assert_close(output, expected, rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(derivatives, rows, rtol=1e-12, atol=1e-14)


def test_every_step_lowers_the_training_error_and_the_weights_left_are_the_best_on_validation() -> None:
    training, validation = synthetic(60, 1, noise_N=0.3), synthetic(400, 2, noise_N=0.3)  # few rows: it overfits
    network = network_for(training, hidden=20)
    result = train(network, training, validation, epochs=100, patience=5)
    errors_N = [step.train_rmse_N for step in result.history]
    assert errors_N == sorted(errors_N, reverse=True)
    assert [step.epoch for step in result.history] == list(range(1, len(errors_N) + 1))
    assert result.stopped_by == "validation"
    assert result.best.epoch < len(result.history)
    assert result.best.validation_rmse_N == min(step.validation_rmse_N for step in result.history)
    assert missed_N(network, validation) == pytest.approx(result.best.validation_rmse_N, rel=1e-9)


def missed_N(network: ForceNetwork, data: Dataset) -> float:
    with torch.no_grad():
        return rms(network(torch.tensor(data.features)).numpy() - data.force_N)


def test_a_rising_force_rises_everywhere_and_fits() -> None:
    training, fresh = synthetic(2000, 1), synthetic(1000, 3, noise_N=0.0)
    network = network_for(training, hidden=12)
    train(network, training, synthetic(500, 2), epochs=150, rising=True)
    assert missed_N(network, fresh) < 0.01 * np.ptp(fresh.force_N)
    corners = np.random.default_rng(0).uniform((-1, -100, -500, 0), (3, 400, 2000, 80), (2000, 4))
    features = torch.tensor(corners, requires_grad=True)
    (slope,) = torch.autograd.grad(network(features).sum(), features)
    assert float(slope[:, FIELD].min()) >= 0.0


def test_what_cannot_be_trained_is_refused() -> None:
    data = synthetic(50, 1)
    for name, refused in (
        ("force_N", lambda: Dataset(data.features, np.ones(50)).scaling()),
        ("hidden", lambda: network_for(data, hidden=0)),
        ("epochs", lambda: train(network_for(data), data, data, epochs=0)),
        ("patience", lambda: train(network_for(data), data, data, patience=0)),
    ):
        with pytest.raises(DomainError, match=name):
            refused()


LAW = Law(0.1, -0.7, 1.1, 0.05, 0.15, 2.0, 0.01, 2e-4, 1.8, 0.5, 0.0)
OF_LAW = {"insert_name": "MRE-50-40", "data_sha256": "0" * 64, "created": datetime.date(2024, 1, 1)}


def lawful(rows: int, least_mm: float = 2.0, noise_N: float = NOISE_N) -> Dataset:
    rng, fitted = np.random.default_rng(4), insert("MRE-50-40")
    rates = np.exp(rng.uniform(np.log(0.5), np.log(310.0), rows))
    features = np.column_stack(
        (rng.uniform(least_mm, 2.0, rows), rates, rng.uniform(150, 850, rows), np.full(rows, 40.0))
    )
    return Dataset(features, LAW.forces_N(features, fitted) + noise_N * rng.normal(size=rows))


def test_fifty_rows_tell_the_law() -> None:
    fresh = lawful(2000, noise_N=0.0)
    found_N = fit_law(lawful(50), insert("MRE-50-40")).forces_N(fresh.features, insert("MRE-50-40"))
    assert np.abs(found_N - fresh.force_N).mean() < 0.01


def foreign(rows: int, noise_N: float, seed: int, least_mm: float) -> Dataset:
    """An elastomer whose moment saturates as Langevin's, and whose presliding has a length, not a stiffness."""
    rng = np.random.default_rng(seed)
    field_mT, rate_mm_s = rng.uniform(60.0, 800.0, rows), np.exp(rng.uniform(0.0, np.log(300.0), rows))
    displacement_mm = np.where(rng.random(rows) < 0.7, 2.0, rng.uniform(least_mm, 2.0, rows))
    moment = 1.0 / np.tanh(field_mT / 120.0) - 120.0 / field_mT
    level_N = (0.1 + 3.0 * moment**1.5) * (1.0 + 0.08 * np.exp(-np.square(rate_mm_s / 12.0))) + 6e-4 * rate_mm_s
    force_N = np.where(displacement_mm < 2.0, level_N * -np.expm1(-displacement_mm / 0.4), level_N)
    features = np.column_stack((displacement_mm, rate_mm_s, field_mT, np.full(rows, 40.0)))
    return Dataset(features, force_N + noise_N * rng.normal(size=rows))


def test_some_hundred_rows_tell_an_elastomer_of_another_law() -> None:
    few, fresh, own = foreign(400, 0.01, 1, 0.0), foreign(4000, 0.0, 7, 2.0), insert("MRE-50-40")
    law = fit_law(few, own)
    bend = fit_bend(few, own, law)
    assert np.abs(law.forces_N(fresh.features, own, bend) - fresh.force_N).mean() < 0.006
    beyond_N = law.forces_N(
        np.column_stack((*np.full((2, 50), 2.0), np.linspace(1, 1500, 50), np.full(50, 40.0))), own, bend
    )
    assert (np.diff(beyond_N) >= 0.0).all()


def test_a_law_becomes_a_network_that_rises_and_is_near_it() -> None:
    data, fresh = lawful(400, least_mm=0.0), lawful(500, noise_N=0.0)
    model = fit_law_model(data, data, **OF_LAW, epochs=40)
    metrics = model.metadata.metrics
    assert np.abs(model.predict(fresh.features) - fresh.force_N).mean() < 0.015  # of 4.3 N, within the fit's own errors
    assert metrics["law_mae_N"] < 0.04
    assert metrics["not_rising_share"] == 0.0
    assert metrics["law_exponent"] == pytest.approx(LAW.exponent, abs=0.02)
    assert (model.physical.hidden_weight[:, FIELD] > 0.0).all()
    assert (model.output_weight > 0.0).all()


KINETIC_N, STIFFNESS_N_MM = 2.0, 8.0


@pytest.mark.parametrize("speed_mm_s", [0.6, 20.0, 300.0])
def test_displacement_counts_from_where_the_elastomer_bears_nothing(speed_mm_s: float) -> None:
    lasts_s = max(0.4, 4.0 / speed_mm_s)
    speeds = np.repeat([100.0, 0.0, -speed_mm_s, 0.0], [300, 300, round(1e3 * lasts_s), 300])
    friction, deflection_mm, forces = Friction(STIFFNESS_N_MM, 0.0, 1.0, 5.0), 0.0, []
    for speed in speeds.tolist():
        force_N, deflection_mm = friction.advance(deflection_mm, speed, KINETIC_N, 1e-3)
        forces.append(force_N)
    handle_mm, signed_N = np.cumsum(speeds) * 1e-3, np.array(forces)
    rate_mm_s, displacement_mm = loading(handle_mm, np.full(len(speeds), 60.0), signed_N)
    kept = np.flatnonzero(~np.isnan(displacement_mm) & (rate_mm_s < 0.0))
    found_mm = displacement_mm[kept]
    assert len(kept) >= min(LOADED_MM / LOADED_STEP_MM, 0.5 * LOADED_MM / (speed_mm_s * 1e-3))
    assert 0.0 <= found_mm.min() <= found_mm.max() <= LOADED_MM
    assert rate_mm_s[kept] == pytest.approx(-speed_mm_s, rel=1e-6)
    expected_N = KINETIC_N * -np.expm1(-STIFFNESS_N_MM * found_mm / KINETIC_N)
    # a tick of a fast handle is a part of the way
    assert -signed_N[kept] == pytest.approx(expected_N, abs=STIFFNESS_N_MM * speed_mm_s * 1e-3 * 0.1 + 1e-3)
    assert not sliding(handle_mm, np.full(len(speeds), 60.0))[1][kept].any()


def test_while_the_gap_moves_no_row_is_kept() -> None:
    handle_mm = np.cumsum(np.repeat([20.0, -20.0], 400)) * 1e-3
    signed_N = np.where(np.arange(800) < 500, 1.0, -1.0)
    assert not np.isnan(loading(handle_mm, np.full(800, 60.0), signed_N)[1]).all()
    assert np.isnan(loading(handle_mm, 60.0 + 5e-3 * np.arange(800), signed_N)[1]).all()


def test_a_stroke_mobilises_before_it_creeps() -> None:
    hand, ends_s = strokes(3, seed=1)
    assert len(ends_s) == 3
    positions = np.array([hand.position_mm(time_s) for time_s in np.arange(0.0, ends_s[-1], 1e-3).tolist()])
    assert positions.max() - positions[0] > 9.0
    assert ends_s == sorted(ends_s)


def test_what_inserts_of_one_matrix_remember_is_found_in_all_their_records() -> None:
    fraction, random, time_s = 0.06, np.random.default_rng(0), np.arange(0.0, 160.0)
    records = []
    for iron, greatest_mT in ((20.0, 400.0), (40.0, 800.0), (20.0, 400.0), (40.0, 800.0)):
        shares = np.concatenate(([1.0], random.uniform(0.4, 1.0, 7)))
        field_mT = greatest_mT * np.repeat(shares, 20)
        level_N = 4.0 * (field_mT / 800.0) ** 2
        slow_N = last_N = level_N[0]
        for tick, drive_N in enumerate(level_N.tolist()):
            mean_N, last_N = (drive_N + last_N) / 2.0, drive_N
            slow_N = mean_N + (slow_N - mean_N) * np.exp(-1.0 / 8.0)
            level_N[tick] -= fraction * slow_N
        displacement_mm = np.where(time_s % 5.0 == 4.0, 0.2, MOBILISED_MM)
        borne_N = level_N * -np.expm1(-STIFFNESS_N_MM * displacement_mm / level_N)
        force_N = np.where(displacement_mm < MOBILISED_MM, borne_N, level_N)
        rate = 20.0 + 60.0 * (time_s % 7.0)
        records.append((np.column_stack((displacement_mm, rate, field_mT, np.full(160, iron))), force_N))
    features, forces_N = (np.concatenate(part) for part in zip(*records, strict=True))
    memory, free = identify(Dataset(features, forces_N, np.repeat(np.arange(4), 160), np.tile(time_s, 4)))
    assert (memory.fractions, memory.times_s[0]) == (
        pytest.approx((fraction, 0.0, 0.0), abs=0.002),
        pytest.approx(8.0, rel=0.05),
    )
    slid = features[:, 0] >= MOBILISED_MM
    fresh_N = 4.0 * (features[:, 2] / 800.0) ** 2
    assert free.force_N[slid] == pytest.approx(fresh_N[slid], rel=0.01)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "synthetic.csv"
    write_csv(path, synthetic(3000, 0, noise_N=0.01))
    return path


def command(data: Path, out: Path, *more: str) -> list[str]:
    required = ["train-model", str(data), "--element", "torque", "--insert", "MRE-50-40", "--out", str(out)]
    return [*required, "--hidden", "15", "--epochs", "40", "--created", "2024-01-01", *more]


def test_from_csv_to_model(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "model.safetensors"
    assert main(command(data, out, "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    model = load_model(out, element="torque", insert="MRE-50-40")
    assert report["validation_r2"] > 0.999
    assert report["validation_mae_N"] < 0.015
    assert 0 < report["train_mae_percent"] < 1
    assert 0 <= report["not_rising_share"] < 0.2
    assert (report["train_rows"], report["data_sha256"]) == (2100, model.metadata.training_data_sha256)
    assert model.metadata.metrics["validation_r2"] == report["validation_r2"]
    near_the_corner = np.array([[0.9, 50.0, 750.0, 40.0]])
    assert model.predict(near_the_corner) == pytest.approx(forces_N(near_the_corner), abs=0.05)


def test_several_inserts_are_told_apart_by_their_iron(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows, both, out = read_csv(data), tmp_path / "both.csv", tmp_path / "model.safetensors"
    assert rows.cycle is not None
    features = np.concatenate((rows.features, rows.features * (1.0, 1.0, 0.5, 0.5)))  # half the field, half the iron
    joined_N, cycle = np.concatenate((rows.force_N, rows.force_N / 3.0)), np.concatenate((rows.cycle, rows.cycle + 100))
    write_csv(both, Dataset(features, joined_N, cycle))
    arguments = [*command(both, out, "--rising", "--epochs", "10"), "--insert", "MRE-50-20", "MRE-50-40"]
    assert main(arguments) == 0
    whole, strong = (load_model(out, element="torque", insert=name) for name in (None, "MRE-50-40"))
    assert (whole.metadata.insert, whole.metadata.ranges["cip_percent"]) == ("MRE-50", (20.0, 40.0))
    assert (strong.metadata.ranges["cip_percent"], strong.field_range_mT[1]) == (
        (40.0, 40.0),
        pytest.approx(800.0, rel=0.01),
    )
    assert load_model(out, element="torque", insert="MRE-50-20").field_range_mT[1] == pytest.approx(400.0, rel=0.01)
    assert whole.metadata.metrics["not_rising_share"] == 0.0
    assert main([*arguments[:-1], "MRE-50-30"]) == 2
    assert "insert = MRE-50-30 is not allowed: one that there are rows of" in capsys.readouterr().err


def test_the_same_command_gives_the_same_bytes(data: Path, tmp_path: Path) -> None:
    written = []
    for seed in ("1", "1", "2"):
        assert main(command(data, tmp_path / "m.safetensors", "--epochs", "5", "--seed", seed)) == 0
        written.append((tmp_path / "m.safetensors").read_bytes())
    assert written[0] == written[1] != written[2]


def test_what_was_taken_out_of_the_data_is_in_the_file(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Memory(fractions=(0.05,), times_s=(8.0,), lag_mT=7.0, turn_mT=70.0)
    monkeypatch.setattr(train_model, "identify", lambda rows: (memory, rows))
    for name, more, expected in (("with", ["--without-memory"], memory), ("plain", [], NO_MEMORY)):
        out = tmp_path / f"{name}.safetensors"
        assert main(command(data, out, "--epochs", "2", *more)) == 0
        assert load_model(out, element="torque").metadata.memory == expected


SERIES = PronySeries((0.02, 0.06, 0.04, 0.03), (1.2, 9.0, 120.0, 900.0))
FIELD_SERIES = PronySeries((0.03, 0.09, 0.05, 0.02), (1.2, 9.0, 120.0, 900.0))


def parts(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    displacement, rate, field, _ = features.T
    free = 4 * displacement * (1 + 0.1 * displacement) * (1 + 0.02 * rate)
    return free, free * 0.5 * (field / 300) ** 2


def holds() -> Dataset:
    """A pad that is pressed and held for an hour, at three fields."""
    time_s, fields = np.concatenate((np.linspace(0, 4, 21), 4 + np.geomspace(0.1, 3600, 120))), (0.0, 150.0, 300.0)
    displacement = np.minimum(time_s, 4.0)
    rate = np.gradient(displacement, time_s)
    pressed, field = np.column_stack((displacement, rate)), np.repeat(fields, len(time_s))
    features = np.column_stack((np.tile(pressed, (len(fields), 1)), field, np.full_like(field, 45)))
    cycle = np.arange(len(field)) // (len(time_s) // 4)
    empty = Dataset(features, np.zeros(len(field)), cycle, np.tile(time_s, len(fields)))
    free, added = parts(features)
    force = relaxed_N(SERIES, free, empty) + relaxed_N(FIELD_SERIES, added, empty)
    return replace(empty, force_N=force + np.random.default_rng(0).normal(0, NOISE_N, len(force)))


def test_a_series_is_recovered_from_holds_even_when_the_level_is_wrong() -> None:
    held = holds()
    free, added = parts(held.features)
    found, field_found = fit_series(held, (1.05 * free, 1.05 * added))
    assert (found.times_s, found.fractions) == (
        pytest.approx(SERIES.times_s, rel=0.2),
        pytest.approx(SERIES.fractions, abs=0.01),
    )
    assert sum(field_found.fractions) == pytest.approx(sum(FIELD_SERIES.fractions), abs=0.03)


def test_records_that_begin_late_were_run_before() -> None:
    # after n passes of 10 s a constant force has relaxed for n * 10 s
    for passes in (0, 3):
        data = Dataset(np.zeros((10, 4)), np.zeros(10), None, np.arange(1.0, 11.0) + 10 * passes)
        force = relaxed_N(PronySeries((0.5,), (20.0,)), np.full(10, 8.0), data)
        ramp = 20.0 * (1 - np.exp(-1 / 20.0))  # the first step is a ramp of 1 s
        remembered = 4.0 * ramp * np.exp(-(9 + 10 * passes) / 20.0)
        assert force[-1] == pytest.approx(4.0 + remembered, rel=1e-9)


def test_a_memory_needs_times() -> None:
    with pytest.raises(DomainError, match="time_s"):
        relaxed_N(SERIES, np.zeros(2), Dataset(np.zeros((2, 4)), np.zeros(2)))


def test_forces_held_out_are_not_looked_at() -> None:
    data, known = synthetic(200, 0), np.arange(200) % 3 > 0
    spoiled = replace(data, force_N=np.where(known, data.force_N, 900.0))
    models = [fit_network(each, known, 5, epochs=3)[0].predict(data.features) for each in (data, spoiled)]
    assert models[0] == pytest.approx(models[1])


def shipped(name: str) -> ForceModel:
    return load_model(model_path(name, Path()), element="torque")


def test_metrics_of_a_known_error() -> None:
    model = shipped("torque_mre_50_40")
    low, high = np.array(model.feature_ranges).T
    rows = np.random.default_rng(3).uniform(low, high, (300, 4))
    data = Dataset(rows, model.predict(rows) + np.where(np.arange(300) % 2, 0.5, -0.5))
    r2 = 1 - 0.25 / np.var(data.force_N)
    expected = {"mae_N": 0.5, "rmse_N": 0.5, "max_N": 0.5, "mae_percent": 50 / model.force_span_N, "r2": r2}
    assert fit_metrics(model, data) == pytest.approx(expected)


@pytest.mark.parametrize("name", ["torque_mre_50_40", "torque_mre_50"])
def test_not_rising_counts_where_the_force_falls_with_the_field(name: str) -> None:
    model = shipped(name)

    def share(field_weights: list[float], bias: list[float]) -> float:
        hidden, unused = model.metadata.hidden, model.metadata.hidden - 2
        weight = np.zeros((hidden, 4))
        weight[:2, FIELD] = field_weights
        changed = {"hidden_weight": weight, "hidden_bias": np.array(bias + [0.0] * unused)}
        return not_rising_share(replace(model, **changed, output_weight=np.ones(hidden)))

    assert (share([1.0, 0.0], [0.0, 0.0]), share([-1.0, 0.0], [0.0, 0.0])) == (0, 1)
    # a hill: rises in the lower half of the fields, falls in the upper
    assert 0.3 < share([8.0, -8.0], [4.0, 4.0]) < 1.0


def test_the_daemon_remembers_what_the_grey_box_does() -> None:
    model = load_model(model_path("tactile_mre_c", Path()), element="tactile")
    grey = GreyBox(model, model.metadata.memory.free, model.metadata.memory.added)
    element = build_core(Config(scene="radial_pulse", rates=Rates(control_hz=500, inference_hz=83))).element
    gap_range_mm = element.portrait.gap_mm[-1], element.portrait.gap_mm[0]
    lab, memory = GreyBoxMemory(grey, 0.01), ElementMemory(element.memory, element.nominal, element.field, gap_range_mm)
    memory.free, memory.added = element.memory.free.relaxed(0.0), element.memory.added.relaxed(0.0)
    memory.field_mT, memory.time_s = 140.0, 0.0
    draw = np.random.default_rng(4)
    for step in range(1, 300):
        place = min(0.01 * step, 2.0), 0.3, float(draw.uniform(140.0, 360.0))
        expected_N = lab.advance(*place, 45.0)
        at_mm, handle = element.field.gap_mm(place[2]) / 2.0, Handle(*place[:2], Turn(1.0, 0.0, 0.0))
        seen = Measured(step, True, 0.0, at_mm, at_mm, 0.0, 0.0, 0.0, handle, 0.0, 0.0, 0.0)
        memory.update(0.01 * step, seen)
        assert memory.force_N(element.nominal.now(seen)) == pytest.approx(expected_N, abs=1e-6)
