"""Uniaxial laws: initial slopes, digits near no strain, refusals."""

import math
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.lab.characterisation.hyperelastic import Ogden, ThesisOgden
from tormagd.physics.errors import DomainError

NEO_HOOKEAN = Ogden((15e3,), (2.0,))
LAWS = (NEO_HOOKEAN, Ogden((12e3, 30.0, 5e3), (1.3, 9.0, -2.0)), ThesisOgden(15e3, 2.7), ThesisOgden(40e3, 0.7))


@pytest.mark.parametrize("law", LAWS)
def test_every_law_starts_with_three_times_its_shear_modulus(law: Ogden | ThesisOgden) -> None:
    assert law.stress_Pa(1.0) == 0.0
    rise_Pa = law.stress_Pa(1.0 + 1e-6) - law.stress_Pa(1.0 - 1e-6)
    assert rise_Pa / 2e-6 == pytest.approx(3.0 * law.shear_modulus_Pa, rel=1e-6)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_stress_rises_and_keeps_type_and_shape(law: Ogden | ThesisOgden, dtype: type) -> None:
    stretch: Any = np.linspace(0.1, 10.0, 60, dtype=dtype).reshape(6, 10)
    stress = law.stress_Pa(stretch)
    assert (stress.dtype, stress.shape) == (dtype, stretch.shape)
    assert (np.diff(stress.ravel()) > 0.0).all()


@given(st.floats(-15.0, -0.1), st.booleans(), st.floats(0.1, 20.0))
def test_stress_keeps_its_digits_at_small_strain(strain: float, compressed: bool, exponent: float) -> None:
    stretch = 1.0 - 10.0**strain if compressed else 1.0 + 10.0**strain
    with mp.workdps(50):
        power, log = mp.mpf(exponent), mp.log(mp.mpf(stretch))
        printed = mp.exp(power * log) - mp.exp(-power / 2 * log)
        engineering = 2 / power * printed / stretch
    assert ThesisOgden(1e3, exponent).stress_Pa(stretch) == pytest.approx(1e3 * float(printed), rel=1e-13)
    assert Ogden((1e3,), (exponent,)).stress_Pa(stretch) == pytest.approx(1e3 * float(engineering), rel=1e-13)


@pytest.mark.parametrize("bad", [0.0, -0.5, math.nan, math.inf, 25.0])
def test_stretches_are_checked(bad: float) -> None:
    for law in LAWS:
        with pytest.raises(DomainError, match="stretch"):
            law.stress_Pa(bad)


@pytest.mark.parametrize(
    ("moduli", "exponents", "name"),
    [
        ((), (), "exponents"),
        ((1e3,), (2.0, 3.0), "exponents"),
        ((-1e3,), (2.0,), "moduli_Pa"),
        ((math.nan,), (2.0,), "moduli_Pa"),
        ((1e3,), (0.0,), "exponents"),
        ((1e3,), (math.inf,), "exponents"),
    ],
)
def test_constants_are_checked(moduli: tuple[float, ...], exponents: tuple[float, ...], name: str) -> None:
    with pytest.raises(DomainError, match=name):
        Ogden(moduli, exponents)


def test_constants_of_the_other_laws_are_checked() -> None:
    with pytest.raises(DomainError, match="constant_Pa"):
        ThesisOgden(math.nan, 2.0)
    with pytest.raises(DomainError, match="exponent"):
        ThesisOgden(1e3, -2.0)
