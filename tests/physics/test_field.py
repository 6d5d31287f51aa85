"""Field laws: published figures, inverse, derivatives, refusals."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.physics.errors import DomainError
from tormagd.physics.field import (
    FieldLaw,
    PowerFieldLaw,
    ThesisFieldLaw,
    flux_density_T,
)

LAWS: list[FieldLaw] = [ThesisFieldLaw(), PowerFieldLaw(), PowerFieldLaw(coefficient=0.462, exponent=-1.33)]


def test_eq_7_gives_the_published_flux_density_at_the_shaft() -> None:
    law = ThesisFieldLaw()
    at_45, at_95 = (flux_density_T(law.radial_moment_Tm(gap), 4.0, 0.004) for gap in (45.0, 95.0))
    assert at_45 == pytest.approx(0.762, abs=0.0005)
    assert at_95 == pytest.approx(0.314, abs=0.0005)


def test_the_two_laws_agree_on_the_device_range() -> None:
    gap = np.linspace(45.0, 95.0, 101)
    ratio = PowerFieldLaw().radial_moment_Tm(gap) / ThesisFieldLaw().radial_moment_Tm(gap)
    assert 0.03 < np.abs(ratio - 1.0).max() < 0.10


@pytest.mark.parametrize("law", LAWS)
@given(position=st.floats(0.0, 1.0))
def test_the_inverse_returns_the_gap(law: FieldLaw, position: float) -> None:
    low, high = law.gap_range_mm
    gap = min(low * (high / low) ** position, high)
    # Eq. 7 is flat at 95 mm: half of the digits are gone there
    tolerance = 1e-6 if isinstance(law, ThesisFieldLaw) and gap > 94.0 else 1e-10 * gap
    assert law.gap_mm(law.radial_moment_Tm(gap)) == pytest.approx(gap, abs=tolerance)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("gap", [46.0, 60.0, 80.0, 94.0])
def test_derivatives_are_those_of_the_law(law: FieldLaw, gap: float) -> None:
    h = 1e-4
    slope = (law.radial_moment_Tm(gap + h) - law.radial_moment_Tm(gap - h)) / (2 * h)
    assert law.d_radial_moment_d_gap(gap) == pytest.approx(slope, rel=1e-6)
    assert slope < 0.0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_keep_type_and_shape_and_agree_with_floats(law: FieldLaw, dtype: Any) -> None:
    gap = np.linspace(46.0, 94.0, 12, dtype=dtype).reshape(3, 4)
    for method in (law.radial_moment_Tm, law.d_radial_moment_d_gap):
        values = method(gap)
        assert values.dtype == dtype
        assert values.shape == gap.shape
        expected = [method(float(one)) for one in gap.ravel()]
        np.testing.assert_allclose(values.ravel(), expected, rtol=16 * np.finfo(dtype).eps)
    assert law.gap_mm(law.radial_moment_Tm(gap)).dtype == dtype
    assert isinstance(law.radial_moment_Tm(60.0), float)


@pytest.mark.parametrize("law", LAWS)
def test_gaps_and_moments_outside_the_law_are_refused(law: FieldLaw) -> None:
    low, high = law.gap_range_mm
    for gap in (math.nextafter(low, 0.0), math.nextafter(high, math.inf), math.nan, math.inf, -60.0):
        for method in (law.radial_moment_Tm, law.d_radial_moment_d_gap):
            with pytest.raises(DomainError, match="gap_mm"):
                method(gap)
            with pytest.raises(DomainError, match="gap_mm"):
                method(np.array([60.0, gap]))
    strongest = law.radial_moment_Tm(low)
    for moment in (0.0, 1.01 * strongest, math.nan):
        with pytest.raises(DomainError, match="radial_moment_Tm"):
            law.gap_mm(moment)
    assert law.gap_mm(law.radial_moment_Tm(high)) == pytest.approx(high, abs=1e-4)
    assert law.gap_mm(strongest) == pytest.approx(low)


def test_eq_7_is_flat_at_its_own_end() -> None:
    assert ThesisFieldLaw().d_radial_moment_d_gap(95.0) == 0.0


def test_the_error_names_variable_value_and_bounds() -> None:
    with pytest.raises(DomainError, match=r"gap_mm = 96\.0 is not allowed: a number from 45 to 95") as caught:
        ThesisFieldLaw().radial_moment_Tm(np.array([50.0, 96.0]))
    assert caught.value.variable == "gap_mm"
    assert caught.value.value == 96.0


@pytest.mark.parametrize("gap", [np.array([60]), [60.0], "60", None, np.array([60.0 + 1j])])
def test_other_types_are_refused(gap: Any) -> None:
    with pytest.raises(DomainError, match="gap_mm"):
        PowerFieldLaw().radial_moment_Tm(gap)


@pytest.mark.parametrize(("coefficient", "exponent"), [(0.0, -1.3), (math.nan, -1.3), (0.44, 1.3), (0.44, math.nan)])
def test_power_law_constants_are_checked(coefficient: float, exponent: float) -> None:
    with pytest.raises(DomainError):
        PowerFieldLaw(coefficient, exponent)


def test_flux_density_over_the_radial_moment() -> None:
    assert flux_density_T(3.1e-3, 3.2, 0.004) == pytest.approx(3.1e-3 * 0.8 / 0.004)
    for mu_r, radius, moment in ((0.9, 0.004, 1e-3), (4.0, 0.0, 1e-3), (4.0, 0.004, -1e-3), (4.0, 0.004, math.nan)):
        with pytest.raises(DomainError):
            flux_density_T(moment, mu_r, radius)
