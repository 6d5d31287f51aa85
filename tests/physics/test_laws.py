"""The laws of the device: field, force, attraction, friction, relaxation, inserts, and what each of them refuses."""

import json
import math
import pickle
import random
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import islice, pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import mpmath as mp
import msgspec
import numerics
import numpy as np
import pytest
from extremes import steps
from extremes.cases import Batch, reference
from hypothesis import example, given, strategies as st

from tormagd.lab.design.force_law import d_force_d_gap, d_force_d_moment, radial_moment_for_force_Tm, stretch_minus_one
from tormagd.physics.brake_curve import BrakeCurve
from tormagd.physics.errors import DomainError, require
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw, flux_density_T
from tormagd.physics.force import (
    TORMAG,
    Elastomer,
    Geometry,
    brake_force_N,
    max_radial_moment_Tm,
)
from tormagd.physics.friction import Friction
from tormagd.physics.inserts import INSERTS, Insert, MeasuredForceRange, insert, relative_permeability
from tormagd.physics.magnets import CuboidMagnet, attraction_N
from tormagd.physics.relaxation import PronySeries

# -- the field over the gap --------------------------------------------------------------------------------------------


LAWS: list[FieldLaw] = [ThesisFieldLaw(), PowerFieldLaw(), PowerFieldLaw(coefficient=0.462, exponent=-1.33)]


def test_eq_7_gives_the_published_flux_density_at_the_shaft() -> None:
    law = ThesisFieldLaw()
    at_45, at_95 = (flux_density_T(law.radial_moment_Tm(gap), 4.0, 0.004) for gap in (45.0, 95.0))
    assert at_45 == pytest.approx(0.762, abs=0.0005)
    assert at_95 == pytest.approx(0.314, abs=0.0005)
    assert law.d_radial_moment_d_gap(95.0) == 0.0, "it is flat at its own end"


def test_the_two_laws_agree_on_the_device_range() -> None:
    gap = np.linspace(45.0, 95.0, 101)
    ratio = PowerFieldLaw().radial_moment_Tm(gap) / ThesisFieldLaw().radial_moment_Tm(gap)
    assert 0.03 < np.abs(ratio - 1.0).max() < 0.10


@pytest.mark.parametrize("law", LAWS)
@given(position=st.floats(0.0, 1.0))
@example(position=0.0)
@example(position=1.0)
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


def test_flux_density_over_the_radial_moment() -> None:
    assert flux_density_T(3.1e-3, 3.2, 0.004) == pytest.approx(3.1e-3 * 0.8 / 0.004)


# -- the force of the brake --------------------------------------------------------------------------------------------


OF_MOMENT = (stretch_minus_one, brake_force_N, d_force_d_moment)
STIFF = Elastomer(shear_modulus_Pa=277.3e3, relative_permeability=4.0, friction_coefficient=0.2)


class Case(NamedTuple):
    moment: float
    elastomer: Elastomer
    geometry: Geometry

    def batch(self) -> Batch:
        """As `tools/numerics.py` computes it in 50 digits."""
        return Batch(self.elastomer, self.geometry, None, np.array([]))


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


@pytest.mark.parametrize(("cases", "count"), [(over_gaps, 1500), (over_loads, 1500)])
def test_float64_force_and_slope_agree_with_50_digits(cases: Callable[[int], Iterator[Case]], count: int) -> None:
    admitted = 0
    for case in islice(cases(1), count):
        truth = reference(case.batch(), case.moment)
        if case.moment > max_radial_moment_Tm(case.elastomer, case.geometry):
            assert truth.stretch < 0.05
            with pytest.raises(DomainError, match="radial_moment_Tm"):
                brake_force_N(*case)
            continue
        admitted += 1
        error = abs(mp.mpf(brake_force_N(*case)) / truth.values["force"] - 1)
        assert error <= max(1e-12, 8 * 2.0**-52 * truth.conditions["force"]), case
        assert stretch_minus_one(*case) == pytest.approx(float(truth.values["stretch"]), rel=1e-12), case
        assert d_force_d_moment(*case) == pytest.approx(float(truth.values["slope"]), rel=1e-11), case
    assert admitted > 0.3 * count


def test_float32_force_agrees_with_float64() -> None:
    """Whose own error is a ten-millionth of what is allowed here."""
    strained = 0
    for case in islice(over_loads(2), 1500):
        moment = np.array([0.999 * case.moment], dtype=np.float32)
        exact = Case(float(moment[0]), case.elastomer, case.geometry)
        result = brake_force_N(moment, case.elastomer, case.geometry)
        assert result.dtype == np.float32
        is_soft = stretch_minus_one(*exact) < -0.3
        strained += is_soft
        assert abs(float(result[0]) / brake_force_N(*exact) - 1) <= (3e-4 if is_soft else 1e-5), case
    assert strained > 200


@pytest.mark.parametrize(("law", "weakest", "strongest"), [(ThesisFieldLaw(), 0.69, 5.0), (PowerFieldLaw(), 0.61, 5.3)])
def test_force_range_of_the_device(law: FieldLaw, weakest: float, strongest: float) -> None:
    force = brake_force_N(law.radial_moment_Tm(np.array([95.0, 45.0])), STIFF, TORMAG)
    assert force == pytest.approx([weakest, strongest], rel=0.01)


@pytest.mark.parametrize("law", [ThesisFieldLaw(), PowerFieldLaw()])
@pytest.mark.parametrize("gap", [46.0, 55.0, 70.0, 90.0])
def test_the_slope_over_the_gap_is_that_of_the_force(law: FieldLaw, gap: float) -> None:
    slope = reference(Batch(STIFF, TORMAG, law, np.array([])), gap).values["slope"]
    assert d_force_d_gap(gap, law, STIFF, TORMAG) == pytest.approx(float(slope), rel=1e-9)


def test_force_rises_strictly_with_the_field() -> None:
    for elastomer, geometry, _ in islice(corners_and_random(4), 200):
        moment = np.linspace(0.0, max_radial_moment_Tm(elastomer, geometry), 400)
        assert (np.diff(brake_force_N(moment, elastomer, geometry)) > 0.0).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_inverse_of_arrays(dtype: Any) -> None:
    for elastomer, geometry, _ in islice(corners_and_random(6), 50):
        largest = max_radial_moment_Tm(elastomer, geometry)
        moment = (largest * np.append(0.0, np.logspace(-6.0, -1e-3, 119))).astype(dtype).reshape(8, 15)
        back = radial_moment_for_force_Tm(brake_force_N(moment, elastomer, geometry), elastomer, geometry)
        assert back.dtype == dtype
        np.testing.assert_allclose(back, moment, rtol=16 * np.finfo(dtype).eps)


def test_the_inverse_returns_the_radial_moment() -> None:
    for case in islice(over_loads(5), 1500):
        force = brake_force_N(*case)
        assert radial_moment_for_force_Tm(force, case.elastomer, case.geometry) == pytest.approx(case.moment, rel=4e-15)


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


# -- the attraction of the magnets, against the published 64-term sum in 50 digits, and against magpylib ---------------


BLOCK = CuboidMagnet(width_m=0.040, depth_m=0.040, thickness_m=0.020, remanence_T=1.45)
SLAB = CuboidMagnet(width_m=0.060, depth_m=0.015, thickness_m=0.008, remanence_T=1.2)


def published_sum_N(gap_mm: float, magnet: CuboidMagnet) -> Any:
    """Akoun and Yonnet's force along z, all 64 terms, attraction positive."""
    a, b, c, remanence = (
        mp.mpf(edge) / divisor
        for edge, divisor in (
            (magnet.width_m, 2),
            (magnet.depth_m, 2),
            (magnet.thickness_m, 2),
            (magnet.remanence_T, 1),
        )
    )
    distance = mp.mpf(gap_mm) / 1000 + 2 * c
    total = mp.mpf(0)
    for i, j, k, m, p, q in product((1, -1), repeat=6):
        u, v, w = (j - i) * a, (m - k) * b, distance + (q - p) * c
        r = mp.sqrt(u * u + v * v + w * w)
        logs = u * w * mp.log(r - u) + v * w * mp.log(r - v)
        total += i * j * k * m * p * q * (logs - u * v * mp.atan(u * v / (r * w)) + r * w)
    return remanence**2 / (16 * mp.pi**2 * mp.mpf(10) ** -7) * total


@pytest.mark.parametrize("magnet", [BLOCK, SLAB])
@pytest.mark.parametrize(
    ("gap_mm", "tolerance"), [(0.01, 1e-12), (1.0, 1e-12), (45.0, 1e-11), (95.0, 1e-11), (200.0, 1e-9), (400.0, 1e-7)]
)
def test_agrees_with_the_published_sum(magnet: CuboidMagnet, gap_mm: float, tolerance: float) -> None:
    with mp.workdps(50):
        expected = float(published_sum_N(gap_mm, magnet))
    assert attraction_N(gap_mm, magnet) == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("magnet", [BLOCK, SLAB])
def test_agrees_with_magpylib(magnet: CuboidMagnet) -> None:
    magpylib = pytest.importorskip("magpylib")
    gaps_mm = np.array([10.0, 45.0, 60.0, 80.0, 95.0])
    edges = (magnet.width_m, magnet.depth_m, magnet.thickness_m)
    for gap_mm, ours in zip(gaps_mm, attraction_N(gaps_mm, magnet), strict=True):
        above = (0.0, 0.0, magnet.thickness_m + gap_mm * 1e-3)
        lower = magpylib.magnet.Cuboid(dimension=edges, polarization=(0.0, 0.0, magnet.remanence_T))
        upper = magpylib.magnet.Cuboid(dimension=edges, polarization=(0.0, 0.0, magnet.remanence_T), position=above)
        force, _ = magpylib.getFT(lower, upper, meshing=(16, 16, 8))
        assert -force[2] == pytest.approx(ours, rel=2e-3)


def test_agrees_with_the_published_sum_for_any_block_out_to_the_last_gap() -> None:
    rng = np.random.default_rng(1)
    for edges_m in 10 ** rng.uniform(-3.0, 0.0, (150, 3)):
        width_m, depth_m, thickness_m = map(float, edges_m)
        magnet = CuboidMagnet(width_m, depth_m, thickness_m, 1.3)
        last_mm = 49.999e3 * min(width_m, depth_m, thickness_m)
        for gap_mm in (last_mm, 10 ** rng.uniform(-1.0, math.log10(last_mm))):
            with mp.workdps(50):
                expected = float(published_sum_N(gap_mm, magnet))
            assert attraction_N(gap_mm, magnet) == pytest.approx(expected, rel=1e-5), edges_m
    with pytest.raises(DomainError, match="gap_mm"):
        attraction_N(1.01 * last_mm, magnet)


def test_far_apart_they_are_two_dipoles() -> None:
    moment = BLOCK.remanence_T / (4e-7 * math.pi) * BLOCK.width_m * BLOCK.depth_m * BLOCK.thickness_m
    distance_m = 0.8 + BLOCK.thickness_m
    assert attraction_N(800.0, BLOCK) == pytest.approx(6e-7 * moment**2 / distance_m**4, rel=0.01)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_falls_with_the_gap(dtype: Any) -> None:
    force = attraction_N(np.linspace(0.01, 200.0, 400).astype(dtype), BLOCK)
    assert (np.diff(force) < 0.0).all()
    assert force.min() > 0.0


# -- friction ----------------------------------------------------------------------------------------------------------


FRICTION = Friction(presliding_stiffness_N_mm=8.0, viscous_N_s_mm=0.0005, static_ratio=1.15, stribeck_speed_mm_s=5.0)
frictions = st.builds(
    Friction,
    presliding_stiffness_N_mm=st.floats(0.1, 100.0),
    viscous_N_s_mm=st.floats(0.0, 0.1),
    static_ratio=st.floats(1.0, 2.0),
    stribeck_speed_mm_s=st.floats(0.1, 50.0),
)
speeds = st.floats(-200.0, 200.0)
levels = st.floats(0.0, 10.0)


@pytest.mark.parametrize(
    ("speed_mm_s", "force_N", "rel"),
    [
        (42.0, 2.0 + 0.0005 * 42.0, 1e-6),
        (-42.0, -2.0 - 0.0005 * 42.0, 1e-6),
        (1e-2, 2.0 * 1.15, 1e-4),
        (5.0, 2.0 * (1.0 + 0.15 / math.e) + 0.0025, 1e-6),
    ],
)
def test_steady_sliding_gives_kinetic_plus_viscous_force_and_break_away_the_static_level(
    speed_mm_s: float, force_N: float, rel: float
) -> None:
    assert FRICTION.advance(0.0, speed_mm_s, 2.0, 1e3)[0] == pytest.approx(force_N, rel=rel)


def test_the_first_micrometres_are_a_spring() -> None:
    force, deflection = FRICTION.advance(0.0, 0.1, 2.0, 1e-2)
    assert deflection == pytest.approx(1e-3, rel=3e-3)
    assert force == pytest.approx(8.0 * deflection + 0.0005 * 0.1, rel=1e-12)


def test_the_exact_solution_between_reversals() -> None:
    """From -z_ss, dz/dt = v - sigma0 |v| z / g has z = z_ss (1 - 2 exp(-x / z_ss)) after a travel x."""
    level = FRICTION.level_N(30.0, 2.0)
    reach = level / 8.0
    _, deflection = FRICTION.advance(-reach, 30.0, 2.0, 0.01)
    assert deflection == pytest.approx(reach * (1.0 - 2.0 * math.exp(-0.3 / reach)), rel=1e-12)


def test_at_rest_the_force_is_held() -> None:
    assert FRICTION.advance(0.1, 0.0, 2.0, 1e3) == pytest.approx((0.8, 0.1), rel=1e-15)


def test_a_falling_level_lets_the_bristle_slip() -> None:
    _, deflection = FRICTION.advance(0.25, 0.0, 0.5, 0.0)
    assert 8.0 * deflection == pytest.approx(0.5 * 1.15)
    assert FRICTION.advance(0.25, 42.0, 0.0, 1e-3) == pytest.approx((0.021, 0.0))


@given(frictions, st.floats(-1.0, 1.0), speeds, st.floats(0.01, 10.0), st.floats(1e-6, 0.1), st.floats(0.0, 1.0))
def test_splitting_a_stroke_changes_nothing(
    friction: Friction, start_mm: float, speed_mm_s: float, kinetic_N: float, dt_s: float, share: float
) -> None:
    _, whole = friction.advance(start_mm, speed_mm_s, kinetic_N, dt_s)
    _, part = friction.advance(start_mm, speed_mm_s, kinetic_N, share * dt_s)
    _, rest = friction.advance(part, speed_mm_s, kinetic_N, (1.0 - share) * dt_s)
    assert rest == pytest.approx(whole, abs=1e-12)


@given(frictions, st.floats(-10.0, 10.0), st.floats(-1e6, 1e6), st.floats(0.0, 1e6), st.floats(0.0, 1e6))
def test_the_dry_force_never_exceeds_the_level(
    friction: Friction, start_mm: float, speed_mm_s: float, kinetic_N: float, dt_s: float
) -> None:
    force, deflection = friction.advance(start_mm, speed_mm_s, kinetic_N, dt_s)
    assert math.isfinite(force)
    level_N = friction.level_N(speed_mm_s, kinetic_N)
    # below 1e-300 a float has not the digits for a relative bound
    assert abs(friction.presliding_stiffness_N_mm * deflection) <= level_N * (1 + 1e-12) + 1e-300


@given(frictions, st.lists(st.tuples(speeds, levels, st.floats(1e-4, 0.5)), min_size=1, max_size=40))
def test_passive_under_any_motion_and_any_field(friction: Friction, steps: list[tuple[float, float, float]]) -> None:
    """The hand never gets back more than it put in: work done stays above the energy stored in the bristles."""
    deflection_mm, work_mJ = 0.0, 0.0
    for speed_mm_s, kinetic_N, dt_s in steps:
        force_N, deflection_mm = friction.advance(deflection_mm, speed_mm_s, kinetic_N, dt_s)
        work_mJ += force_N * speed_mm_s * dt_s
        stored_mJ = 0.5 * friction.presliding_stiffness_N_mm * deflection_mm**2
        assert work_mJ >= stored_mJ - 1e-9 * (1.0 + work_mJ)


@given(frictions, st.floats(0.1, 10.0), st.floats(0.01, 20.0), st.floats(0.1, 5.0), st.integers(8, 100))
def test_a_closed_cycle_costs_the_hand_work(
    friction: Friction, kinetic_N: float, amplitude_mm: float, frequency_Hz: float, steps: int
) -> None:
    dt_s = 1.0 / (frequency_Hz * steps)
    positions = [amplitude_mm * math.sin(2.0 * math.pi * index / steps) for index in range(2 * steps + 1)]
    deflection_mm, works_mJ = 0.0, []
    for before, after in pairwise(positions):
        force_N, deflection_mm = friction.advance(deflection_mm, (after - before) / dt_s, kinetic_N, dt_s)
        works_mJ.append(force_N * (after - before))
    assert sum(works_mJ[steps:]) > 0.0


# -- relaxation --------------------------------------------------------------------------------------------------------


SERIES = PronySeries(fractions=(0.05, 0.04, 0.04), times_s=(8.0, 90.0, 900.0))
forces = st.floats(-10.0, 10.0)


def step_response(time_s: float) -> float:
    return 1.0 - sum(g * -math.expm1(-time_s / tau) for g, tau in zip(SERIES.fractions, SERIES.times_s, strict=True))


@pytest.mark.parametrize("time_s", [1e-6, 1e-3, 1.0, 10.0, 300.0, 1e5])
def test_a_step_relaxes_as_the_closed_form(time_s: float) -> None:
    force, state = SERIES.discretise(0.0).advance(SERIES.relaxed(0.0), 2.0)
    assert force == pytest.approx(2.0, rel=1e-15)
    force, _ = SERIES.discretise(time_s).advance(state, 2.0)
    assert force == pytest.approx(2.0 * step_response(time_s), rel=1e-14)


@pytest.mark.parametrize("dt_s", [1e-6, 1e-4, 1.0, 10.0])
def test_a_ramp_follows_the_closed_form(dt_s: float) -> None:
    """F0 = t: F = (1 - sum g) t + sum g tau (1 - exp(-t / tau)), whatever the step."""
    update, state, force = SERIES.discretise(dt_s), SERIES.relaxed(0.0), 0.0
    for index in range(1, 101):
        force, state = update.advance(state, index * dt_s)
    time_s = 100 * dt_s
    branches = sum(
        g * tau * -math.expm1(-time_s / tau) for g, tau in zip(SERIES.fractions, SERIES.times_s, strict=True)
    )
    assert force == pytest.approx(0.87 * time_s + branches, rel=1e-12)


@given(forces, forces, st.floats(1e-6, 10.0), st.integers(2, 50))
def test_splitting_a_step_changes_nothing(start_N: float, end_N: float, dt_s: float, parts: int) -> None:
    jumped = SERIES.discretise(0.0).advance(SERIES.relaxed(0.0), start_N)[1]
    whole_N, whole = SERIES.discretise(dt_s).advance(jumped, end_N)
    update, state, force_N = SERIES.discretise(dt_s / parts), jumped, math.nan
    for index in range(1, parts + 1):
        force_N, state = update.advance(state, start_N + (end_N - start_N) * index / parts)
    assert force_N == pytest.approx(whole_N, abs=1e-12)
    assert state == pytest.approx(whole, abs=1e-12)


@given(st.lists(st.tuples(forces, forces), min_size=1, max_size=50), st.floats(1e-6, 10.0))
def test_superposition_and_the_bound_of_the_response(pairs: list[tuple[float, float]], dt_s: float) -> None:
    update = SERIES.discretise(dt_s)
    one, two, both = SERIES.relaxed(0.0), SERIES.relaxed(0.0), SERIES.relaxed(0.0)
    largest_N = max(abs(first) for first, _ in pairs)
    for first, second in pairs:
        force_one, one = update.advance(one, first)
        force_two, two = update.advance(two, second)
        force_both, both = update.advance(both, first + second)
        assert force_both == pytest.approx(force_one + force_two, abs=1e-12)
        assert abs(force_one) <= (1.0 + sum(SERIES.fractions)) * largest_N + 1e-12


def test_a_rested_element_carries_the_equilibrium_share_and_may_undershoot() -> None:
    update, state = SERIES.discretise(1e-3), SERIES.relaxed(5.0)
    assert update.advance(state, 5.0)[0] == pytest.approx(0.87 * 5.0)
    assert update.advance(state, 0.5)[0] == pytest.approx(0.87 * 0.5 - 0.13 * 4.5, rel=1e-3)


def test_a_series_without_branches_is_the_identity() -> None:
    empty = PronySeries((), ())
    assert empty.discretise(1e-4).advance(empty.relaxed(1.0), 3.0) == (3.0, (3.0,))


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
    assert values.dtype == dtype
    assert values.shape == points.shape
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
    assert str(copy) == str(caught.value)
    assert (copy.variable, copy.value, copy.allowed) == ("gap_mm", -1.0, "a number from 0 to 100")


# -- tools/numerics.py itself, on a sample; that it can fail; and loads that it does not draw --------------------------


TOOL = Path(__file__).parents[2] / "tools" / "numerics.py"


def test_a_sampled_run_passes_and_has_the_agreed_keys() -> None:
    command = [sys.executable, str(TOOL), "--json", "--cases", "20000", "--reference", "400", "--episodes", "1"]
    command += ["--configurations", "1", "--seconds", "0.1", "--networks", "500"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["cases"] >= 20_000
    assert found["reference_cases"] >= 400
    assert found["nonfinite"] == found["misjudged"] == 0
    assert found["refused"] > 0
    assert 0.0 < found["worst_rel_error"]["float64"] <= 1e-12
    assert 0.0 < found["worst_rel_error"]["float32"] <= 1e-5
    assert 0.0 < found["worst_rel_error"]["float32_soft"] <= 3e-4
    assert all(share <= 1.0 for share in found["over_allowed"].values())
    assert found["travelled"] == 0
    assert found["stage_cases"] == sum(row["cases"] for row in found["stages"])
    assert found["configurations"]["cases"] == 1
    assert found["counters"]["passed"]
    assert found["networks"]["torque_mre_50_40"]["float32_mN"] < 0.01


def test_an_error_in_the_physics_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """One part in 1e11 on the force, far below what any plot would show."""
    original = BrakeCurve.force
    monkeypatch.setattr(BrakeCurve, "force", lambda self, eps, load: original(self, eps, load) * (1.0 + 1e-11))
    tally = numerics.check_chunk(seed=3, devices=8, references=20)
    assert tally.worst["float64", "force"].over_allowed > 5.0
    assert tally.worst["float64", "stretch"].over_allowed < 1.0


def test_a_naive_formula_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """lambda1 from the printed difference, as Eq. 29 has it, cancels while the field is weak."""
    monkeypatch.setattr(
        BrakeCurve,
        "compression",
        lambda self, y: ((1 - self.a * y) ** 2 + 2 * self.b * y) ** 0.5 - (1 - self.a * y),
    )
    tally = numerics.check_chunk(seed=3, devices=8, references=20)
    assert tally.worst["float64", "stretch"].over_allowed > 10.0


def test_wrong_time_steps_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    assert max(found.over_allowed for found in steps.worst_step_errors(1, 20).worst.values()) <= 1.0
    # a decay by a difference of nearly equal numbers loses its digits at 1 us
    monkeypatch.setattr("tormagd.physics.relaxation.math.expm1", lambda x: math.exp(x) - 1.0)
    assert steps.worst_step_errors(1, 20).worst["steps", "relaxation"].over_allowed > 1.0


@given(
    st.builds(Elastomer, st.floats(1e3, 1e7), st.floats(1.0, 10.0), st.just(0.2)),
    st.tuples(st.floats(1e-3, 20e-3), st.floats(1e-4, 0.05), st.floats(0.5e-3, 0.05)),
    st.floats(1e-30, 1.0),
    st.sampled_from([np.float32, np.float64]),
)
def test_no_load_in_the_domain_gives_anything_but_a_number(
    elastomer: Elastomer, shape: tuple[float, float, float], share: float, dtype: type
) -> None:
    inner, wall, thickness = shape
    geometry = Geometry(inner, inner + wall, thickness, 0.02)
    most = max_radial_moment_Tm(elastomer, geometry)
    moment: Any = np.array([min(share, 0.999) * most], dtype=dtype)
    force = brake_force_N(moment, elastomer, geometry)
    assert force.dtype == dtype
    assert np.isfinite(force).all()
    assert (force >= 0.0).all()
    assert np.isfinite(radial_moment_for_force_Tm(force, elastomer, geometry)).all()


# -- the twelve inserts against the thesis's tables ----------------------------------


def modelled_range_N(item: Insert) -> float:
    near, far = brake_force_N(ThesisFieldLaw().radial_moment_Tm(np.array([45.0, 95.0])), item.elastomer, TORMAG)
    return float(near - far)


def test_twelve_inserts_three_matrices_by_four_fillings() -> None:
    assert sorted(INSERTS) == sorted(f"MRE-{shore}-{cip}" for shore in (10, 30, 50) for cip in (10, 20, 30, 40))
    assert all(insert(name).name == name for name in INSERTS)


def test_composition_reproduces_the_printed_masses() -> None:
    printed_g = {0.1: (83.2, 78.7), 0.2: (72.8, 157.4), 0.3: (62.4, 236.1), 0.4: (52.0, 314.8)}
    for item in INSERTS.values():
        masses_g = item.masses_g
        matrix_g, cip_g = printed_g[item.cip_fraction]
        assert masses_g["matrix"] == pytest.approx(matrix_g, abs=0.051)
        assert masses_g["cip"] == pytest.approx(cip_g, abs=0.051)
        assert masses_g["slacker"] == masses_g["thinner"] == pytest.approx(4.9, abs=0.051)


def test_permeability_is_linear_in_the_filling() -> None:
    assert [relative_permeability(cip) for cip in (0.1, 0.25, 0.4)] == pytest.approx([2.0, 3.0, 4.0])


def test_one_friction_coefficient_per_matrix_reproduces_the_measured_ranges() -> None:
    errors = [abs(modelled_range_N(item) / item.force_range.measured_N - 1.0) for item in INSERTS.values()]
    assert np.mean(errors) == pytest.approx(0.107, abs=0.001)
    assert max(errors) < 0.18


def test_the_range_grows_with_the_filling_as_measured() -> None:
    for shore in (10, 30, 50):
        ranges = [modelled_range_N(insert(f"MRE-{shore}-{cip}")) for cip in (10, 20, 30, 40)]
        assert ranges == sorted(ranges)


def test_printed_errors_that_do_not_follow_from_the_printed_ranges() -> None:
    for name, error_N, relative in (("MRE-10-30", 0.12, 0.055), ("MRE-50-30", 0.61, 0.172)):
        measured = insert(name).force_range
        gap_N = abs(measured.thesis_estimate_N - measured.measured_N)
        assert gap_N == pytest.approx(error_N, abs=0.005)
        assert gap_N / measured.measured_N == pytest.approx(relative, abs=0.0005)


def test_what_an_insert_states_itself_goes_before_its_matrix_and_eq_5() -> None:
    own = Insert("X", 50, 0.5, 310.0, relative_permeability=5.1, friction_coefficient=0.3)
    assert own.elastomer == Elastomer(310e3, 5.1, 0.3)
    usual = Insert("X", 50, 0.25, 160.0)
    assert usual.elastomer.relative_permeability == pytest.approx(3.0)
    assert usual.elastomer.friction_coefficient == insert("MRE-50-10").elastomer.friction_coefficient
    with pytest.raises(DomainError, match="measured"):
        _ = usual.force_range
    with pytest.raises(DomainError, match="estimate_N"):
        _ = MeasuredForceRange(3.1, 0.1).thesis_estimate_N


@pytest.mark.parametrize(
    "odd",
    [{"cip_fraction": 0.7}, {"cip_fraction": float("nan")}, {"shear_modulus_kPa": -1.0}, {"name": "a b"}, {"x": 1}],
)
def test_what_makes_no_sense_is_refused_by_its_key(odd: dict[str, object]) -> None:
    row = {"name": "X", "shore_hardness": 50, "cip_fraction": 0.2, "shear_modulus_kPa": 100.0}
    with pytest.raises(msgspec.ValidationError, match=next(iter(odd))):
        msgspec.convert(row | odd, Insert)
