"""The pad's tools: what neighbours decide is measured, and a model is trained that a scene takes."""

import datetime
from dataclasses import replace
from pathlib import Path

import pytest

from tormagd.assembly.build import build_core
from tormagd.config import Config
from tormagd.lab.tactile import branches, shipped
from tormagd.lab.tactile.models import QUICK
from tormagd.model.model_file import save_model
from tormagd.scenes.scene import scene_path


def test_neighbours_decide_on_the_pad_and_nothing_on_the_brake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(branches, "CONTACTS", 6)
    monkeypatch.setattr(branches, "STEPS", 150)
    found = branches.measured()
    pad, brake = ({row["neighbours"]: row for row in found[name]["rows"]} for name in ("pad", "brake"))
    assert pad[1]["travel"] > 1.2 * pad[16]["travel"]
    assert pad[1]["other_answers"] > 0.02 > pad[16]["jump_share"]
    assert all(row["worst_force_error_N"] < 1e-3 for row in pad.values())
    assert all(row["other_answers"] == 0.0 for row in brake.values())
    assert len(pad) == len(brake) == len(branches.NEIGHBOURS)


def test_a_pads_model_is_trained_and_taken_by_a_scene(tmp_path: Path) -> None:
    effort = replace(QUICK, samples_per_cycle=8, hold_samples=80, pad_epochs=8, settling_epochs=2)
    model = shipped.trained("pad_1", effort, datetime.date(2026, 11, 22))
    assert sum(model.metadata.memory.fractions) == pytest.approx(0.108, abs=0.03)
    assert model.metadata.metrics["unseen_holds_share"] < 0.1
    save_model(tmp_path / "mine.safetensors", model)
    text = Path(scene_path("radial_pulse")).read_text().replace('"tactile_mre_c"', '"mine.safetensors"')
    (tmp_path / "scene.toml").write_text(text.replace('file = "radial_pulse.csv"', "bandwidth_hz = 0.1"))
    assert build_core(Config(scene=str(tmp_path / "scene.toml"))).model == model.fingerprint
