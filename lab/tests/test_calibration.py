"""`tormag-lab calibrate`: sweeps of the simulated device in virtual time, good ones and bad ones (all synthetic)."""

import datetime
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from tormag_lab.main import main
from tormag_lab.training import calibration
from tormag_lab.training.calibration import CalibrationError, displacement, fit, require_usable, training_rows
from tormag_lab.training.dataset import Dataset
from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.control.measure import Measure
from tormagd.control.records import Handle, Measured, TimedSetpoint
from tormagd.ctl.calibrate import SWEEP_COLUMNS, SWEPT_COLUMNS, up_and_down, write_sweeps
from tormagd.element.model.displacement import Turn
from tormagd.element.model.model_file import ForceModel, load_model, model_path
from tormagd.element.physics.inserts import insert
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import load_plant

INSERT = "MRE-50-40"
CREATED = datetime.date(2024, 2, 29)


@pytest.fixture(scope="module")
def sweeps():
    core = build_core(Config())
    device = VirtualDevice(load_plant("sample_1"), ReversingHand(2.0), seed=3)
    loop = ClosedLoop(Config(), core.stepper(), core.planner(), device)
    loop.arm()
    made = []
    for rate_N_s in (0.8, 1.0, 0.8):
        waveform = up_and_down(core.portrait.min_N, 2.0, rate_N_s)
        start_s = loop.now_s
        ticks = [
            (sample.time_s, seen.left_mm, seen.right_mm, seen.handle_mm, seen.handle.rate_mm_s, seen.force_N)
            for sample in loop.run(
                waveform.duration_s,
                lambda now_s, w=waveform, s=start_s: TimedSetpoint(w.at(now_s - s).force_N, now_s, 0.25),  # type: ignore[misc]
            )
            if (seen := sample.measured)
        ]
        made.append(dict(zip(SWEPT_COLUMNS, np.array(ticks).T, strict=True)))
    return made


@pytest.fixture
def table(sweeps, tmp_path):
    write_sweeps(tmp_path / "sweep.csv", sweeps)
    return calibration.read_sweeps(tmp_path / "sweep.csv")


def rows(table):
    return training_rows(table, insert(INSERT))


def column(name):
    return calibration.COLUMNS.index(name)


def fitted(data: Dataset) -> ForceModel:
    require_usable(data)
    return fit(data, INSERT, CREATED, hidden=12, epochs=60)


def refusal(table):
    with pytest.raises(CalibrationError) as refused:
        fitted(rows(table))
    return refused.value.code, str(refused.value)


def test_a_good_sweep_gives_a_model_that_knows_what_it_was_judged_on(table):
    data = rows(table)
    model = fitted(data)
    metrics = model.metadata.metrics
    assert metrics["judged_r2"] > 0.98
    assert metrics["judged_mae_N"] <= metrics["most_mae_N"]
    assert metrics["noise_mae_N"] == pytest.approx(0.01 * math.sqrt(2 / math.pi), rel=0.2)  # sample 1: sd 10 mN
    assert metrics["judged_rows"] == (data.cycle == 1).sum()
    assert metrics["judged_rows"] + metrics["train_rows"] + metrics["validation_rows"] == len(data)
    assert (model.metadata.insert, model.metadata.created) == (INSERT, CREATED)
    # the shipped model of a turning handle, less what the plant's elastomer has relaxed
    relaxed = 1.0 - sum(load_plant("sample_1").relaxation.fractions)
    shipped = load_model(model_path("torque_mre_50_40", Path()), element="torque", insert=INSERT)
    asked = [[2.0, 30.0, field, 40.0] for field in np.linspace(*model.field_range_mT, 9)]
    assert model.predict(asked) == pytest.approx(relaxed * shipped.predict(asked), rel=0.08)


def test_the_command_writes_a_model_or_nothing(sweeps, tmp_path, capsys):
    few, all_of_them, out = (tmp_path / name for name in ("few.csv", "all.csv", "m.safetensors"))
    write_sweeps(few, sweeps[:2])
    write_sweeps(all_of_them, sweeps)
    more = ["--insert", INSERT, "--out", str(out), "--json"]
    assert main(["calibrate", str(few), *more]) == 2
    assert "few_sweeps: 2 sweeps: needed are 3" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.csv", "few.csv"]
    assert main(["calibrate", str(all_of_them), *more]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["metrics"] == load_model(out, element="torque", insert=INSERT).metadata.metrics
    assert main(["calibrate", str(all_of_them), "--insert", "MRE-99-99", *more[2:]]) == 2
    assert "MRE-99-99" in capsys.readouterr().err


def test_a_law_is_judged_on_the_same_sweeps(table):
    metrics = fit(rows(table), INSERT, CREATED, hidden=12, epochs=60, by_law=True).metadata.metrics
    assert metrics["judged_r2"] > 0.98
    assert metrics["judged_mae_N"] <= metrics["most_mae_N"]
    assert metrics["law_static"] >= 0.0


NOISE_N = np.random.default_rng(0).normal(0.0, 0.01, 100_000)


@pytest.mark.parametrize(
    ("name", "spoilt", "expected", "said"),
    [
        (
            "rate_mm_s",
            lambda it: np.where(it["sweep"] == 2.0, 0.3, it["rate_mm_s"]),
            "handle_still",
            ("0% of sweep 3", "30%"),
        ),
        ("handle_mm", lambda it: np.linspace(0.0, 1.9, len(it["sweep"])), "handle_still", ("turn or go 2 mm",)),
        *(
            ("force_N", lambda it, dead_N=dead_N: np.full_like(it["sweep"], dead_N), "force_dead", ())
            for dead_N in (0.0, 1.3)
        ),
        ("force_N", lambda it: NOISE_N[: len(it["sweep"])], "force_dead", ()),
        ("gap_mm", lambda it: 80.0 + 0.05 * (it["gap_mm"] - 80.0), "field_range", ("20%",)),
        (
            "force_N",  # falls with the field somewhere
            lambda it: 1.0 + 2.0 * ((95.0 - it["gap_mm"]) / 35.0 - 0.4) ** 2 + NOISE_N[: len(it["sweep"])],
            "not_rising",
            ("falls by",),
        ),
        ("sweep", lambda it: np.minimum(it["sweep"], 1.0), "few_sweeps", ()),
    ],
)
def test_a_sweep_that_teaches_nothing_is_refused(table, name, spoilt, expected, said):
    table[:, column(name)] = spoilt(dict(zip(calibration.COLUMNS, table.T, strict=True)))
    code, text = refusal(table)
    assert code == expected
    assert [words for words in said if words not in text] == []


def test_a_force_that_has_little_to_do_with_the_field_is_refused_with_figures(table):
    table[:, column("force_N")] += np.sin(table[:, column("time_s")] * 1.7) * 0.4
    code, text = refusal(table)
    assert code == "poor_fit"
    r2, mae_mN, allowed_mN = (
        float(re.findall(pattern, text)[0])
        for pattern in (r"R2 is (-?[\d.]+)", r"mean error ([\d.]+) mN", r"allowed: ([\d.]+) mN")
    )
    assert r2 < 0.97
    assert mae_mN > allowed_mN


def test_a_steady_handle_teaches_nothing_about_rate_and_displacement(table):
    table[:, column("handle_mm")] = 42.0 * table[:, column("time_s")]
    table[:, column("rate_mm_s")] = 42.0 + np.random.default_rng(0).normal(0.0, 0.2, len(table))
    ranges = rows(table).ranges()
    assert ranges["displacement_mm"] == (2.0, 2.0)
    assert ranges["rate_mm_s"][0] == ranges["rate_mm_s"][1] == pytest.approx(42.0, abs=0.1)


def test_displacement_is_what_the_daemon_calls_it():
    path = np.cumsum(np.random.default_rng(1).normal(0.0, 0.06, 4000)) + 3.0 * np.sin(np.arange(4000) / 90.0)
    measure, handle = Measure(47.5, 0.01, True, 20.0, 1e-3), Handle(0.0, 0.0, Turn(1.0, path[0], path[0]))
    expected = []
    for position in path:
        fake = Measured(0, True, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, handle, 0.0, 0.0, 0.0)
        handle = measure._handle(fake, float(position), 1e-3)
        expected.append(handle.displacement_mm)
    found = displacement(path)
    known = np.isfinite(found)
    assert known[500:].all()
    assert found[known] == pytest.approx(np.array(expected)[known])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a,b\n1,2\n", "no column is time_s"),
        (",".join(SWEEP_COLUMNS) + "\n1,2,3,4,5,x\n", "x"),
        (",".join(SWEEP_COLUMNS) + "\n1,2,3,4,5,1e6\n1,2,3,4,5,6\n", "only numbers -1000 to 1000"),
    ],
)
def test_a_sweep_file_that_is_none_says_why(tmp_path, text, told):
    (tmp_path / "sweep.csv").write_text(text)
    with pytest.raises(ValueError, match=told):
        calibration.read_sweeps(tmp_path / "sweep.csv")
