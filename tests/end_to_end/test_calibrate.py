"""`tormagctl calibrate` over real processes: an interrupted run, and a model of the (simulated) insert."""

import json
import signal
import subprocess
import sys

import pytest

from tormagd.element.model.model_file import load_model
from tormagd.lab.training.dataset import read_csv

pytestmark = pytest.mark.live


def test_an_interrupt_leaves_no_file_and_a_sweep_becomes_a_model_that_says_what_it_is(new_rig, tmp_path):
    program = [sys.executable, "-m", "tormagd.ctl.main", "--config", str(new_rig.config), "--wait", "20", "--json"]
    command = [*program, "calibrate", "--yes"]
    an_interrupt_opens_the_gap_and_leaves_no_file(new_rig, [*command, "--motors"], tmp_path / "log.csv")
    new_rig.until(lambda: new_rig.status()["setpoint_age_ms"] > 1_000.0, "nobody else publishes")
    out, data = tmp_path / "model.safetensors", tmp_path / "training.csv"
    arguments = ("--insert", "MRE-50-40", "--out", str(out), "--csv", str(data), "--rates", "1.0,1.4,1.0")
    # the sweep begins at the least force that this device has shown, and a rested one gives less than its model says
    new_rig.until(lambda: new_rig.status()["least_N"] < 0.6, "the device has shown itself")
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    metrics = json.loads(done.stdout)["result"]["metrics"]
    assert done.stderr.count("turn the handle") == 3
    assert metrics["judged_r2"] > 0.97
    assert metrics["noise_mae_N"] == pytest.approx(0.008, rel=0.25)  # sample 1: sd 10 mN
    model = load_model(out, element="torque", insert="MRE-50-40")
    assert model.metadata.metrics == metrics
    assert model.metadata.training_data_sha256 == read_csv(data).sha256()
    low, high = model.field_range_mT
    assert low < 320.0
    assert high > 480.0
    is_disabled_and_open(new_rig)


def an_interrupt_opens_the_gap_and_leaves_no_file(rig, command, out) -> None:
    running = subprocess.Popen([*command, "--out", str(out)], stdout=subprocess.PIPE, text=True)
    try:
        rig.until(lambda: (rig.status()["gap_mm"] or 95.0) < 90.0, "the carriages move")
        running.send_signal(signal.SIGINT)
        printed, _ = running.communicate(timeout=120)
    finally:
        running.kill()
    assert running.returncode == 1
    assert json.loads(printed)["error"]["code"] == "interrupted"
    assert not out.exists()
    is_disabled_and_open(rig)


def is_disabled_and_open(rig) -> None:
    rig.until(lambda: (rig.status()["gap_mm"] or 0.0) > 94.0, "the gap is open")
    assert rig.status()["operating_state"] == "DISABLED"
