"""The README's client, taken from the README, drives the daemon."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

README = Path(__file__).parents[2] / "README.md"


def client() -> str:
    """The README's client."""
    (script,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    return str(script)


def test_the_client_in_the_readme_sees_the_force_follow(rig, tmp_path):
    script = client()
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
