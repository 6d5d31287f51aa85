"""Calibrating: what is recorded of an insert and a motor, what a device has learned, and commissioning."""

import contextlib
import csv
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tormagd.commission import procedure as course
from tormagd.commission.finding import Finding
from tormagd.commission.sequence import STEPS, Stopped, begun
from tormagd.config import Config
from tormagd.ctl import calibrate as ctl_calibrate, commission as ctl_commission
from tormagd.ctl.calibrate import MOTOR_COLUMNS, SWEEP_COLUMNS, SWEPT_COLUMNS, agree, motor_log, write_sweeps
from tormagd.ctl.calibrate_run import Progress, armed
from tormagd.ctl.outcome import CommandError
from tormagd.element.model.displacement import MOVING_MM_S
from tormagd_client import Client, ClientError
from tormagd_client.endpoints import in_folder

INSERT = "MRE-50-40"


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


def test_the_log_file_has_the_columns_of_a_motor_log(fake_daemon, tmp_path, monkeypatch, ctl):
    monkeypatch.setattr(ctl_calibrate, "armed", lambda *_: contextlib.nullcontext(Played(ticks(300))))
    fake_daemon.says(setpoint_age_ms=None, least_N=0.6, most_N=4.0, rates={"control": {"hz": 500.0}})
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
    ("name", "age_ms", "state", "told", "asked", "ended"),
    [
        # one sends, the other's old setpoint is still valid
        (INSERT, 12.0, "stale", ("code", "other_publisher"), ["status"], 1),
        (INSERT, 20_000.0, "holds", ("code", "other_publisher"), ["status"], 1),
        ("MRE-99-99", None, "stale", ("message", "MRE-99-99"), [], 2),
    ],
)
def test_a_second_publisher_and_an_unknown_insert_are_refused_before_anything_moves(
    fake_daemon, source_with, tmp_path, ctl, name, age_ms, state, told, asked, ended
):
    fake_daemon.says(setpoint_age_ms=age_ms, setpoints={"by_source": {"a": source_with(state=state)}})
    arguments = [*fake_daemon.at, "--json", "calibrate", "--yes", "--insert", name]
    assert told[1] in ctl(*arguments, "--out", str(tmp_path / "sweeps.csv")).ended(ended).error[told[0]]
    assert fake_daemon.commands == asked


def test_the_sweeps_are_a_table_for_the_laboratory(tmp_path):
    sweep = dict.fromkeys(SWEPT_COLUMNS, np.arange(9.0))
    assert write_sweeps(tmp_path / "sweeps.csv", [sweep, sweep | {"measured_cf": np.array([np.nan, *range(8)])}]) == 5
    head, *rows = csv.reader((tmp_path / "sweeps.csv").read_text().splitlines())
    assert (tuple(head), rows[1], rows[3]) == (
        SWEEP_COLUMNS,
        ["4", "0", "8", "4", "4", "4"],
        ["1", "1", "2", "1", "1", "0"],
    )
    assert course.MOVING_MM_S == MOVING_MM_S


# -- --device ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def calibrated(fake_daemon, monkeypatch, ctl):
    def run(**status):
        monkeypatch.setattr(
            ctl_calibrate,
            "armed",
            lambda *_: contextlib.nullcontext(
                Played([Finding("steps", mN, 0.0, "mN", -60.0, 60.0, "look") for mN in (-3.0, 10.0)])
            ),
        )
        monkeypatch.setattr(ctl_calibrate, "KEPT_WITHIN_S", 0.2)
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
    assert re.findall(r"step (\d) of (\d)", capsys.readouterr().err) == [(str(number), "8") for number in range(1, 9)]


def test_who_ends_the_input_has_not_agreed_that_anything_moves(monkeypatch, terminal) -> None:
    monkeypatch.setattr(sys, "stdin", terminal("\n"))
    agree()
    with pytest.raises(CommandError, match="nobody agreed"):
        agree()


def test_a_device_that_is_not_homed_is_homed_first(fake_daemon):
    fake_daemon.says(is_homed=False)
    fake_daemon.refuse("home", "busy")
    endpoints = in_folder(str(fake_daemon.directory))
    with Client(endpoints, 20.0) as client, pytest.raises(ClientError, match="cannot home"):
        armed(endpoints, client, 1.0).__enter__()
    assert [command for command in fake_daemon.commands if command != "status"] == ["home", "disable"]
