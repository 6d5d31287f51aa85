"""`tools/numerics.py` on a sample; that it can fail; and loads that it does not draw."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numerics
import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.lab.design.force_law import radial_moment_for_force_Tm
from tormagd.physics.brake_curve import BrakeCurve
from tormagd.physics.force import (
    Elastomer,
    Geometry,
    brake_force_N,
    max_radial_moment_Tm,
)

# -- tools/numerics.py itself, on a sample; that it can fail; and loads that it does not draw --------------------------


TOOL = Path(__file__).parents[2] / "tools" / "numerics.py"


def test_a_sampled_run_passes_and_has_the_agreed_keys() -> None:
    command = [sys.executable, str(TOOL), "--json", "--cases", "10000", "--reference", "200", "--episodes", "1"]
    command += ["--configurations", "1", "--seconds", "0.1", "--workers", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert (found["travelled"], found["stage_cases"], found["configurations"]["cases"]) == (
        0,
        sum(row["cases"] for row in found["stages"]),
        1,
    )
    assert found["cases"] >= 10_000
    assert found["reference_cases"] >= 200
    assert found["nonfinite"] == found["misjudged"] == 0
    assert found["refused"] > 0
    for kind, most in (("float64", 1e-12), ("float32", 1e-5), ("float32_soft", 3e-4)):
        assert 0.0 < found["worst_rel_error"][kind] <= most
    assert all(share <= 1.0 for share in found["over_allowed"].values())


def test_an_error_in_the_physics_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """One part in 1e11 on the force, far below what any plot would show."""
    original = BrakeCurve.force
    monkeypatch.setattr(BrakeCurve, "force", lambda self, eps, load: original(self, eps, load) * (1.0 + 1e-11))
    tally = numerics.check_chunk(seed=3, devices=8, references=20)
    assert tally.worst["float64", "force"].over_allowed > 5.0
    assert tally.worst["float64", "stretch"].over_allowed < 1.0


def test_a_naive_formula_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """lambda1 from the printed difference, as Eq. 29 has it, cancels while the field is weak."""
    monkeypatch.setattr(
        BrakeCurve,
        "compression",
        lambda self, y: ((1 - self.a * y) ** 2 + 2 * self.b * y) ** 0.5 - (1 - self.a * y),
    )
    assert numerics.check_chunk(seed=3, devices=8, references=20).worst["float64", "stretch"].over_allowed > 10.0


@given(
    st.builds(Elastomer, st.floats(1e3, 1e7), st.floats(1.0, 10.0), st.just(0.2)),
    st.tuples(st.floats(1e-3, 20e-3), st.floats(1e-4, 0.05), st.floats(0.5e-3, 0.05)),
    st.floats(1e-30, 1.0),
    st.sampled_from([np.float32, np.float64]),
)
def test_no_load_in_the_domain_gives_anything_but_a_number(
    elastomer: Elastomer, shape: tuple[float, float, float], share: float, dtype: type
) -> None:
    inner, wall, thickness = shape
    geometry = Geometry(inner, inner + wall, thickness, 0.02)
    moment: Any = np.array([min(share, 0.999) * max_radial_moment_Tm(elastomer, geometry)], dtype=dtype)
    force = brake_force_N(moment, elastomer, geometry)
    assert force.dtype == dtype
    assert 0.0 <= force[0] < math.inf
    assert np.isfinite(radial_moment_for_force_Tm(force, elastomer, geometry)).all()
