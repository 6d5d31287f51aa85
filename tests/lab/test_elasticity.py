"""Fits of the uniaxial laws: synthetic curves with a known answer, and measured rubber where the data are at hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from tormagd.lab.characterisation.elasticity import (
    fit_neo_hookean,
    fit_ogden,
    fit_thesis_ogden,
    ogden_shape,
    thesis_shape,
)
from tormagd.lab.errors import LabError
from tormagd.lab.tables import read_columns
from tormagd.physics.errors import DomainError

COMPRESSION = np.linspace(1.0, 0.75, 60)
TENSION = np.linspace(1.0, 4.0, 80)


@settings(max_examples=25, deadline=None)
@given(st.floats(3.0, 7.0), st.floats(0.4, 12.0), st.booleans())
def test_one_ogden_term_is_found_again(decades: float, exponent: float, pulled: bool) -> None:
    stretch = TENSION if pulled else COMPRESSION
    stress_Pa = 10.0**decades * ogden_shape(stretch, exponent)
    assume(np.abs(stress_Pa).max() <= 1e12)  # beyond, a record is refused
    fit = fit_ogden(stretch, stress_Pa)
    assert fit.shear_modulus_Pa == pytest.approx(10.0**decades, rel=1e-4)
    assert fit.exponents[0] == pytest.approx(exponent, rel=1e-3)
    assert fit.r2 > 1.0 - 1e-9


@pytest.mark.parametrize("exponent", [0.7, 2.0, 9.0])
def test_the_printed_law_is_found_again(exponent: float) -> None:
    fit = fit_thesis_ogden(COMPRESSION, 140e3 * thesis_shape(COMPRESSION, exponent))
    assert fit.exponents[0] == pytest.approx(exponent, rel=1e-5)
    assert fit.shear_modulus_Pa == pytest.approx(140e3, rel=1e-6)


@pytest.mark.parametrize(
    ("file", "published_kPa"), [("Ecoflex_00-10", 7.4), ("Ecoflex_00-30", 15.1), ("Ecoflex_00-50", 20.8)]
)
def test_measured_silicones(recordings: Path, file: str, published_kPa: float) -> None:
    """Neo-Hookean over 5..50 % strain, where the grips' slack is out; Ogden to four times the length."""
    columns = ("Engineering Strain", "Engineering Stress (MPa)")
    strain, stress_MPa = read_columns(recordings / "srmd_silicone" / f"{file}.csv", columns, delimiter=";").values()
    chosen = (strain >= 0.05) & (strain <= 0.5)
    fit = fit_neo_hookean(1.0 + strain[chosen], 1e6 * stress_MPa[chosen])
    assert 1e-3 * fit.shear_modulus_Pa == pytest.approx(published_kPa, rel=0.01)
    chosen = (strain >= 0.05) & (strain <= 3.0)
    for terms, share in ((1, 0.997), (2, 0.9997)):
        assert fit_ogden(1.0 + strain[chosen], 1e6 * stress_MPa[chosen], terms).r2 > share


def test_treloars_rubber(recordings: Path) -> None:
    stretch, stress_MPa = read_columns(recordings / "hyperelastics_jl" / "uniaxial.csv", ("Stretch", "Stress")).values()
    assert fit_neo_hookean(stretch, 1e6 * stress_MPa).r2 < 0.9
    fit = fit_ogden(stretch, 1e6 * stress_MPa, terms=3)
    assert fit.r2 > 0.998
    assert 0.25e6 < fit.shear_modulus_Pa < 0.45e6


@pytest.mark.parametrize("fit", [fit_neo_hookean, fit_ogden, fit_thesis_ogden])
@pytest.mark.parametrize(
    ("stretch", "stress_Pa", "error", "said"),
    [
        (COMPRESSION, -1e4 * ogden_shape(COMPRESSION, 2.0), LabError, "no positive modulus"),
        (COMPRESSION, np.zeros_like(COMPRESSION), LabError, "vary"),
        (COMPRESSION[:1], COMPRESSION[:1], LabError, "pairs"),
        (np.array([1.0, 0.9, 0.0]), np.array([0.0, -1e3, -1e4]), DomainError, "stretch"),
        (np.array([1.0, 0.9, 0.8]), np.array([0.0, -1e3, np.nan]), DomainError, "stress_Pa"),
    ],
)
def test_curves_that_cannot_be_fitted(fit, stretch, stress_Pa, error, said) -> None:
    with pytest.raises(error, match=said):
        fit(stretch, stress_Pa)
