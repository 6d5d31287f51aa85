"""The daemon as its users meet it: real processes, a real pty, real sockets. Nothing here asserts a duration."""

import json
import math
import random
import signal
import subprocess
import sys

import msgpack
import numpy as np
import pytest
from jsonschema import Draft202012Validator
from mcap.reader import make_reader

from tormagd.ctl.main import main
from tormagd.recording.reader import read_recording

pytestmark = pytest.mark.live

HOSTILE_VALUES = [math.nan, math.inf, -math.inf, -0.1, 1e9, "1.5", None, [1.0], {"N": 1.0}, True]


def raw_setpoint(**changes):
    """A valid setpoint as a plain map, with some of it changed; a value of `...` leaves the key out."""
    fields = {"v": 1, "source": "hostile", "seq": 1, "stamp_ns": 0, "servo_cf": 1.0, "valid_for_ms": 100.0} | changes
    return msgpack.packb({name: value for name, value in fields.items() if value is not ...})


def test_force_follows_the_setpoint(rig):
    rig.arm()
    for force_N in (1.0, 1.6):
        rig.ask(force_N)
        rig.until(lambda asked=force_N: abs((rig.telemetry().measured_cf or 0.0) - asked) < 0.06, f"{force_N} N")
    newest = rig.telemetry()
    assert newest.operating_state == "ENABLED"
    assert newest.setpoint_cf == 1.6
    assert abs(newest.skew_mm) < 0.05


def test_below_the_least_force_says_so(rig):
    rig.arm()
    rig.ask(0.1)
    rig.until(lambda: "F_MIN" in rig.telemetry().limits, "F_MIN shown")
    newest = rig.telemetry()
    # both are what the device has shown by then, a moment apart
    assert newest.governed_cf == pytest.approx(rig.status()["least_N"], abs=5e-3)
    explained = {detail["code"]: detail["remedy"] for detail in rig.status()["limit_details"]}
    assert explained["F_MIN"]


def test_stale_setpoint_decays_to_the_least_force(rig):
    rig.arm()
    rig.ask(1.5)
    rig.until(lambda: (rig.telemetry().governed_cf or 0.0) == 1.5, "governed")
    rig.ask(1.5, valid_for_ms=50.0)
    rig.until(lambda: "STALE" in rig.telemetry().limits, "STALE shown")
    least_N = rig.status()["least_N"]
    rig.until(lambda: rig.telemetry().governed_cf < least_N + 0.01, "decayed")
    assert rig.telemetry().operating_state == "ENABLED"


def test_enable_is_refused_until_the_setpoint_is_neutral(rig):
    rig.arm()
    rig.done("disable")
    rig.ask(1.5)
    rig.until(lambda: rig.telemetry().setpoint_cf == 1.5 and not rig.status()["is_busy"], "setpoint seen")
    reply = rig.command("enable")
    assert not reply.ok
    assert reply.error.code == "not_neutral"
    rig.ask(0.5)
    rig.until(lambda: rig.telemetry().setpoint_cf == 0.5, "setpoint seen")
    rig.until(lambda: rig.command("enable").ok, "enabled")


def test_home_is_seen_as_busy_at_once_and_nothing_is_enabled_on_top_of_it(rig):
    rig.arm()
    rig.done("disable")
    rig.until(lambda: not rig.status()["is_busy"], "open")
    home, enable, status = rig.burst("home", "enable", "status")
    assert home.ok
    assert enable.error.code == "busy"
    assert status.result["is_busy"]
    rig.until(lambda: rig.status()["is_homed"] and not rig.status()["is_busy"], "homed")
    assert rig.status()["faults"] == []


def test_a_second_daemon_is_refused_and_the_first_goes_on(rig):
    ended = subprocess.run(
        [sys.executable, "-m", "tormagd.daemon.main", "--config", str(rig.config)],
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
    )
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith("tormagd: endpoints.setpoint = 'ipc://")
    assert f": already running, pid {rig.daemon.pid}; end it, or name other" in ended.stderr
    rig.arm()
    rig.ask(0.7)
    rig.until(lambda: rig.telemetry().setpoint_cf == 0.7, "setpoints are heard")


def test_killed_daemon_leaves_an_open_gap_and_a_latched_reason(new_rig):
    new_rig.arm()
    new_rig.ask(1.6)
    new_rig.until(lambda: abs((new_rig.telemetry().measured_cf or 0.0) - 1.6) < 0.1, "1.6 N")
    assert new_rig.end(new_rig.daemon, signal.SIGKILL) == -signal.SIGKILL
    new_rig.start_daemon()
    new_rig.until(lambda: new_rig.status()["faults"] == ["DEVICE_COMMAND_TIMEOUT"], "the reason is reported")
    assert new_rig.command("enable").error.code == "fault"
    new_rig.until(lambda: not new_rig.status()["is_busy"], "the gap is open")
    new_rig.done("clear-fault")
    new_rig.until(lambda: new_rig.status()["faults"] == [], "cleared")
    assert new_rig.command("enable").error.code == "not_homed"
    new_rig.arm()
    new_rig.end(new_rig.daemon, signal.SIGTERM)
    truth = new_rig.truth()
    closed = truth["gap_mm"].min()
    assert closed < 70.0
    assert truth["gap_mm"][-1] > 94.0


def test_sigterm_opens_the_gap_and_exits_in_order(new_rig):
    new_rig.arm()
    new_rig.ask(1.6)
    new_rig.until(lambda: abs((new_rig.telemetry().measured_cf or 0.0) - 1.6) < 0.1, "1.6 N")
    assert new_rig.end(new_rig.daemon, signal.SIGTERM) == 0
    assert new_rig.truth()["gap_mm"][-1] > 94.0
    assert not (new_rig.folder / "setpoint").exists()


def test_a_device_that_has_shown_itself_is_known_the_next_time(new_rig):
    assert not new_rig.status()["profile"]["is_used"]
    new_rig.arm()
    new_rig.ask(1.6)
    new_rig.until(lambda: abs((new_rig.telemetry().measured_cf or 0.0) - 1.6) < 0.05, "1.6 N")
    assert new_rig.end(new_rig.daemon, signal.SIGTERM) == 0
    assert len(list((new_rig.folder / "profiles").iterdir())) == 1
    new_rig.start_daemon()
    new_rig.until(lambda: new_rig.status()["profile"]["is_used"], "the profile is used")
    again = new_rig.status()
    assert again["device"]["scale_sd"] < 0.1
    assert again["profile"]["age_s"] < 3600.0


def test_send_says_whether_a_real_daemon_renders_it(rig, capsys):
    sine = ["--config", str(rig.config), "--wait", "30", "--json", "send", "sine", "--duration", "0.5"]
    assert main(sine) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "disabled"
    assert main([*sine, "--to-N", "2.5"]) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "out_of_range"
    rig.arm()
    rig.ask(1.5)  # it holds the brake for half a minute
    rig.until(lambda: rig.status()["setpoints"]["newest_source"] == "test", "held")
    assert main(sine) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "other_source"
    rig.ask(1.5, valid_for_ms=1.0)
    # on a busy machine a publisher may be late, and says so
    rig.until(lambda: main(sine) == 0, "rendered")
    result = json.loads(capsys.readouterr().out.splitlines()[-1])["result"]
    assert result["accepted"] == result["sent"]
    rig.done("stop")
    assert main(sine) == 4
    assert json.loads(capsys.readouterr().out)["error"]["message"].startswith("the device is in FAULT: STOPPED")


def test_a_real_recording_is_whole_says_what_it_is_of_and_outlives_the_daemon(new_rig):
    path = new_rig.folder / "a.mcap"
    ctl = [sys.executable, "-m", "tormagd.ctl.main", "--config", str(new_rig.config), "--wait", "30"]
    recorder = subprocess.Popen([*ctl, "record", str(path)])
    try:
        new_rig.until(path.exists, "recording")
        new_rig.arm()
        new_rig.ask(1.6)
        new_rig.until(lambda: abs((new_rig.telemetry().measured_cf or 0.0) - 1.6) < 0.1, "1.6 N")
        newest = new_rig.telemetry()
        new_rig.daemon.kill()
        new_rig.daemon.wait()
        new_rig.end(recorder, signal.SIGINT)
    finally:
        recorder.kill()
        recorder.wait()
    recording = read_recording(path)
    assert recording.is_complete
    assert recording.ticks.t_ns[-1] >= newest.t_ns
    for numbers in (recording.ticks.numbers["tick"], recording.telemetry.numbers["seq"]):
        assert np.array_equal(np.diff(numbers), np.ones(numbers.size - 1))
    about = recording.metadata
    assert json.loads(about["configuration"])["device"]["port"] == str(new_rig.port)
    assert json.loads(about["scene"])["name"] == "coronary"
    assert (len(about["model"]), about["firmware"]) == (64, "1.0")
    assert int(about["serial_number"]) >= 0
    assert json.loads(about["profile"])["is_used"] is False
    validators = {}
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            if schema.id not in validators:
                validators[schema.id] = Draft202012Validator(json.loads(schema.data))
            # one in a while, for it takes 10 ms
            if message.sequence % 500 == 0:
                validators[schema.id].validate(json.loads(message.data))
    assert len(validators) == 2


def test_stop_opens_and_latches(rig):
    rig.arm()
    rig.ask(1.5)
    rig.until(lambda: (rig.telemetry().gap_mm or 95.0) < 72.0, "closing")
    rig.done("stop")
    rig.until(lambda: rig.telemetry().operating_state == "FAULT" and (rig.telemetry().gap_mm or 0.0) > 94.0, "open")
    assert rig.status()["fault_details"][0]["code"] == "STOPPED"
    rig.until(lambda: not rig.status()["is_busy"], "at rest")
    rig.done("clear-fault")
    assert rig.status()["operating_state"] == "DISABLED"


def test_hostile_setpoints_are_refused_counted_and_do_not_disturb(rig):
    rig.arm()
    rig.ask(1.5)
    rig.until(lambda: abs((rig.telemetry().measured_cf or 0.0) - 1.5) < 0.1, "1.5 N")
    before = rig.status()["setpoints"]
    noise = random.Random(7)
    messages = [raw_setpoint(servo_cf=value) for value in HOSTILE_VALUES]
    messages += [raw_setpoint(valid_for_ms=value) for value in (0.0, -1.0, math.nan, "1")]
    messages += [raw_setpoint(**{name: ...}) for name in ("v", "source", "seq", "stamp_ns", "servo_cf")]
    messages += [raw_setpoint(v=2), raw_setpoint(source="x" * 65), raw_setpoint(stamp_ns=2**62)]
    messages += [noise.randbytes(noise.randrange(200)) for _ in range(200)]
    for data in messages:
        rig.publish(data)
    rig.until(lambda: rig.status()["setpoints"]["refused"] >= before["refused"] + len(messages), "all refused")
    after = rig.status()
    assert after["setpoints"]["refused"] == before["refused"] + len(messages)
    assert after["setpoints"]["accepted"] == before["accepted"]
    assert after["setpoints"]["last_refusal"]
    rig.publish(bytes(10_000_000))
    rig.until(lambda: rig.status()["setpoints"]["oversize"] == before["oversize"] + 1, "oversize counted")
    newest = rig.telemetry()
    assert newest.operating_state == "ENABLED"
    assert newest.setpoint_cf == 1.5
    assert abs(newest.measured_cf - 1.5) < 0.1


def test_unplugged_device_is_a_named_fault_and_comes_back_without_re_arming(new_rig):
    new_rig.arm()
    new_rig.ask(1.5)
    new_rig.until(lambda: (new_rig.telemetry().gap_mm or 95.0) < 72.0, "closing")
    new_rig.end(new_rig.simulator, signal.SIGKILL)
    new_rig.until(lambda: "LINK_LOST" in new_rig.status()["faults"], "the loss is named")
    assert new_rig.status()["link"]["cause"]
    new_rig.start_simulator()
    new_rig.until(lambda: new_rig.status()["link"]["state"] == "RUNNING", "the link runs again")
    assert new_rig.status()["operating_state"] == "FAULT"
    new_rig.until(lambda: not new_rig.status()["is_busy"], "the returned device has opened")
    new_rig.done("clear-fault")
    new_rig.ask(0.5)
    new_rig.until(lambda: new_rig.telemetry().setpoint_cf == 0.5, "neutral again")
    new_rig.arm()


def test_the_black_box_of_a_fault_is_run_again_bit_for_bit(rig):
    """By another process, of a run in real time: whatever was late in it, the core gives the same again."""
    rig.arm()
    for force_N in (1.0, 1.5):
        rig.ask(force_N)
        rig.until(lambda asked=force_N: rig.telemetry().governed_cf == asked, "governed")
    rig.done("stop")
    rig.until(lambda: rig.status()["black_box"]["newest"].endswith("-STOPPED.mcap"), "written")
    box = rig.status()["black_box"]
    path = rig.folder / "boxes" / box["newest"]
    command = [sys.executable, "-m", "tormagd.replay", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120.0)
    result = json.loads(done.stdout)
    assert (result["reason"], result["differences"]) == ("STOPPED", [])
    assert result["rerun"]["difference"] is None
    assert result["rerun"]["frames"] > 2 * result["rerun"]["ticks"] > 2_000
    assert result["rerun"]["gaps"] <= box["dropped"]
