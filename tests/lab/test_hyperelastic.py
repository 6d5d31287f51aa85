"""Uniaxial laws: initial slopes, digits near no strain."""

from typing import Any

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.lab.characterisation.elasticity import Shape, ogden_shape, stress_Pa, thesis_shape

LAWS = (
    (ogden_shape, (15e3,), (2.0,)),
    (ogden_shape, (12e3, 30.0, 5e3), (1.3, 9.0, -2.0)),
    (thesis_shape, (15e3,), (2.7,)),
    (thesis_shape, (40e3,), (0.7,)),
)
Law = tuple[Shape, tuple[float, ...], tuple[float, ...]]


def stress(law: Law, stretch: Any) -> Any:
    shape, moduli_Pa, exponents = law
    return stress_Pa(shape, stretch, moduli_Pa, exponents)


@pytest.mark.parametrize("law", LAWS)
def test_every_law_starts_with_three_times_its_shear_modulus(law: Law) -> None:
    assert stress(law, 1.0) == 0.0
    rise_Pa = stress(law, 1.0 + 1e-6) - stress(law, 1.0 - 1e-6)
    assert rise_Pa / 2e-6 == pytest.approx(3.0 * sum(law[1]), rel=1e-6)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_stress_rises_and_keeps_type_and_shape(law: Law, dtype: type) -> None:
    stretch: Any = np.linspace(0.1, 10.0, 60, dtype=dtype).reshape(6, 10)
    found = stress(law, stretch)
    assert (found.dtype, found.shape) == (dtype, stretch.shape)
    assert (np.diff(found.ravel()) > 0.0).all()


@given(st.floats(-15.0, -0.1), st.booleans(), st.floats(0.1, 20.0))
def test_stress_keeps_its_digits_at_small_strain(strain: float, compressed: bool, exponent: float) -> None:
    stretch = 1.0 - 10.0**strain if compressed else 1.0 + 10.0**strain
    with mp.workdps(50):
        power, log = mp.mpf(exponent), mp.log(mp.mpf(stretch))
        printed = mp.exp(power * log) - mp.exp(-power / 2 * log)
        engineering = 2 / power * printed / stretch
    at: Any = stretch
    assert thesis_shape(at, exponent) == pytest.approx(2.0 / exponent * float(printed), rel=1e-13)
    assert ogden_shape(at, exponent) == pytest.approx(float(engineering), rel=1e-13)
