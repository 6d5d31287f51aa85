"""Cyclic compression tests: the right cycle is evaluated, the standard's rules are checked. Synthetic data."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tormagd.lab.characterisation.compression import (
    CompressionRecord,
    Sample,
    deviations,
    evaluated_cycle,
    loading_halves,
    read_compression,
)
from tormagd.lab.characterisation.elasticity import fit_ogden, fit_thesis_ogden, ogden_shape
from tormagd.lab.errors import LabError
from tormagd.lab.tables import read_columns
from tormagd.physics.errors import DomainError

MODULUS_PA, EXPONENT = 120e3, 3.0
SAMPLE = Sample()
SOFTENING = (1.5, 1.2, 1.05, 1.0, 0.99)


def cyclic_test(
    cycles: int = 4, strain: float = 0.25, rate_mm_min: float = 10.0, noise: float = 0.0, set_mm: float = 0.0
) -> CompressionRecord:
    """Triangles from zero to the strain; stiffer in the first cycles and while loading; a set shifts later starts."""
    rng = np.random.default_rng(0)
    top_mm, dt_s = strain * SAMPLE.height_mm, 0.05
    half = round(top_mm / (rate_mm_min / 60.0) / dt_s)
    displacement, force = [0.0], [0.0]
    for cycle in range(cycles):
        low_mm = set_mm * cycle
        loading = np.linspace(low_mm, top_mm, half + 1)[1:]
        for path, share in ((loading, 1.0), (np.linspace(top_mm, low_mm + set_mm, half + 1)[1:], 0.85)):
            stretch = 1.0 - path / SAMPLE.height_mm
            displacement.extend(path)
            force.extend(-MODULUS_PA * ogden_shape(stretch, EXPONENT) * SAMPLE.area_m2 * share * SOFTENING[cycle])
    jitter = rng.normal(0.0, noise, (2, len(force)))
    return CompressionRecord(
        np.arange(len(force)) * dt_s, np.array(displacement) + 1e-2 * jitter[0], np.array(force) + jitter[1]
    )


def test_the_fourth_cycle_gives_the_conditioned_modulus() -> None:
    curve = evaluated_cycle(cyclic_test(), SAMPLE)
    assert (curve.stretch[0], curve.stretch[-1]) == pytest.approx((1.0, 0.75))
    assert fit_ogden(curve.stretch, curve.stress_Pa).shear_modulus_Pa == pytest.approx(120e3, rel=1e-3)
    assert fit_thesis_ogden(curve.stretch, curve.stress_Pa).r2 > 0.99


def test_noise_and_set_make_no_cycles() -> None:
    record = cyclic_test(noise=0.5, set_mm=0.1)
    assert len(loading_halves(record)) == 4
    curve = evaluated_cycle(record, SAMPLE)
    assert fit_ogden(curve.stretch, curve.stress_Pa).shear_modulus_Pa == pytest.approx(120e3, rel=0.05)


def test_deviations_from_the_cycle_rules_are_told() -> None:
    found = deviations(cyclic_test(cycles=2, strain=0.4, rate_mm_min=50.0), Sample(29.2, 12.5))
    assert found[0] == "2 cycles: the method has 4 and evaluates the last"
    assert "cycle 1 goes to 40.0% strain: the method goes to 25%" in found
    assert any("cycle 2 loads at 5" in one for one in found)


@pytest.mark.parametrize(
    ("evaluated", "error", "said"),
    [
        (lambda: evaluated_cycle(cyclic_test(cycles=3), SAMPLE), LabError, "cycle 4 of 3"),
        (lambda: evaluated_cycle(cyclic_test(), Sample(height_mm=2.0)), LabError, "height"),
        (lambda: loading_halves(CompressionRecord(np.arange(5.0), np.zeros(5), np.zeros(5))), LabError, "no cycle"),
        (lambda: Sample(diameter_mm=0.0), DomainError, "diameter_mm"),
    ],
)
def test_records_that_cannot_be_evaluated(evaluated: Callable[[], object], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        evaluated()


def test_files_are_read_past_a_preamble_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "test.csv"
    path.write_text("Machine;X\ntime_s, displacement_mm ,force_N,note\n0,0,0,a\n1,0.5,20,b\n\n2,1,45\n")
    assert read_compression(path).force_N.tolist() == [0.0, 20.0, 45.0]
    for text, said in (
        ("a,b\n1,2\n", "header is .*needed is 'time_s,displacement_mm,force_N'"),
        ("time_s,displacement_mm,force_N\n", "0 rows"),
        (
            "time_s,displacement_mm,force_N\n0,0,0\n1,nan,0\n",
            "row 3, displacement_mm: 'nan' .*only finite",
        ),
        ("time_s,displacement_mm,force_N\n0,0\n", "row 2, force_N: ''"),
        ("time_s,displacement_mm,force_N\n1,0,0\n1,1,1\n", "time_s does not rise"),
    ):
        path.write_text(text)
        with pytest.raises(LabError, match=said):
            read_compression(path)
    with pytest.raises(LabError, match="absent"):
        read_columns(tmp_path / "absent.csv", ("a",))
