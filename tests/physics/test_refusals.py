"""What every law keeps: the type and shape of arrays, and its domain, by name."""

import math
import pickle
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from tormagd.lab.design.force_law import d_force_d_moment, radial_moment_for_force_Tm, stretch_minus_one
from tormagd.physics.errors import DomainError, require
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw, flux_density_T
from tormagd.physics.force import (
    TORMAG,
    Elastomer,
    Geometry,
    brake_force_N,
    max_radial_moment_Tm,
)
from tormagd.physics.inserts import insert, relative_permeability
from tormagd.physics.magnets import CuboidMagnet, attraction_N
from tormagd.physics.relaxation import PronySeries

# -- the field over the gap --------------------------------------------------------------------------------------------


LAWS: list[FieldLaw] = [ThesisFieldLaw(), PowerFieldLaw(), PowerFieldLaw(coefficient=0.462, exponent=-1.33)]


# -- the force of the brake --------------------------------------------------------------------------------------------


OF_MOMENT = (stretch_minus_one, brake_force_N, d_force_d_moment)
STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


# -- the attraction of the magnets, against the published 64-term sum in 50 digits, and against magpylib ---------------


BLOCK = CuboidMagnet(width_m=0.040, depth_m=0.040, thickness_m=0.020, remanence_T=1.45)


# -- relaxation --------------------------------------------------------------------------------------------------------


SERIES = PronySeries(fractions=(0.05, 0.04, 0.04), times_s=(8.0, 90.0, 900.0))


# -- arrays ------------------------------------------------------------------------------------------------------------

ONE_BY_ONE: list[tuple[Callable[[Any], Any], float, float, float]] = [
    *((method, 46.0, 94.0, 16) for law in LAWS for method in (law.radial_moment_Tm, law.d_radial_moment_d_gap)),
    *((law.gap_mm, law.radial_moment_Tm(94.0), law.radial_moment_Tm(46.0), 2000) for law in LAWS),
    *(
        (lambda moment, of=of: of(moment, STIFF, TORMAG), 0.0, 0.9 * max_radial_moment_Tm(STIFF, TORMAG), 300)
        for of in OF_MOMENT
    ),
    (lambda gap: attraction_N(gap, BLOCK), 0.02, 200.0, 300),
]
"""Each with a range, and by how many of its last digits a number of an array may differ."""


@pytest.mark.parametrize(("law", "low", "high", "digits"), ONE_BY_ONE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_keep_type_and_shape_and_agree_with_floats(
    law: Callable[[Any], Any], low: float, high: float, digits: float, dtype: Any
) -> None:
    points = np.linspace(low, high, 12).astype(dtype).reshape(3, 4)
    values = law(points)
    assert (values.dtype, values.shape) == (dtype, points.shape)
    expected = [law(float(one)) for one in points.ravel()]
    np.testing.assert_allclose(values.ravel(), expected, rtol=digits * np.finfo(dtype).eps)
    assert isinstance(law(0.5 * (low + high)), float)


# -- what is refused ---------------------------------------------------------------------------------------------------

NO_NUMBER = (math.nan, math.inf)
Refused = tuple[Callable[..., Any], tuple[Any, ...], str]


def in_each_place(
    function: Callable[..., Any], values: tuple[float, ...], names: tuple[str, ...], bad: tuple[float, ...]
) -> list[Refused]:
    """Each of these values in turn is bad, and is named."""
    return [
        (function, (*values[:place], wrong, *values[place + 1 :]), name)
        for place, name in enumerate(names)
        for wrong in bad
    ]


def alone_and_among(
    function: Callable[..., Any], good: float, bad: Iterable[float], name: str, *rest: Any
) -> list[Refused]:
    """Each bad value by itself, and in an array with a good one."""
    return [(function, (value, *rest), name) for one in bad for value in (one, np.array([good, one]))]


def of_law(law: FieldLaw) -> list[Refused]:
    low, high = law.gap_range_mm
    outside = (math.nextafter(low, 0.0), math.nextafter(high, math.inf), *NO_NUMBER, -60.0)
    methods = (law.radial_moment_Tm, law.d_radial_moment_d_gap)
    too_strong = 1.01 * law.radial_moment_Tm(low)
    return [
        *(row for method in methods for row in alone_and_among(method, 60.0, outside, "gap_mm")),
        *((law.gap_mm, (moment,), "radial_moment_Tm") for moment in (0.0, too_strong, math.nan)),
    ]


REFUSED: list[Refused] = [
    *(row for law in LAWS for row in of_law(law)),
    (
        ThesisFieldLaw().radial_moment_Tm,
        (np.array([50.0, 96.0]),),
        r"gap_mm = 96\.0 is not allowed: a number from 45 to 95",
    ),
    *(
        (PowerFieldLaw().radial_moment_Tm, (gap,), "gap_mm")
        for gap in (np.array([60]), [60.0], "60", None, np.array([60.0 + 1j]))
    ),
    *((PowerFieldLaw, (0.44, bad), "exponent") for bad in (1.3, math.nan)),
    *((PowerFieldLaw, (bad, -1.3), "coefficient") for bad in (0.0, math.nan)),
    (flux_density_T, (1e-3, 0.9, 0.004), "relative_permeability"),
    (flux_density_T, (1e-3, 4.0, 0.0), "radius_m"),
    (flux_density_T, (-1e-3, 4.0, 0.004), "radial_moment_Tm"),
    (flux_density_T, (math.nan, 4.0, 0.004), "radial_moment_Tm"),
    *(
        row
        for function in OF_MOMENT
        for row in alone_and_among(function, 1e-3, (*NO_NUMBER, -1e-9), "radial_moment_Tm", STIFF, TORMAG)
    ),
    *((radial_moment_for_force_Tm, (bad, STIFF, TORMAG), "force_N") for bad in (*NO_NUMBER, -1e-9)),
    *in_each_place(
        Elastomer,
        (277.3e3, 4.0, 0.2),
        ("shear_modulus_Pa", "relative_permeability", "friction_coefficient"),
        (*NO_NUMBER, 0.0, -1.0),
    ),
    *in_each_place(
        Geometry,
        (0.004, 0.011, 0.02, 0.02),
        ("inner_radius_m", "outer_radius_m", "thickness_m", "roller_radius_m"),
        (*NO_NUMBER, 0.0, -0.01),
    ),
    (Geometry, (0.011, 0.011, 0.02, 0.02), "outer_radius_m"),
    *((relative_permeability, (outside,), "cip_fraction") for outside in (0.09, 0.41, 40.0, math.nan)),
    (insert, ("MRE-40",), r"insert = 'MRE-40' is not allowed: one of MRE-10-10, .*MRE-50-40"),
    *alone_and_among(attraction_N, 60.0, (0.0, -1.0, 1001.0, *NO_NUMBER), "gap_mm", BLOCK),
    (CuboidMagnet, (0.0, 0.04, 0.02, 1.45), "width_m"),
    (CuboidMagnet, (0.04, math.nan, 0.02, 1.45), "depth_m"),
    (CuboidMagnet, (0.04, 0.04, 0.02, 14.5), "remanence_T"),
    (PronySeries, ((0.5, 0.5), (1.0, 2.0)), "fractions"),
    (PronySeries, ((-0.1,), (1.0,)), "fractions"),
    (PronySeries, ((math.nan,), (1.0,)), "fractions"),
    (PronySeries, ((0.1,), (0.0,)), "times_s"),
    (PronySeries, ((0.1,), (math.inf,)), "times_s"),
    (PronySeries, ((0.1, 0.1), (1.0,)), "times_s"),
    *((SERIES.discretise(1e-4).advance, (SERIES.relaxed(0.0), bad), "driving_N") for bad in (*NO_NUMBER, -math.inf)),
    *((SERIES.relaxed, (bad,), "driving_N") for bad in (*NO_NUMBER, -math.inf)),
    *((SERIES.discretise, (bad,), "dt_s") for bad in (*NO_NUMBER, -math.inf)),
    (SERIES.discretise(1e-4).advance, ((0.0, 0.0), 1.0), "state"),
]


@pytest.mark.parametrize(("function", "arguments", "name"), REFUSED)
def test_what_no_law_is_for_is_refused_by_name(
    function: Callable[..., Any], arguments: tuple[Any, ...], name: str
) -> None:
    with pytest.raises(DomainError, match=name):
        function(*arguments)


def test_an_error_can_be_sent_between_processes() -> None:
    with pytest.raises(DomainError) as caught:
        require("gap_mm", np.array([50.0, -1.0]), 0.0, 100.0)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert type(copy) is DomainError
    assert (str(copy), copy.variable, copy.value, copy.allowed) == (
        str(caught.value),
        "gap_mm",
        -1.0,
        "a number from 0 to 100",
    )
