"""Inserts that a laboratory adds: read, combined with the shipped ones, refused with the place and what is allowed."""

from pathlib import Path

import pytest

from tormagd.physics.errors import DomainError
from tormagd.physics.inserts import INSERTS, InsertFileError, insert, load_inserts

SOFT = """
[[matrix]]
product = "Dragon Skin 10"
shore_hardness = 65
density_g_cc = 1.07
friction_coefficient = 0.3

[[insert]]
name = "DS10-50"
shore_hardness = 65
cip_fraction = 0.5
slacker_fraction = 0.0
thinner_fraction = 0.1
shear_modulus_kPa = 310
relative_permeability = 5.1

[[insert]]
name = "MRE-50-25"
shore_hardness = 50
cip_fraction = 0.25
shear_modulus_kPa = 160.0
friction_coefficient = 0.19
force_range = { measured_N = 3.1, deviation_N = 0.1 }
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "lab.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_laboratorys_inserts_stand_beside_the_shipped_ones(tmp_path: Path) -> None:
    registry = load_inserts(written(tmp_path, SOFT))
    assert set(registry) == {*INSERTS, "DS10-50", "MRE-50-25"}
    soft, more = insert("DS10-50", registry), insert("MRE-50-25", registry)
    assert soft.elastomer.relative_permeability == 5.1
    assert soft.elastomer.friction_coefficient == 0.3
    assert soft.shear_modulus_Pa == 310e3
    assert soft.masses_g["slacker"] == 0.0
    assert more.elastomer.relative_permeability == pytest.approx(3.0)
    assert more.elastomer.friction_coefficient == 0.19
    assert more.force_range.measured_N == 3.1
    with pytest.raises(DomainError, match="measured"):
        _ = soft.force_range
    with pytest.raises(DomainError, match="estimate_N"):
        _ = more.force_range.thesis_estimate_N


ROW = 'name = "X"\nshore_hardness = 50\ncip_fraction = 0.2\nshear_modulus_kPa = 100.0\n'
MATRIX = 'product = "P"\nshore_hardness = 7\ndensity_g_cc = 1.0\nfriction_coefficient = 0.1\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[insert]\n", "lab.toml"),
        ("[[insert]]\n" + ROW.replace("0.2", "0.7"), r"<= 0.6.*\$.insert\[0\].cip_fraction"),
        ("[[insert]]\n" + ROW.replace("0.2", "nan"), r"cip_fraction"),
        ("[[insert]]\n" + ROW.replace("0.2", "0.5"), r"X: cip_fraction = 0.5 is not allowed: a number from 0.1 to 0.4"),
        ("[[insert]]\n" + ROW.replace("100.0", "-1.0"), r"shear_modulus_kPa"),
        ("[[insert]]\n" + ROW.replace('"X"', '"MRE-50-40"'), r"MRE-50-40 is stated twice"),
        ("[[insert]]\n" + ROW.replace('"X"', '"a b"'), r"name"),
        (
            "[[insert]]\n" + ROW.replace("50", "51"),
            r"shore_hardness = 51: .* matrices, 10, 30, 50",
        ),
        ("[[insert]]\n" + ROW + "colour = 1\n", r"unknown field `colour`"),
        (
            "[[insert]]\n" + ROW + "slacker_fraction = 0.5\nthinner_fraction = 0.5\n",
            r"matrix_fraction = -0\.(2|1999)",
        ),
        ("[[insert]]\n" + ROW + "force_range = { measured_N = 0.0, deviation_N = 0.0 }\n", r"measured_N = 0"),
        (
            "[[insert]]\n" + ROW.replace("shear_modulus_kPa = 100.0\n", ""),
            r"missing required .*`shear_modulus_kPa`",
        ),
        ("[[matrix]]\n" + MATRIX.replace("= 7", "= 30"), r"shore_hardness = 30 is stated twice"),
        ("[[matrix]]\n" + MATRIX.replace("0.1", "0.0"), r"friction_coefficient"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InsertFileError, match=said) as caught:
        load_inserts(written(tmp_path, text))
    assert "lab.toml" in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InsertFileError, match=r"nowhere\.toml"):
        load_inserts(tmp_path / "nowhere.toml")
