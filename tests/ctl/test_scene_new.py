"""`scene new`: what it makes of a recorded force, or of answers, the daemon takes; what can be no scene is told."""

import io
import math
import sys
from pathlib import Path

import pytest

from tormagd.ctl.main import main
from tormagd.scenes.scene import load_scene


def recording(path: Path, least_N: float, most_N: float, rate_hz: float) -> Path:
    """A sine of 20 s between two forces."""
    middle, half = (least_N + most_N) / 2.0, (most_N - least_N) / 2.0
    rows = [f"{0.02 * n:.2f},{middle - half * math.cos(0.04 * math.pi * rate_hz * n):.5f}" for n in range(1000)]
    path.write_text("t_s,force_N\n" + "\n".join(rows) + "\n")
    return path


def test_a_recorded_force_becomes_a_scene_with_the_softest_insert_that_renders_it(tmp_path, ctl):
    forces = recording(tmp_path / "forces.csv", 0.31, 0.62, 0.3)
    out = tmp_path / "scenes" / "mine.toml"
    out.parent.mkdir()
    assert ctl("scene", "new", str(out), "--force", str(forces), "--json").ended(0).result["insert"] == "MRE-10-10"
    scene = load_scene(str(out))
    assert (scene.name, scene.force.least_N, scene.force.most_N, scene.force.tolerance_rms_N) == (
        "mine",
        0.31,
        0.62,
        pytest.approx(0.016),
    )
    assert scene.signal.file == "../forces.csv"
    assert main(["scene", "check", str(out)]) == 0


@pytest.mark.parametrize(("rate_hz", "insert", "is_told"), [(0.1, "MRE-50-40", False), (4.5, "MRE-10-20", True)])
def test_a_greater_force_gets_a_stiffer_insert_that_is_not_too_slow(tmp_path, ctl, rate_hz, insert, is_told):
    """A weak device does not give 1.7 N with MRE-10-20, whose model gives 1.9."""
    forces, out = recording(tmp_path / "forces.csv", 1.4, 1.7, rate_hz), tmp_path / "mine.toml"
    assert ("a weak device" in ctl("scene", "new", str(out), "--force", str(forces)).ended(0).out) == is_told
    assert load_scene(str(out)).insert.name == insert


@pytest.mark.parametrize(
    ("least_N", "most_N", "rate_hz", "code", "words"),
    [
        (1.0, 1.0, 1.0, 2, ("has no range",)),
        (0.5, 40.0, 0.1, 1, ("MRE-50-40", "force.most_N = 40")),
        (0.7, 2.0, 5.0, 1, ("N/s at", "MRE-50-40")),
    ],
)
def test_a_force_that_no_insert_renders_is_refused_and_leaves_no_file(
    tmp_path, ctl, least_N, most_N, rate_hz, code, words
):
    out = tmp_path / "mine.toml"
    forces = recording(tmp_path / "f.csv", least_N, most_N, rate_hz)
    error = ctl("scene", "new", str(out), "--force", str(forces), "--json").ended(code).error
    assert all(word in error["message"] for word in words)
    assert not out.exists()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_without_a_recording_it_asks_and_enter_takes_what_is_proposed(tmp_path, ctl, monkeypatch):
    monkeypatch.setattr(sys, "stdin", Terminal("A vein is held open.\n\n1.5\nmuch\n0.06\n" + "\n" * 6))
    scene = load_scene(ctl("scene", "new", str(tmp_path / "vein.toml"), "--json").ended(0).result["file"])
    assert (scene.description, scene.force.most_N, scene.force.tolerance_rms_N) == ("A vein is held open.", 1.5, 0.06)
    assert (scene.force.resolution_N, scene.signal.bandwidth_hz) == (0.12, 0.2)
