"""Brake force: published figures, 50-digit references at the extremes, inverse, derivatives, refusals."""

import math
import random
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import mpmath as mp
import numpy as np
import pytest

from tormagd.lab.design.force_law import d_force_d_gap, d_force_d_moment, radial_moment_for_force_Tm, stretch_minus_one
from tormagd.physics.errors import DomainError
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import TORMAG, Elastomer, Geometry, brake_force_N, max_radial_moment_Tm

DIGITS = 50
STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


class Case(NamedTuple):
    moment: float
    elastomer: Elastomer
    geometry: Geometry


def reference(case: Case, moment: Any = None) -> tuple[Any, Any]:
    """lambda1 and F as printed (Eq. 29, 33, 34, Gammas of the appendix), in 50 digits."""
    g0, mu_r, mu_d = map(
        mp.mpf,
        (
            case.elastomer.shear_modulus_Pa,
            case.elastomer.relative_permeability,
            case.elastomer.friction_coefficient,
        ),
    )
    geometry = case.geometry
    r_i, r_o, t, r_w = map(
        mp.mpf, (geometry.inner_radius_m, geometry.outer_radius_m, geometry.thickness_m, geometry.roller_radius_m)
    )
    mu = 4 * mp.pi * mp.mpf(10) ** -7 * mu_r
    a = mu_r / 4 * mp.mpf(case.moment if moment is None else moment)
    d = 1 / r_i**2 - 1 / (r_i * r_o)
    gamma_1 = a**2 / (r_o * r_i) / mu - t * a**2 * (mu_r - 1) / (2 * mu) * d
    gamma_2 = -(a**2) / r_i**2 / mu - t * a**2 * (mu_r - 1) / mu * d
    stretch = (8 * g0 - gamma_1 - mp.sqrt((gamma_1 - 4 * g0) ** 2 - 8 * g0 * (gamma_1 + gamma_2))) / (4 * g0)
    xi = 2 * mp.pi * t * r_i**2 * mu_d / (r_w * stretch)
    return stretch, -xi * g0 * (1 - stretch**-4) + xi * a**2 / (r_i**2 * mu * stretch**2)


def reference_slope(case: Case) -> Any:
    """dF/da by a central difference in 50 digits, good to about 30."""
    h = mp.mpf(10) ** -15
    up, down = (reference(case, case.moment * (1 + sign * h))[1] for sign in (1, -1))
    return (up - down) / (2 * h * case.moment)


def corners_and_random(seed: int) -> Iterator[tuple[Elastomer, Geometry, random.Random]]:
    """Materials and geometries out to the extremes: 1 kPa..10 MPa, mu_r 1..10, wall from 0.1 mm, t 0.5..50 mm."""
    rng = random.Random(seed)
    while True:
        inner = 10 ** rng.uniform(-3.0, -1.7)
        wall = rng.choice((1e-4, 0.041, 10 ** rng.uniform(-4.0, -1.4)))
        thickness = rng.choice((5e-4, 0.05, 10 ** rng.uniform(-3.3, -1.3)))
        modulus = rng.choice((1e3, 1e7, 10 ** rng.uniform(3.0, 7.0)))
        mu_r = rng.choice((1.0, 10.0, rng.uniform(1.0, 10.0)))
        yield Elastomer(modulus, mu_r, 0.2), Geometry(inner, inner + wall, thickness, 0.02), rng


def over_gaps(seed: int) -> Iterator[Case]:
    for elastomer, geometry, rng in corners_and_random(seed):
        gap = rng.choice((5.0, 1000.0, 10 ** rng.uniform(math.log10(5.0), 3.0)))
        yield Case(PowerFieldLaw().radial_moment_Tm(gap), elastomer, geometry)


def over_loads(seed: int) -> Iterator[Case]:
    """Up to the very edge of the domain, where the force is most sensitive."""
    for elastomer, geometry, rng in corners_and_random(seed):
        share = rng.choice((1.0, 10 ** rng.uniform(-6.0, 0.0)))
        yield Case(share * max_radial_moment_Tm(elastomer, geometry), elastomer, geometry)


@pytest.fixture(autouse=True)
def fifty_digits() -> Iterator[None]:
    with mp.workdps(DIGITS):
        yield


@pytest.mark.parametrize(("cases", "count"), [(over_gaps, 1500), (over_loads, 1500)])
def test_float64_force_agrees_with_50_digits(cases: Callable[[int], Iterator[Case]], count: int) -> None:
    admitted = 0
    for case in islice(cases(1), count):
        stretch, force = reference(case)
        if case.moment > max_radial_moment_Tm(case.elastomer, case.geometry):
            assert stretch < 0.05
            with pytest.raises(DomainError, match="radial_moment_Tm"):
                brake_force_N(*case)
            continue
        admitted += 1
        condition = abs(case.moment * reference_slope(case) / force)
        error = abs(mp.mpf(brake_force_N(*case)) / force - 1)
        assert error <= max(1e-12, 8 * 2.0**-52 * condition), case
        assert stretch_minus_one(*case) == pytest.approx(float(stretch - 1), rel=1e-12), case
    assert admitted > 0.3 * count


def test_float32_force_agrees_with_50_digits() -> None:
    strained = 0
    for case in islice(over_loads(2), 1500):
        moment = np.array([0.999 * case.moment], dtype=np.float32)
        stretch, force = reference(case, float(moment[0]))
        result = brake_force_N(moment, case.elastomer, case.geometry)
        assert result.dtype == np.float32
        strained += stretch < 0.7
        assert abs(float(result[0] / force - 1)) <= (1e-5 if stretch >= 0.7 else 3e-4), case
    assert strained > 200


def test_slope_agrees_with_50_digits() -> None:
    for case in islice(over_loads(3), 400):
        assert d_force_d_moment(*case) == pytest.approx(float(reference_slope(case)), rel=1e-11), case


@pytest.mark.parametrize(("law", "weakest", "strongest"), [(ThesisFieldLaw(), 0.69, 5.0), (PowerFieldLaw(), 0.61, 5.3)])
def test_force_range_of_the_device(law: FieldLaw, weakest: float, strongest: float) -> None:
    force = brake_force_N(law.radial_moment_Tm(np.array([95.0, 45.0])), STIFF, TORMAG)
    assert force == pytest.approx([weakest, strongest], rel=0.01)


@pytest.mark.parametrize("law", [ThesisFieldLaw(), PowerFieldLaw()])
@pytest.mark.parametrize("gap", [46.0, 55.0, 70.0, 90.0])
def test_the_slope_over_the_gap_is_that_of_the_force(law: FieldLaw, gap: float) -> None:
    def force(at: Any) -> Any:
        if isinstance(law, ThesisFieldLaw):
            moment = (mp.mpf(1.206) * (95 - at) ** mp.mpf(1.867) + 1256) / 10**6
        else:
            moment = mp.mpf(0.44) * at ** mp.mpf(-1.3)
        return reference(Case(0.0, STIFF, TORMAG), moment)[1]

    assert d_force_d_gap(gap, law, STIFF, TORMAG) == pytest.approx(float(mp.diff(force, gap)), rel=1e-9)


def test_force_rises_strictly_with_the_field() -> None:
    for elastomer, geometry, _ in islice(corners_and_random(4), 200):
        moment = np.linspace(0.0, max_radial_moment_Tm(elastomer, geometry), 400)
        assert (np.diff(brake_force_N(moment, elastomer, geometry)) > 0.0).all()


def test_the_inverse_returns_the_radial_moment() -> None:
    for case in islice(over_loads(5), 1500):
        force = brake_force_N(*case)
        assert radial_moment_for_force_Tm(force, case.elastomer, case.geometry) == pytest.approx(case.moment, rel=4e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_inverse_of_arrays(dtype: Any) -> None:
    for elastomer, geometry, _ in islice(corners_and_random(6), 50):
        largest = max_radial_moment_Tm(elastomer, geometry)
        moment = (largest * np.append(0.0, np.logspace(-6.0, -1e-3, 119))).astype(dtype).reshape(8, 15)
        back = radial_moment_for_force_Tm(brake_force_N(moment, elastomer, geometry), elastomer, geometry)
        assert back.dtype == dtype
        np.testing.assert_allclose(back, moment, rtol=16 * np.finfo(dtype).eps)


def test_the_inverse_needs_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tormagd.lab.design.force_law._NEWTON_STEPS", 10)
    for case in islice(over_loads(7), 500):
        force = brake_force_N(*case)
        assert radial_moment_for_force_Tm(force, case.elastomer, case.geometry) == pytest.approx(case.moment, rel=1e-14)


def test_no_field_is_no_force() -> None:
    assert brake_force_N(0.0, STIFF, TORMAG) == 0.0
    assert stretch_minus_one(0.0, STIFF, TORMAG) == 0.0
    assert d_force_d_moment(0.0, STIFF, TORMAG) == 0.0
    assert radial_moment_for_force_Tm(0.0, STIFF, TORMAG) == 0.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_agree_with_floats(dtype: Any) -> None:
    moment = np.linspace(0.0, 0.9 * max_radial_moment_Tm(STIFF, TORMAG), 12, dtype=dtype).reshape(3, 4)
    for function in (stretch_minus_one, brake_force_N, d_force_d_moment):
        values = function(moment, STIFF, TORMAG)
        assert values.dtype == dtype
        assert values.shape == moment.shape
        expected = [function(float(one), STIFF, TORMAG) for one in moment.ravel()]
        np.testing.assert_allclose(values.ravel(), expected, rtol=300 * np.finfo(dtype).eps)
    assert isinstance(brake_force_N(1e-3, STIFF, TORMAG), float)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e-9])
def test_bad_radial_moments_are_refused(bad: float) -> None:
    mixed = np.array([1e-3, bad])
    for function in (stretch_minus_one, brake_force_N, d_force_d_moment):
        with pytest.raises(DomainError, match="radial_moment_Tm"):
            function(bad, STIFF, TORMAG)
        with pytest.raises(DomainError, match="radial_moment_Tm"):
            function(mixed, STIFF, TORMAG)
    with pytest.raises(DomainError, match="force_N"):
        radial_moment_for_force_Tm(bad, STIFF, TORMAG)


def test_the_edge_of_the_domain_is_admitted_and_nothing_beyond() -> None:
    largest = max_radial_moment_Tm(STIFF, TORMAG)
    force = brake_force_N(largest, STIFF, TORMAG)
    assert stretch_minus_one(largest, STIFF, TORMAG) == pytest.approx(-0.95, rel=1e-14)
    assert radial_moment_for_force_Tm(force, STIFF, TORMAG) == pytest.approx(largest, rel=1e-14)
    for call, value in ((brake_force_N, largest), (radial_moment_for_force_Tm, force)):
        with pytest.raises(DomainError, match="not allowed"):
            call(math.nextafter(value, math.inf), STIFF, TORMAG)
    with pytest.raises(DomainError, match="radial_moment_Tm"):
        d_force_d_gap(5.0, PowerFieldLaw(), STIFF, TORMAG)


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, -1.0])
def test_elastomer_is_checked(index: int, bad: float) -> None:
    values = [277.3e3, 4.0, 0.2]
    values[index] = bad
    with pytest.raises(DomainError, match=("shear_modulus_Pa", "relative_permeability", "friction_coefficient")[index]):
        Elastomer(*values)


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, -0.01])
def test_geometry_is_checked(index: int, bad: float) -> None:
    values = [0.004, 0.011, 0.02, 0.02]
    values[index] = bad
    with pytest.raises(DomainError):
        Geometry(*values)


def test_geometry_needs_a_wall() -> None:
    with pytest.raises(DomainError, match="outer_radius_m"):
        Geometry(0.011, 0.011, 0.02, 0.02)
