"""The force law's slopes and domains, and the elastomer's energy; `judge.py numerics` has slopes in 50 digits."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tormag_lab.design.brake import d_force_d_gap, d_force_d_moment, energy_at_shaft, stretch_minus_one
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import MU0_H_M, TORMAG, Elastomer, brake_force_N, max_radial_moment_Tm

STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


@pytest.mark.parametrize("function", [stretch_minus_one, d_force_d_moment])
def test_no_field_is_no_force(function: Callable[..., float]) -> None:
    assert function(0.0, STIFF, TORMAG) == 0.0


def test_the_edge_of_the_domain_is_admitted_and_nothing_beyond() -> None:
    largest = max_radial_moment_Tm(STIFF, TORMAG)
    assert stretch_minus_one(largest, STIFF, TORMAG) == pytest.approx(-0.95, rel=1e-14)
    with pytest.raises(DomainError, match="not allowed"):
        brake_force_N(math.nextafter(largest, math.inf), STIFF, TORMAG)
    with pytest.raises(DomainError, match="radial_moment_Tm"):
        d_force_d_gap(5.0, PowerFieldLaw(), STIFF, TORMAG)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e-9])
def test_what_is_out_of_the_domain_is_refused(bad: float) -> None:
    with pytest.raises(DomainError, match="radial_moment_Tm"):
        stretch_minus_one(bad, STIFF, TORMAG)


@pytest.mark.parametrize("function", [stretch_minus_one, d_force_d_moment])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_keep_type_and_shape_and_agree_with_floats(function: Callable[..., Any], dtype: Any) -> None:
    points = np.linspace(0.0, 0.9 * max_radial_moment_Tm(STIFF, TORMAG), 12).astype(dtype).reshape(3, 4)
    values = function(points, STIFF, TORMAG)
    assert (values.dtype, values.shape) == (dtype, points.shape)
    expected = [function(float(one), STIFF, TORMAG) for one in points.ravel()]
    np.testing.assert_allclose(values.ravel(), expected, rtol=300 * np.finfo(dtype).eps)


@pytest.mark.parametrize("radial", [0.3, 0.7, 0.95, 1.2])
@pytest.mark.parametrize("of_first", [0.0, 0.4, 1.0])
def test_the_energy_rises_as_the_stress_says(radial: float, of_first: float) -> None:
    step, field_T = 1e-6, 0.2
    first, second = (share * STIFF.shear_modulus_Pa / 2.0 for share in (of_first, 1.0 - of_first))
    total = [sum(energy_at_shaft(radial + each, field_T, STIFF).values()) for each in (-step, step)]
    squares = np.array([radial**2, 1.0, radial**-2])
    stress = 2.0 * first * squares + 2.0 * second * (squares.sum() * squares - squares**2)
    stress[0] += (radial * field_T) ** 2 / (MU0_H_M * STIFF.relative_permeability)
    # the pressure that keeps the volume falls out of the difference
    assert radial * (total[1] - total[0]) / (2.0 * step) == pytest.approx(stress[0] - stress[2], rel=1e-6)
