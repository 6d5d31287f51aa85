"""Calibrating: sweeps recorded in virtual time from the simulated device, good ones and bad ones (all synthetic)."""

import contextlib
import csv
import datetime
import json
import math
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from tormagd.commission import procedure as course
from tormagd.commission.finding import Finding
from tormagd.commission.sequence import STEPS, Stopped, begun
from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.control.measure import Measure
from tormagd.control.records import Handle, Measured, TimedSetpoint
from tormagd.ctl import (
    calibrate as ctl_calibrate,
    calibrate_device,
    calibrate_motors as ctl_calibrate_motors,
    commission as ctl_commission,
)
from tormagd.ctl.calibrate import COLUMNS, FILE_COLUMNS, agree, up_and_down, write_sweeps
from tormagd.ctl.calibrate_motors import COLUMNS as MOTOR_COLUMNS, motor_log
from tormagd.ctl.calibrate_run import Progress, Range
from tormagd.ctl.outcome import CommandError
from tormagd.element.model.displacement import MOVING_MM_S, Turn
from tormagd.element.model.model_file import ForceModel, load_model, model_path
from tormagd.element.physics.inserts import insert
from tormagd.lab.training import calibration
from tormagd.lab.training.calibration import CalibrationError, displacement, fit, require_usable, training_rows
from tormagd.lab.training.dataset import Dataset
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
        waveform = up_and_down(Range(core.portrait.min_N, 2.0), rate_N_s)
        start_s = loop.now_s
        ticks = [
            (sample.time_s, seen.left_mm, seen.right_mm, seen.handle_mm, seen.handle.rate_mm_s, seen.force_N)
            for sample in loop.run(
                waveform.duration_s,
                lambda now_s, w=waveform, s=start_s: TimedSetpoint(w.at(now_s - s).force_N, now_s, 0.25),  # type: ignore[misc]
            )
            if (seen := sample.measured)
        ]
        made.append(dict(zip(COLUMNS, np.array(ticks).T, strict=True)))
    return made


@pytest.fixture
def table(sweeps, tmp_path):
    write_sweeps(tmp_path / "sweep.csv", sweeps)
    return calibration.read_sweep(tmp_path / "sweep.csv")


def rows(table):
    return training_rows(table, insert(INSERT), 4.0)


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


def test_the_whole_process_writes_model_and_training_data(sweeps, tmp_path, capsys):
    write_sweeps(tmp_path / "sweep.csv", sweeps[:2])
    out, data = tmp_path / "m.safetensors", tmp_path / "t.csv"
    arguments = [str(tmp_path / "sweep.csv"), "--insert", INSERT, "--out", str(out), "--csv", str(data)]
    # a refused one leaves nothing in the way of the next
    assert calibration.main(arguments) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "few_sweeps"
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.csv"]
    write_sweeps(tmp_path / "sweep.csv", sweeps)
    assert calibration.main(arguments) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["metrics"] == load_model(out, element="torque", insert=INSERT).metadata.metrics
    assert data.read_text().splitlines()[0] == "displacement_mm,rate_mm_s,field_mT,cip_percent,force_N,cycle,time_s"
    assert calibration.main([*arguments[:2], "MRE-99-99", *arguments[3:]]) == 1
    assert "MRE-99-99" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_a_law_is_judged_on_the_same_sweeps(table):
    metrics = fit(rows(table), INSERT, CREATED, hidden=12, epochs=60, by_law=True).metadata.metrics
    assert metrics["judged_r2"] > 0.98
    assert metrics["judged_mae_N"] <= metrics["most_mae_N"]
    assert metrics["law_static"] >= 0.0


def test_a_missing_package_is_told_before_anybody_turns_the_handle(monkeypatch, capsys):
    assert calibration.main(["--insert", INSERT]) == 0
    assert json.loads(capsys.readouterr().out) == {"result": {"insert": INSERT}}
    monkeypatch.setattr(calibration, "NEEDED", ("a_package_that_is_not",))
    assert calibration.main(["--insert", INSERT]) == 1
    told = json.loads(capsys.readouterr().out)["error"]
    assert (told["code"], told["message"]) == ("not_installed", "a_package_that_is_not is not installed")
    assert "pip install" in told["hint"]
    assert told["hint"].endswith("; or calibrate with --law")
    assert calibration.main(["--insert", INSERT, "--law"]) == 0


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


def test_what_ctl_may_not_import_is_equal():
    assert (calibration.COLUMNS, course.MOVING_MM_S) == (FILE_COLUMNS, MOVING_MM_S)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a,b\n1,2\n", "header"),
        (",".join(FILE_COLUMNS) + "\n1,2,3,4,5,x\n", "x"),
        (",".join(FILE_COLUMNS) + "\n1,2,3,4,5,nan\n1,2,3,4,5,6\n", "only numbers -1000 to 1000"),
    ],
)
def test_a_sweep_file_that_is_none_says_why(tmp_path, text, told):
    (tmp_path / "sweep.csv").write_text(text)
    with pytest.raises(ValueError, match=told):
        calibration.read_sweep(tmp_path / "sweep.csv")


def ticks(count=200):
    known = dict.fromkeys(MOTOR_COLUMNS, np.zeros(count))
    time_s = 5.0 + 1e-3 * np.arange(count)
    return known | {
        "device_time_s": time_s,
        "left_duty": np.arange(count) / 1e3,
        "supply_V": np.full(count, 12.0),
        "left_mm": 40.0 + np.arange(count) / 1e2,
        "right_mm": np.full(count, 30.0),
        "reference_gap_mm": np.full(count, 80.0),
    }


def test_a_motor_log_has_volts_and_even_times_whatever_the_ticks_missed():
    given = ticks()
    plain = motor_log(given, "left")
    assert (plain["t_s"][:3], plain["input_V"][:3], plain["reference_mm"][0]) == (
        pytest.approx([0.0, 1e-3, 2e-3]),
        pytest.approx([0.0, 0.012, 0.024]),
        40.0,
    )
    # a tick without news, a lost one, one before the device was known
    order = np.array([0, 1, 2, *range(3, 50), *range(51, 200)])
    spoilt = {name: values[order].copy() for name, values in given.items()}
    spoilt["device_time_s"][2] = spoilt["device_time_s"][1]
    spoilt["left_mm"][2] = spoilt["left_mm"][1]
    spoilt["supply_V"][0] = np.nan
    log = motor_log(spoilt, "left")
    assert np.diff(log["t_s"]) == pytest.approx(1e-3)
    assert all(np.isfinite(values).all() for values in log.values())
    assert log["position_mm"] == pytest.approx(plain["position_mm"][1 : len(log["t_s"]) + 1], abs=1e-9)
    assert log["input_V"][0] == pytest.approx(0.024)
    assert log["input_V"][48] == log["input_V"][49]


def test_a_motor_log_with_a_hole_is_refused():
    given = ticks()
    given["device_time_s"] += 0.03 * (np.arange(200) > 100)
    with pytest.raises(CommandError, match="silence of 31 ms"):
        motor_log(given, "left")


class Played:
    def __init__(self, found) -> None:
        self._found = found
        self.progress = Progress()

    def follow(self, course):
        course.close()
        return self._found

    def play(self, waveform):
        assert waveform.at(0.0).force_N > 0.6
        return self._found


def test_the_log_file_has_the_columns_of_a_motor_log(fake_daemon, status_with, tmp_path, monkeypatch, ctl):
    monkeypatch.setattr(ctl_calibrate_motors, "armed", lambda *_: contextlib.nullcontext(Played(ticks(300))))
    slow = {name: rate | {"hz": 500.0} for name, rate in status_with()["rates"].items()}
    fake_daemon.says(setpoint_age_ms=None, least_N=0.6, most_N=4.0, rates=slow)
    out = tmp_path / "right.csv"
    arguments = [*fake_daemon.at, "--json", "calibrate", "--yes", "--motors", "--side", "right"]
    assert ctl(*arguments, "--out", str(out)).ended(1).error["code"] == "slow_control"
    fake_daemon.says(setpoint_age_ms=None, least_N=0.6, most_N=4.0)
    assert ctl(*arguments, "--out", str(out)).ended(0).result["rows"] == 299
    head, _, second, *_ = csv.reader(out.read_text().splitlines())
    assert (head, float(second[0]), float(second[2])) == (
        ["t_s", "input_V", "position_mm", "current_A", "force_N", "reference_mm"],
        0.001,
        30.0,
    )


@pytest.mark.parametrize(
    ("name", "age_ms", "state", "told", "asked"),
    [
        # one sends, the other's old setpoint is still valid
        (INSERT, 12.0, "stale", ("code", "other_publisher"), ["status"]),
        (INSERT, 20_000.0, "holds", ("code", "other_publisher"), ["status"]),
        ("MRE-99-99", None, "stale", ("message", "MRE-99-99"), []),
    ],
)
def test_a_second_publisher_and_an_unknown_insert_are_refused_before_anything_moves(
    fake_daemon, status_with, source_with, tmp_path, ctl, name, age_ms, state, told, asked
):
    setpoints = status_with()["setpoints"] | {"by_source": {"a": source_with(state=state)}}
    fake_daemon.says(setpoint_age_ms=age_ms, setpoints=setpoints)
    arguments = [*fake_daemon.at, "--json", "calibrate", "--yes", "--insert", name]
    assert told[1] in ctl(*arguments, "--out", str(tmp_path / "m.safetensors")).ended(1).error[told[0]]
    assert fake_daemon.commands == asked


def test_a_fit_is_the_commands_result_and_is_told(tmp_path, monkeypatch):
    fitted = {
        **{"model": "m", "insert": INSERT, "created": "today", "rows": 7},
        "metrics": {"judged_r2": 0.99, "judged_mae_N": 0.012, "most_mae_N": 0.02, "noise_mae_N": 0.003},
    }
    stand_ins = {name: MagicMock() for name in ("Client", "known_of", "armed", "write_sweeps")}
    for name, stand_in in {**stand_ins, "_ask_fitter": lambda *_: fitted}.items():
        monkeypatch.setattr(ctl_calibrate, name, stand_in)
    outcome = ctl_calibrate.calibrate_insert(
        MagicMock(), MagicMock(), MagicMock(), INSERT, tmp_path / "m.safetensors", None, (), False, 1.0
    )
    assert (outcome.result, "mean error 12.0 mN (allowed 20.0" in outcome.text) == (fitted, True)


def test_a_refused_fit_is_the_commands_refusal(tmp_path):
    path = tmp_path / "sweep.csv"
    rows = (f"{k * 1e-3},0,80,{k * 1e-3},0,1\n" for k in range(100))
    path.write_text(",".join(FILE_COLUMNS) + "\n" + "".join(rows))
    with pytest.raises(CommandError, match="handle moved for 0%") as refused:
        ctl_calibrate._ask_fitter(str(path), "--insert", INSERT, "--out", str(tmp_path / "m.safetensors"))
    assert (refused.value.code, list(tmp_path.iterdir())) == ("handle_still", [path])


# -- --device ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def calibrated(fake_daemon, monkeypatch, ctl):
    def run(**status):
        monkeypatch.setattr(
            calibrate_device,
            "armed",
            lambda *_: contextlib.nullcontext(
                Played([Finding("steps", mN, 0.0, "mN", -60.0, 60.0, "look") for mN in (-3.0, 10.0)])
            ),
        )
        monkeypatch.setattr(calibrate_device, "KEPT_WITHIN_S", 0.2)
        fake_daemon.says(**{"setpoint_age_ms": None, "least_N": 0.6} | status)
        return ctl(*fake_daemon.at, "--json", "calibrate", "--yes", "--device")

    return run


KEPT = {"is_used": True, "age_s": 0.1, "refusal": "", "folder": "/profiles"}


def test_a_device_is_learned_judged_and_kept(calibrated) -> None:
    result = calibrated(profile=KEPT).ended(0).result
    expected = {"scale": 1.0, "profile": "/profiles", "steps": 6, "worst_error_N": pytest.approx(0.01)}
    assert {name: result[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("status", "told"),
    [
        ({"profile": KEPT | {"folder": "", "refusal": "no folder is named for profiles"}}, "not_kept"),
        ({"profile": KEPT | {"refusal": "/profiles: Read-only file system"}}, "not_kept"),
        ({"profile": KEPT | {"age_s": 900.0}}, "not_kept"),
        (
            {"profile": KEPT, "limit_details": [{"code": "SENSOR", "cause": "it lies", "remedy": "look"}]},
            "sensor_doubted",
        ),
    ],
    ids=["no folder", "a full disk", "an old one only", "a sensor that lies"],
)
def test_what_taught_nothing_is_refused(calibrated, status, told) -> None:
    assert calibrated(**status).ended(1).error["code"] == told


# -- commission --------------------------------------------------------------------------------------------------------


def test_a_commissioning_keeps_findings_and_page_and_can_be_resumed(fake_daemon, monkeypatch, tmp_path, ctl) -> None:
    stopped = Stopped("steps", "handle_still", "the handle stood still", "turn it")
    monkeypatch.setattr(ctl_commission, "connected", lambda *_: contextlib.nullcontext(Played(stopped)))
    fake_daemon.says(setpoint_age_ms=None, least_N=0.6)
    command = [*fake_daemon.at, "--json", "commission", str(tmp_path), "--yes"]
    assert "nothing to resume" in ctl(*command, "--resume").ended(2).error["message"]
    kit = tmp_path / "kit.json"
    kit.write_text('{"checks": [{"name": "reset", "passed": false, "seen": "none", "expected": "one"}]}')
    result = ctl(*command, "--conformance", str(kit)).ended(1).result
    page = Path(result["page"]).read_text(encoding="utf-8")
    assert [words for words in ("Stopped in step steps", "turn it", "<td>reset</td>") if words not in page] == []
    assert ctl(*command, "--resume").ended(1).result["conformance"] == result["conformance"]
    described = fake_daemon.answers["describe"]()["result"]
    other = {"configuration": {"rates": {"control_hz": 1_000}, "motor": {"resistance_ohm": 2.5}}}
    fake_daemon.answers["describe"] = lambda: {"ok": True, "result": described | other}
    assert "[motor] has changed" in ctl(*command, "--resume").ended(2).error["message"]
    fake_daemon.answers["describe"] = lambda: {"ok": True, "result": described}
    ctl(*command[:-1]).ended(2)  # nobody agreed: the last findings stay
    assert Path(result["page"]).read_text(encoding="utf-8") == page
    kit.write_text("[]")
    assert "the kit prints" in ctl(*command, "--conformance", str(kit)).ended(2).error["hint"]
    report = Path(result["page"]).with_suffix(".json")
    report.write_text(report.read_text().replace('"serial_number": ', '"serial_number": 9'))
    assert "allowed is" in ctl(*command, "--resume").ended(2).error["message"]
    for broken in (b"{}", b'{"v": 1, "\xff": 1}'):
        Path(result["page"]).with_suffix(".json").write_bytes(broken)
        assert "is no report" in ctl(*command).ended(2).error["hint"]


def test_the_steps_that_are_run_are_numbered_one_by_one(monkeypatch, tmp_path, capsys) -> None:

    def finds_nothing(known):
        yield from ()
        return []

    monkeypatch.setattr(ctl_commission, "STEPS", [step._replace(course=finds_nothing) for step in STEPS])
    run = SimpleNamespace(progress=Progress(), follow=lambda course: next(course, None))
    kept = ctl_commission.Kept(tmp_path / "7.json", begun(None, 7, 0, None, Config().motor))
    kept.follow(run, course.Known(Config(), 1e-3, 0.6, 2.0, None))
    numbers = re.findall(r"step (\d) of (\d)", capsys.readouterr().err)
    assert numbers == [(str(number), "8") for number in range(1, 9)]


def test_who_ends_the_input_has_not_agreed_that_anything_moves(monkeypatch, terminal) -> None:
    monkeypatch.setattr(sys, "stdin", terminal("\n"))
    agree()
    with pytest.raises(CommandError, match="nobody agreed"):
        agree()
