"""`tormagctl calibrate` over real processes: an interrupted run, and sweeps of the (simulated) insert."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.live


def test_an_interrupt_leaves_no_file_and_an_insert_is_swept(rig, tmp_path):
    program = [sys.executable, "-m", "tormagd.ctl.main", "--config", str(rig.config), "--wait", "20", "--json"]
    command = [*program, "calibrate", "--yes"]
    an_interrupt_opens_the_gap_and_leaves_no_file(rig, [*command, "--motors"], tmp_path / "log.csv")
    rig.until(lambda status: status["setpoint_age_ms"] > 1_000.0, "nobody else publishes")
    out = tmp_path / "sweeps.csv"
    arguments = ("--insert", "MRE-50-40", "--out", str(out), "--rates", "1.0,1.4,1.0")
    # the sweep begins at the least force that this device has shown, and a rested one gives less than its model says
    rig.until(lambda status: status["least_N"] < 0.6, "the device has shown itself")
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr.count("turn the handle") == 3
    _, sweep, gap_mm, _, rate_mm_s, force_N = np.loadtxt(out, delimiter=",", skiprows=1).T
    assert len(sweep) == json.loads(done.stdout)["result"]["rows"]
    assert set(sweep) == {0.0, 1.0, 2.0}
    assert np.corrcoef(gap_mm, force_N)[0, 1] < -0.8
    assert np.mean(np.abs(rate_mm_s) > 5.0) > 0.3
    is_disabled_and_open(rig)


def an_interrupt_opens_the_gap_and_leaves_no_file(rig, command, out) -> None:
    running = subprocess.Popen([*command, "--out", str(out)], stdout=subprocess.PIPE, text=True)
    try:
        rig.until(lambda status: (status["gap_mm"] or 95.0) < 90.0, "the carriages move")
        running.send_signal(signal.SIGINT)
        printed, _ = running.communicate(timeout=120)
    finally:
        running.kill()
    assert running.returncode == 1
    assert json.loads(printed)["error"]["code"] == "interrupted"
    assert not out.exists()
    is_disabled_and_open(rig)


def is_disabled_and_open(rig) -> None:
    rig.until(lambda status: (status["gap_mm"] or 0.0) > 94.0, "the gap is open")
    assert rig.status()["operating_state"] == "DISABLED"
