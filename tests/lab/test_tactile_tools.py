"""The pad's tools: what neighbours decide is measured, and a model is trained that a scene takes."""

import datetime
from pathlib import Path

import pytest
import tactile_branches
import tactile_model

from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.model.model_file import save_model
from tormagd.scenes.scene import scene_path


def test_neighbours_decide_on_the_pad_and_nothing_on_the_brake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tactile_branches, "CONTACTS", 6)
    monkeypatch.setattr(tactile_branches, "STEPS", 150)
    pad, brake = (tactile_branches.measured(name)["rows"] for name in ("pad", "brake"))
    one, sixteen = (next(row for row in pad if row["search"] == f"nearest, {count} neighbours") for count in (1, 16))
    forgetful = next(row for row in pad if row["search"].endswith("last field unknown"))
    assert one["travel"] > 1.2 * sixteen["travel"]
    assert one["other_answers"] > 0.02 > sixteen["jump_share"]
    assert forgetful["jump_share"] > sixteen["jump_share"]
    assert all(row["worst_force_error_N"] < 1e-3 for row in pad)
    assert all(row["other_answers"] == 0.0 for row in brake if row["search"].startswith("nearest"))


def test_a_pads_model_is_trained_and_taken_by_a_scene(tmp_path: Path) -> None:
    effort = tactile_model.Effort(samples_per_cycle=8, hold_samples=80, epochs=8, settling_epochs=2)
    model = tactile_model.trained("pad_1", effort, datetime.date(2026, 11, 22))
    assert sum(model.metadata.memory.fractions) == pytest.approx(0.108, abs=0.03)
    assert model.metadata.metrics["unseen_holds_share"] < 0.1
    save_model(tmp_path / "mine.safetensors", model)
    text = Path(scene_path("radial_pulse")).read_text().replace('"tactile_mre_c"', '"mine.safetensors"')
    (tmp_path / "scene.toml").write_text(text.replace('file = "radial_pulse.csv"', "bandwidth_hz = 0.1"))
    assert build_core(Config(scene=str(tmp_path / "scene.toml"))).model == model.fingerprint
