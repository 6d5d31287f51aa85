"""The domains of the force law's derivatives and inverse; `judge.py numerics` holds them against 50 digits."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from digits import draw_batch

from tormag_lab.design.force_law import d_force_d_gap, d_force_d_moment, radial_moment_for_force_Tm, stretch_minus_one
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, brake_force_N, max_radial_moment_Tm

STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


def test_the_inverse_needs_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tormag_lab.design.force_law._NEWTON_STEPS", 10)
    rng = np.random.default_rng(7)
    for _ in range(400):
        elastomer, geometry, _, _ = draw_batch(rng, 1)
        moment_Tm = rng.choice((1.0, 10 ** rng.uniform(-6.0, 0.0))) * max_radial_moment_Tm(elastomer, geometry)
        force_N = brake_force_N(moment_Tm, elastomer, geometry)
        assert radial_moment_for_force_Tm(force_N, elastomer, geometry) == pytest.approx(moment_Tm, rel=1e-14)


@pytest.mark.parametrize("function", [stretch_minus_one, d_force_d_moment, radial_moment_for_force_Tm])
def test_no_field_is_no_force(function: Callable[..., float]) -> None:
    assert function(0.0, STIFF, TORMAG) == 0.0


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


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e-9])
def test_what_is_out_of_the_domain_is_refused(bad: float) -> None:
    for function, name in ((stretch_minus_one, "radial_moment_Tm"), (radial_moment_for_force_Tm, "force_N")):
        with pytest.raises(DomainError, match=name):
            function(bad, STIFF, TORMAG)


@pytest.mark.parametrize("function", [stretch_minus_one, d_force_d_moment, radial_moment_for_force_Tm])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_keep_type_and_shape_and_agree_with_floats(function: Callable[..., Any], dtype: Any) -> None:
    points = np.linspace(0.0, 0.9 * max_radial_moment_Tm(STIFF, TORMAG), 12).astype(dtype).reshape(3, 4)
    values = function(points, STIFF, TORMAG)
    assert (values.dtype, values.shape) == (dtype, points.shape)
    expected = [function(float(one), STIFF, TORMAG) for one in points.ravel()]
    np.testing.assert_allclose(values.ravel(), expected, rtol=300 * np.finfo(dtype).eps)
