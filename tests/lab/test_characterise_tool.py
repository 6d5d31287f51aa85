"""The laboratory's command, from a file to a figure."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tormagd.lab.characterisation.hyperelastic import NeoHookean

TOOL = Path(__file__).parents[2] / "tools" / "characterise.py"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(TOOL), *arguments], capture_output=True, text=True, check=False)


def test_tension_and_relaxation(tmp_path: Path) -> None:
    strain = np.linspace(0.0, 1.0, 50)
    rows = zip(strain, 1e-6 * NeoHookean(15e3).stress_Pa(1.0 + strain), strict=True)
    tension = tmp_path / "tension.csv"
    tension.write_text("strain,stress\n" + "\n".join(f"{e!r},{s!r}" for e, s in rows).replace("np.float64", ""))
    tension.write_text(tension.read_text().replace("(", "").replace(")", ""))
    done = run("--json", "tension", str(tension), "--strain", "strain", "--stress-mpa", "stress")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["neo_hookean"]["shear_modulus_kPa"] == pytest.approx(15.0)

    time_s = np.geomspace(0.1, 100.0, 40)
    hold = [f"{t},1,{2.0 - 0.4 * -np.expm1(-t / 5.0)}" for t in time_s]
    relaxation = tmp_path / "relaxation.csv"
    relaxation.write_text("time_s,driving,force_N\n0,0,0\n1e-6,1,2\n" + "\n".join(hold))
    done = run("--json", "relaxation", str(relaxation), "--branches", "1")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["fractions"] == pytest.approx([0.2], rel=1e-3)
    assert found["times_s"] == pytest.approx([5.0], rel=1e-3)


def test_a_bad_file_is_one_line_and_exit_2(tmp_path: Path) -> None:
    done = run("compression", str(tmp_path / "absent.csv"))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("characterise: ")
    assert "absent.csv" in done.stderr
