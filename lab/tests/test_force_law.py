"""The force law's derivatives and its inverse, against 50 digits, and their domains."""

import math
import random
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pytest
from digits import Batch, reference

from tormag_lab.design.force_law import d_force_d_gap, d_force_d_moment, radial_moment_for_force_Tm, stretch_minus_one
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, Geometry, brake_force_N, max_radial_moment_Tm

STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


class Case(NamedTuple):
    moment: float
    elastomer: Elastomer
    geometry: Geometry


def over_loads(seed: int) -> Iterator[Case]:
    """Loads of materials and geometries out to the extremes: 1 kPa..10 MPa, mu_r 1..10, wall from 0.1 mm."""
    rng = random.Random(seed)
    while True:
        inner = 10 ** rng.uniform(-3.0, -1.7)
        wall = rng.choice((1e-4, 0.041, 10 ** rng.uniform(-4.0, -1.4)))
        geometry = Geometry(inner, inner + wall, rng.choice((5e-4, 0.05)), 0.02)
        elastomer = Elastomer(rng.choice((1e3, 1e7)), rng.uniform(1.0, 10.0), 0.2)
        share = rng.choice((1.0, 10 ** rng.uniform(-6.0, 0.0)))
        yield Case(share * max_radial_moment_Tm(elastomer, geometry), elastomer, geometry)


def test_stretch_and_slope_agree_with_50_digits() -> None:
    for case in islice(over_loads(1), 200):
        truth = reference(Batch(case.elastomer, case.geometry, None, np.array([])), case.moment)
        assert stretch_minus_one(*case) == pytest.approx(float(truth.values["stretch"]), rel=1e-12), case
        assert d_force_d_moment(*case) == pytest.approx(float(truth.values["slope"]), rel=1e-11), case


@pytest.mark.parametrize("law", [ThesisFieldLaw(), PowerFieldLaw()])
@pytest.mark.parametrize("gap", [46.0, 55.0, 70.0, 90.0])
def test_the_slope_over_the_gap_is_that_of_the_force(law: FieldLaw, gap: float) -> None:
    slope = reference(Batch(STIFF, TORMAG, law, np.array([])), gap).values["slope"]
    assert d_force_d_gap(gap, law, STIFF, TORMAG) == pytest.approx(float(slope), rel=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_inverse_of_arrays(dtype: Any) -> None:
    for _, elastomer, geometry in islice(over_loads(6), 50):
        largest = max_radial_moment_Tm(elastomer, geometry)
        moment = (largest * np.append(0.0, np.logspace(-6.0, -1e-3, 119))).astype(dtype).reshape(8, 15)
        back = radial_moment_for_force_Tm(brake_force_N(moment, elastomer, geometry), elastomer, geometry)
        assert back.dtype == dtype
        np.testing.assert_allclose(back, moment, rtol=16 * np.finfo(dtype).eps)


@pytest.mark.parametrize(("steps", "seed", "count", "rel"), [(None, 5, 1500, 4e-15), (10, 7, 500, 1e-14)])
def test_the_inverse_returns_the_radial_moment_and_needs_few_steps(
    monkeypatch: pytest.MonkeyPatch, steps: int | None, seed: int, count: int, rel: float
) -> None:
    if steps is not None:
        monkeypatch.setattr("tormag_lab.design.force_law._NEWTON_STEPS", steps)
    for case in islice(over_loads(seed), count):
        assert radial_moment_for_force_Tm(brake_force_N(*case), *case[1:]) == pytest.approx(case.moment, rel=rel)


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


@pytest.mark.parametrize("function", [stretch_minus_one, d_force_d_moment])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_keep_type_and_shape_and_agree_with_floats(function: Callable[..., Any], dtype: Any) -> None:
    points = np.linspace(0.0, 0.9 * max_radial_moment_Tm(STIFF, TORMAG), 12).astype(dtype).reshape(3, 4)
    values = function(points, STIFF, TORMAG)
    assert (values.dtype, values.shape) == (dtype, points.shape)
    expected = [function(float(one), STIFF, TORMAG) for one in points.ravel()]
    np.testing.assert_allclose(values.ravel(), expected, rtol=300 * np.finfo(dtype).eps)
