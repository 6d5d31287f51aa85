"""The guides' worked examples run as printed, on a synthetic excerpt of what they fetch or measure."""

import re
import subprocess
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.io import savemat

from tormag_lab.main import main as lab
from tormag_lab.training.dataset import Dataset, write_csv
from tormag_lab.training.law import START
from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.ctl.main import main as ctl
from tormagd.element.physics.inserts import insert
from tormagd.scenes.scene import load_scene

GUIDES = Path(__file__).parents[2] / "docs" / "guides"
FETCHED = ("curl ", "tormag-lab bench-sweep ")
"Each test puts an excerpt in their place."


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(page: str, *more: str) -> None:
    [block] = re.findall(r"^(?:### An|An) example.*?^```\n(.*?)^```", (GUIDES / page).read_text(), re.M | re.S)
    lines = [line for line in block.splitlines() if not line.startswith(FETCHED)]
    for line in lines:
        words = line.split() + list(more if line is lines[-1] else ())
        if words[0] in ("tormagctl", "tormag-lab"):
            assert (ctl if words[0] == "tormagctl" else lab)(words[1:]) == 0, line
        else:
            subprocess.run(["sh", "-ec", line], check=True)


def test_a_force_recording_becomes_a_scene(here: Path) -> None:
    torque = [-470.0 - 150.0 * np.sin(0.6 * k * 1e-3) for k in range(5000)]
    rows = [f"{1e-3 * k:.3f},0,0,0,0,{value:.2f},0,0,0,0" for k, value in enumerate(torque)]
    (here / "01.TXT").write_text("\n".join(["% a tool, 10 columns", *rows]))
    run("scene.md")
    scene = load_scene("tool.toml")
    assert (scene.force.least_N, scene.insert.name) == (pytest.approx(0.92, abs=0.03), "MRE-10-10")


def test_cycles_become_a_model_of_the_inserts_law_that_a_scene_takes(here: Path) -> None:
    fitted, rng, count = insert("MRE-30-20"), np.random.default_rng(0), 400
    rates = np.exp(rng.uniform(np.log(0.5), np.log(310.0), count))
    features = np.column_stack((np.full(count, 2.0), rates, rng.uniform(100.0, 600.0, count), np.full(count, 20.0)))
    force_N = START.forces_N(features, fitted) + rng.normal(0.0, 0.01, count)
    write_csv("cycles.csv", Dataset(features, force_N, np.arange(count) // 40, np.tile(np.arange(40) * 0.1, 10)))
    run("insert.md", "--epochs", "60", "--hidden", "20")
    coronary = load_scene("coronary")
    named = msgspec.structs.replace(coronary.insert, name="MRE-30-20", model="mine.safetensors")
    force = msgspec.structs.replace(coronary.force, most_N=1.5)
    core = build_core(Config(), msgspec.structs.replace(coronary, insert=named, force=force), here)
    middle = core.element.nominal.curve(2.0, 42.0)
    truth_N = START.forces_N(np.array([[2.0, 42.0, 300.0, 20.0]]), fitted)[0]
    assert middle.force_N(300.0) == pytest.approx(truth_N, abs=0.01)


def test_a_motor_log_becomes_a_motor(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time_s = np.arange(0.0, 20.0, 1e-3)
    sizes, turns = np.array([0.06, 0.02, 0.004]), 2.0 * np.pi * np.array([0.23, 0.61, 1.7])
    sines, cosines = np.sin(np.outer(turns, time_s)), np.cos(np.outer(turns, time_s))
    position_m, speed, acceleration = sizes @ sines, (sizes * turns) @ cosines, -(sizes * turns**2) @ sines
    volts = (95.0 * acceleration + 200.0 * speed + 20.0 * np.sign(speed)) / 35.0
    noise = np.random.default_rng(0).normal(0.0, 0.02, len(time_s))
    savemat("DATA_EMPS.mat", {"t": time_s, "qm": position_m, "vir": volts + noise, "gtau": 35.0})
    run("tune.md", "--json")
    assert msgspec.json.decode(capsys.readouterr().out)["parameters"]["mass_kg"]["value"] == pytest.approx(
        95.0, rel=0.03
    )
