"""Field, force and attraction over the gap, and the inserts, against published figures and 50 digits; their domains."""

import math
import pickle
from collections.abc import Callable, Iterable
from itertools import product
from typing import Any

import mpmath as mp
import msgspec
import numpy as np
import pytest

from tormagd.element.physics.errors import DomainError, require
from tormagd.element.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw, flux_density_T
from tormagd.element.physics.force import (
    TORMAG,
    Elastomer,
    Geometry,
    brake_force_N,
    max_radial_moment_Tm,
)
from tormagd.element.physics.inserts import INSERTS, Insert, MeasuredForceRange, insert, relative_permeability
from tormagd.element.physics.magnets import CuboidMagnet, attraction_N
from tormagd.element.physics.relaxation import PronySeries

LAWS: list[FieldLaw] = [ThesisFieldLaw(), PowerFieldLaw(), PowerFieldLaw(coefficient=0.462, exponent=-1.33)]


def test_eq_7_gives_the_published_flux_density_at_the_shaft() -> None:
    law = ThesisFieldLaw()
    found_T = [flux_density_T(law.radial_moment_Tm(gap), 4.0, 0.004) for gap in (45.0, 95.0)]
    assert found_T == pytest.approx([0.762, 0.314], abs=0.0005)
    assert law.d_radial_moment_d_gap(95.0) == 0.0, "it is flat at its own end"


def test_flux_density_over_the_radial_moment() -> None:
    assert flux_density_T(3.1e-3, 3.2, 0.004) == pytest.approx(3.1e-3 * 0.8 / 0.004)


STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


@pytest.mark.parametrize(("law", "weakest", "strongest"), [(ThesisFieldLaw(), 0.69, 5.0), (PowerFieldLaw(), 0.61, 5.3)])
def test_force_range_of_the_device(law: FieldLaw, weakest: float, strongest: float) -> None:
    assert brake_force_N(law.radial_moment_Tm(np.array([95.0, 45.0])), STIFF, TORMAG) == pytest.approx(
        [weakest, strongest], rel=0.01
    )


def test_the_edge_of_the_domain_is_admitted_and_nothing_beyond() -> None:
    largest = max_radial_moment_Tm(STIFF, TORMAG)
    assert brake_force_N(0.0, STIFF, TORMAG) == 0.0 < brake_force_N(largest, STIFF, TORMAG)
    with pytest.raises(DomainError, match="not allowed"):
        brake_force_N(math.nextafter(largest, math.inf), STIFF, TORMAG)


BLOCK = CuboidMagnet(width_m=0.040, depth_m=0.040, thickness_m=0.020, remanence_T=1.45)


def published_sum_N(gap_mm: float, magnet: CuboidMagnet) -> Any:
    """Akoun and Yonnet's force along z, all 64 terms, attraction positive."""
    a, b, c = (mp.mpf(edge_m) / 2 for edge_m in (magnet.width_m, magnet.depth_m, magnet.thickness_m))
    distance = mp.mpf(gap_mm) / 1000 + 2 * c
    total = mp.mpf(0)
    for i, j, k, m, p, q in product((1, -1), repeat=6):
        u, v, w = (j - i) * a, (m - k) * b, distance + (q - p) * c
        r = mp.sqrt(u * u + v * v + w * w)
        logs = u * w * mp.log(r - u) + v * w * mp.log(r - v)
        total += i * j * k * m * p * q * (logs - u * v * mp.atan(u * v / (r * w)) + r * w)
    return mp.mpf(magnet.remanence_T) ** 2 / (16 * mp.pi**2 * mp.mpf(10) ** -7) * total


def test_agrees_with_the_published_sum_for_any_block_out_to_the_last_gap() -> None:
    rng = np.random.default_rng(1)
    for edges_m in 10 ** rng.uniform(-3.0, 0.0, (60, 3)):
        width_m, depth_m, thickness_m = map(float, edges_m)
        magnet = CuboidMagnet(width_m, depth_m, thickness_m, 1.3)
        last_mm = 49.999e3 * min(width_m, depth_m, thickness_m)
        for gap_mm in (last_mm, 10 ** rng.uniform(-1.0, math.log10(last_mm))):
            with mp.workdps(50):
                expected = float(published_sum_N(gap_mm, magnet))
            assert attraction_N(gap_mm, magnet) == pytest.approx(expected, rel=1e-5), edges_m
    with pytest.raises(DomainError, match="gap_mm"):
        attraction_N(1.01 * last_mm, magnet)


THESIS = [f"MRE-{shore}-{cip}" for shore in (10, 30, 50) for cip in (10, 20, 30, 40)]


def test_the_twelve_inserts_of_the_thesis_are_there() -> None:
    assert set(THESIS) <= set(INSERTS)
    assert all(insert(name).name == name for name in INSERTS)


def test_composition_reproduces_the_printed_masses() -> None:
    printed_g = {0.1: (83.2, 78.7), 0.2: (72.8, 157.4), 0.3: (62.4, 236.1), 0.4: (52.0, 314.8)}
    for item in map(insert, THESIS):
        masses_g = item.masses_g
        matrix_g, cip_g = printed_g[item.cip_fraction]
        assert (masses_g["matrix"], masses_g["cip"]) == pytest.approx((matrix_g, cip_g), abs=0.051)
        assert masses_g["slacker"] == masses_g["thinner"] == pytest.approx(4.9, abs=0.051)


def test_what_an_insert_states_itself_goes_before_its_matrix_and_eq_5() -> None:
    own = Insert("X", 50, 0.5, 310.0, relative_permeability=5.1, friction_coefficient=0.3)
    assert own.elastomer == Elastomer(310e3, 5.1, 0.3)
    usual = Insert("X", 50, 0.25, 160.0)
    assert (usual.elastomer.relative_permeability, usual.elastomer.friction_coefficient) == (
        pytest.approx(3.0),
        insert("MRE-50-10").elastomer.friction_coefficient,
    )
    with pytest.raises(DomainError, match="measured"):
        _ = usual.force_range
    with pytest.raises(DomainError, match="estimate_N"):
        _ = MeasuredForceRange(3.1, 0.1).thesis_estimate_N
    for needs in ("elastomer", "masses_g"):
        with pytest.raises(DomainError, match="X: shore_hardness = 20 is not allowed"):
            getattr(Insert("X", 20, 0.25, 160.0), needs)


@pytest.mark.parametrize(
    "odd",
    [{"cip_fraction": 0.7}, {"cip_fraction": float("nan")}, {"shear_modulus_kPa": -1.0}, {"name": "a b"}, {"x": 1}],
)
def test_what_makes_no_sense_is_refused_by_its_key(odd: dict[str, object]) -> None:
    row = {"name": "X", "shore_hardness": 50, "cip_fraction": 0.2, "shear_modulus_kPa": 100.0}
    with pytest.raises(msgspec.ValidationError, match=next(iter(odd))):
        msgspec.convert(row | odd, Insert)


SERIES = PronySeries(fractions=(0.05, 0.04, 0.04), times_s=(8.0, 90.0, 900.0))


ONE_BY_ONE: list[tuple[Callable[[Any], Any], float, float, float]] = [
    *((method, 46.0, 94.0, 16) for law in LAWS for method in (law.radial_moment_Tm, law.d_radial_moment_d_gap)),
    *((law.gap_mm, law.radial_moment_Tm(94.0), law.radial_moment_Tm(46.0), 2000) for law in LAWS),
    (lambda moment: brake_force_N(moment, STIFF, TORMAG), 0.0, 0.9 * max_radial_moment_Tm(STIFF, TORMAG), 300),
    (lambda gap: attraction_N(gap, BLOCK), 0.02, 200.0, 300),
]
"Each with a range, and by how many of its last digits a number of an array may differ."


@pytest.mark.parametrize(("law", "low", "high", "digits"), ONE_BY_ONE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_keep_type_and_shape_and_agree_with_floats(
    law: Callable[[Any], Any], low: float, high: float, digits: float, dtype: Any
) -> None:
    points = np.linspace(low, high, 12).astype(dtype).reshape(3, 4)
    values = law(points)
    assert (values.dtype, values.shape) == (dtype, points.shape)
    np.testing.assert_allclose(
        values.ravel(), [law(float(one)) for one in points.ravel()], rtol=digits * np.finfo(dtype).eps
    )
    assert isinstance(law(0.5 * (low + high)), float)


NO_NUMBER = (math.nan, math.inf)
Refused = tuple[Callable[..., Any], tuple[Any, ...], str]


def in_each_place(
    function: Callable[..., Any], values: tuple[float, ...], names: tuple[str, ...], bad: tuple[float, ...]
) -> list[Refused]:
    return [
        (function, (*values[:place], wrong, *values[place + 1 :]), name)
        for place, name in enumerate(names)
        for wrong in bad
    ]


def alone_and_among(
    function: Callable[..., Any], good: float, bad: Iterable[float], name: str, *rest: Any
) -> list[Refused]:
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
    *alone_and_among(brake_force_N, 1e-3, (*NO_NUMBER, -1e-9), "radial_moment_Tm", STIFF, TORMAG),
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
    assert (type(copy), str(copy), copy.variable, copy.value, copy.allowed) == (
        DomainError,
        str(caught.value),
        "gap_mm",
        -1.0,
        "a number from 0 to 100",
    )
