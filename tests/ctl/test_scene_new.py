"""`scene new`: what it makes of a recorded force, or of answers, the daemon takes; what can be no scene is told."""

import io
import json
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


def new(capsys, *arguments: str) -> tuple[int, dict]:
    code = main(["scene", "new", *arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_a_recorded_force_becomes_a_scene_with_the_softest_insert_that_renders_it(tmp_path, capsys):
    forces = recording(tmp_path / "forces.csv", 0.31, 0.62, 0.3)
    out = tmp_path / "scenes" / "mine.toml"
    out.parent.mkdir()
    code, printed = new(capsys, str(out), "--force", str(forces))
    assert code == 0
    assert printed["result"]["insert"] == "MRE-10-10"
    scene = load_scene(str(out))
    assert (scene.name, scene.force.least_N, scene.force.most_N) == ("mine", 0.31, 0.62)
    assert scene.force.tolerance_rms_N == pytest.approx(0.016)
    assert scene.signal is not None
    assert scene.signal.file == "../forces.csv"
    assert main(["scene", "check", str(out)]) == 0


def test_a_greater_force_gets_a_stiffer_insert(tmp_path, capsys):
    forces = recording(tmp_path / "forces.csv", 0.8, 3.0, 0.1)
    code, printed = new(capsys, str(tmp_path / "mine.toml"), "--force", str(forces))
    assert code == 0
    assert printed["result"]["insert"] == "MRE-50-40"


@pytest.mark.parametrize(
    ("least_N", "most_N", "rate_hz", "code", "words"),
    [
        (1.0, 1.0, 1.0, 2, ("has no range",)),
        (0.5, 40.0, 0.1, 1, ("MRE-50-40", "force.most_N = 40")),
        (0.7, 2.0, 5.0, 1, ("N/s at", "MRE-50-40")),
    ],
)
def test_a_force_that_no_insert_renders_is_refused_and_leaves_no_file(
    tmp_path, capsys, least_N, most_N, rate_hz, code, words
):
    out = tmp_path / "mine.toml"
    ended, printed = new(capsys, str(out), "--force", str(recording(tmp_path / "f.csv", least_N, most_N, rate_hz)))
    assert ended == code
    assert all(word in printed["error"]["message"] for word in words)
    assert not out.exists()


def test_a_file_is_never_written_over(tmp_path, capsys):
    out = tmp_path / "mine.toml"
    out.write_text("keep")
    code, _ = new(capsys, str(out), "--force", str(recording(tmp_path / "f.csv", 0.8, 1.5, 0.1)))
    assert code == 2
    assert out.read_text() == "keep"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_without_a_recording_it_asks_and_enter_takes_what_is_proposed(tmp_path, capsys, monkeypatch):
    answers = "A vein is held open.\n\n1.5\nmuch\n0.06\n" + "\n" * 6
    monkeypatch.setattr(sys, "stdin", Terminal(answers))
    code, printed = new(capsys, str(tmp_path / "vein.toml"))
    assert code == 0
    scene = load_scene(printed["result"]["file"])
    assert (scene.description, scene.force.most_N, scene.force.tolerance_rms_N) == ("A vein is held open.", 1.5, 0.06)
    assert (scene.force.resolution_N, scene.signal.bandwidth_hz) == (0.12, 0.2)


def test_where_nobody_can_be_asked_it_says_so(tmp_path, capsys, monkeypatch):
    for stdin, words in ((io.StringIO(), "nobody to ask"), (Terminal("one\n"), "the answers ended")):
        monkeypatch.setattr(sys, "stdin", stdin)
        code, printed = new(capsys, str(tmp_path / "mine.toml"))
        assert code == 2
        assert words in printed["error"]["message"]
