"""The laboratory's command, from a file to a figure."""

import json
from pathlib import Path

import numpy as np
import pytest

from tormagd.lab.characterisation.elasticity import ogden_shape
from tormagd.lab.main import main


def test_tension_and_relaxation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    strain = np.linspace(0.0, 1.0, 50)
    rows = zip(strain, 1e-6 * 15e3 * ogden_shape(1.0 + strain, 2.0), strict=True)
    tension = tmp_path / "tension.csv"
    tension.write_text("strain,stress\n" + "\n".join(f"{e!r},{s!r}" for e, s in rows).replace("np.float64", ""))
    tension.write_text(tension.read_text().replace("(", "").replace(")", ""))
    assert (
        main(["characterise", "--json", "tension", str(tension), "--strain", "strain", "--stress-mpa", "stress"]) == 0
    )
    assert json.loads(capsys.readouterr().out)["neo_hookean"]["shear_modulus_kPa"] == pytest.approx(15.0)

    time_s = np.geomspace(0.1, 100.0, 40)
    hold = [f"{t},1,{2.0 - 0.4 * -np.expm1(-t / 5.0)}" for t in time_s]
    relaxation = tmp_path / "relaxation.csv"
    relaxation.write_text("time_s,driving,force_N\n0,0,0\n1e-6,1,2\n" + "\n".join(hold))
    assert main(["characterise", "--json", "relaxation", str(relaxation), "--branches", "1"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["fractions"], found["times_s"]) == (pytest.approx([0.2], rel=1e-3), pytest.approx([5.0], rel=1e-3))
