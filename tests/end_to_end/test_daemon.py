"""The daemon as its users meet it: real processes, a real pty, real sockets.

Its loops are tested in virtual time (tests/daemon/test_running_daemon.py, tests/closed_loop). Here processes are
killed, unplugged and started again, and another one reads what they leave.
"""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tormagd.ctl.processes import end
from tormagd.record.reader import Shown, read_recording

pytestmark = pytest.mark.live

README = Path(__file__).parents[2] / "README.md"


def test_a_daemon_that_is_killed_unplugged_and_ended(rig):
    assert not rig.status()["profile"]["is_used"]
    killed_it_leaves_a_whole_recording(rig)
    started_again_it_says_why_the_device_has_opened(rig)
    unplugged_it_names_the_loss_and_does_not_arm_again(rig)
    told_to_end_it_opens_the_gap_and_keeps_what_the_device_has_shown(rig)


def killed_it_leaves_a_whole_recording(rig) -> None:
    path = rig.folder / "a.mcap"
    ctl = [sys.executable, "-m", "tormagd.ctl.main", "--config", str(rig.config), "--wait", "30"]
    recorder = subprocess.Popen([*ctl, "record", str(path)])
    try:
        rig.until(lambda _status: path.exists(), "recording")
        rig.arm()
        rig.render(1.6)
        newest = rig.status()
        rig.until(lambda status: status["t_ns"] > newest["t_ns"] + 100_000_000, "what it has told is on its way")
        assert end(rig.daemon, signal.SIGKILL) == -signal.SIGKILL
        end(recorder, signal.SIGINT)
    finally:
        recorder.kill()
        recorder.wait()
    seen: list[Shown] = []
    recording = read_recording(path, dict[str, Any], seen.append)
    assert recording.is_complete
    assert max(each.t_ns for each in seen if each.is_tick) >= newest["t_ns"]
    for is_tick, name in ((True, "tick"), (False, "seq")):
        numbers = [each.message[name] for each in seen if each.is_tick is is_tick]
        assert np.array_equal(np.diff(numbers), np.ones(len(numbers) - 1))
    about = recording.metadata
    assert json.loads(about["configuration"])["device"]["port"] == str(rig.folder / "device")
    assert json.loads(about["scene"])["name"] == "coronary"
    assert (len(about["model"]), about["firmware"]) == (64, "1.0")
    assert int(about["serial_number"]) >= 0
    assert json.loads(about["profile"])["is_used"] is False


def started_again_it_says_why_the_device_has_opened(rig) -> None:
    rig.start_daemon()
    rig.until(lambda status: status["faults"] == ["DEVICE_COMMAND_TIMEOUT"], "the reason is reported")
    assert rig.refused("enable") == "fault"
    rig.until(lambda status: not status["is_busy"], "the gap is open")
    rig.client.request("clear-fault")
    rig.until(lambda status: status["faults"] == [], "cleared")
    assert rig.refused("enable") == "not_homed"


def unplugged_it_names_the_loss_and_does_not_arm_again(rig) -> None:
    rig.arm()
    rig.ask(1.5)
    rig.until(lambda status: (status["gap_mm"] or 95.0) < 85.0, "closing")
    end(rig.device, signal.SIGKILL)
    lost = rig.until(lambda status: "LINK_LOST" in status["faults"], "the loss is named")
    assert lost["link"]["cause"]
    rig.plug_in("serial")
    back = rig.until(lambda status: status["link"]["state"] == "RUNNING" and not status["is_busy"], "it has opened")
    assert back["operating_state"] == "FAULT"
    rig.client.request("clear-fault")
    assert rig.status()["operating_state"] == "DISABLED"


def told_to_end_it_opens_the_gap_and_keeps_what_the_device_has_shown(rig) -> None:
    rig.client.publish(0.5, 30_000.0)
    rig.arm()
    rig.render(1.6)
    assert end(rig.daemon, signal.SIGTERM) == 0
    assert not (rig.folder / "setpoint").exists()
    assert len(list((rig.folder / "profiles").iterdir())) == 1
    rig.start_daemon()
    rig.until(lambda status: status["profile"]["is_used"], "the profile is used")
    again = rig.status()
    assert again["device"]["scale_sd"] < 0.1
    assert again["profile"]["age_s"] < 3600.0
    gap_mm = rig.truth()["gap_mm"]
    assert gap_mm.min() < 70.0
    assert gap_mm[-1] > 94.0


def test_the_black_box_of_a_fault_is_run_again_bit_for_bit(rig):
    rig.arm()
    for force_N in (1.0, 1.5):
        rig.render(force_N)
    rig.client.request("stop")
    rig.until(lambda status: status["black_box"]["newest"].endswith("-STOPPED.mcap"), "written")
    box = rig.status()["black_box"]
    replay = [sys.executable, "-m", "tormagd.ctl.main", "--json", "replay", str(rig.folder / "boxes" / box["newest"])]
    result = json.loads(subprocess.check_output(replay, text=True, timeout=120.0))["result"]
    assert (result["reason"], result["differences"]) == ("STOPPED", [])
    assert result["rerun"]["difference"] is None
    # one piece read and one frame written in nearly every period
    assert result["rerun"]["frames"] > 1.9 * result["rerun"]["ticks"] > 2_000
    assert result["rerun"]["gaps"] <= box["dropped"]


def test_the_client_in_the_readme_sees_the_force_follow(rig, tmp_path):
    (script,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(script.splitlines()) <= 18
    profile = tmp_path / "profile.csv"
    rows = [(k * 0.02, 0.6 + min(k * 0.01, 0.9)) for k in range(150)]
    profile.write_text("t_s,force_N\n" + "".join(f"{t:.3f},{force:.3f}\n" for t, force in rows))
    done = subprocess.run(
        [sys.executable, "-c", script, str(rig.folder), str(profile)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    lines = [line.split() for line in done.stdout.splitlines() if " asked " in line]
    assert len(lines) > 50
    assert lines[-1][-1] == "ENABLED"
    asked, measured = float(lines[-1][2]), float(lines[-1][4])
    assert asked == 1.5
    assert abs(measured - asked) < 0.08
