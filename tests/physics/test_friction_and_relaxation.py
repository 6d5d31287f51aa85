"""What friction and an elastomer's memory do to the force: closed forms, passivity, superposition."""

import math

import pytest
from hypothesis import given, strategies as st

from tormagd.element.physics.friction import Friction
from tormagd.element.physics.relaxation import PronySeries

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


REACH_MM = FRICTION.level_N(30.0, 2.0) / 8.0


@pytest.mark.parametrize(
    ("start_mm", "speed_mm_s", "kinetic_N", "dt_s", "end_mm", "rel"),
    [
        pytest.param(0.0, 42.0, 2.0, 1e3, 0.25, 1e-6, id="steady sliding: the kinetic level"),
        pytest.param(0.0, -42.0, 2.0, 1e3, -0.25, 1e-6, id="and the other way"),
        pytest.param(0.0, 1e-2, 2.0, 1e3, 0.25 * 1.15, 1e-4, id="break-away: the static level"),
        pytest.param(0.0, 5.0, 2.0, 1e3, 0.25 * (1.0 + 0.15 / math.e), 1e-6, id="at Stribeck's speed"),
        pytest.param(0.0, 0.1, 2.0, 1e-2, 1e-3, 3e-3, id="the first micrometres: a spring"),
        # from -z_ss, dz/dt = v - sigma0 |v| z / g has z = z_ss (1 - 2 exp(-x / z_ss)) after a travel x
        pytest.param(
            *(-REACH_MM, 30.0, 2.0, 0.01, REACH_MM * (1.0 - 2.0 * math.exp(-0.3 / REACH_MM)), 1e-12), id="a reversal"
        ),
        pytest.param(0.1, 0.0, 2.0, 1e3, 0.1, 1e-15, id="at rest: held"),
        pytest.param(0.25, 0.0, 0.5, 0.0, 0.5 * 1.15 / 8.0, 1e-6, id="a falling level: it slips"),
        pytest.param(0.25, 42.0, 0.0, 1e-3, 0.0, 1e-6, id="no level: viscous alone"),
    ],
)
def test_the_bristles_deflect_as_the_closed_forms_and_force_follows(
    start_mm: float, speed_mm_s: float, kinetic_N: float, dt_s: float, end_mm: float, rel: float
) -> None:
    force_N, deflection_mm = FRICTION.advance(start_mm, speed_mm_s, kinetic_N, dt_s)
    assert deflection_mm == pytest.approx(end_mm, rel=rel)
    assert force_N == pytest.approx(8.0 * deflection_mm + 0.0005 * speed_mm_s, rel=1e-12)


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
    # below 1e-300 a float lacks the digits for a relative bound
    assert abs(friction.presliding_stiffness_N_mm * deflection) <= level_N * (1 + 1e-12) + 1e-300


@given(frictions, st.lists(st.tuples(speeds, levels, st.floats(1e-4, 0.5)), min_size=1, max_size=40))
def test_passive_under_any_motion_and_any_field(friction: Friction, steps: list[tuple[float, float, float]]) -> None:
    deflection_mm, work_mJ = 0.0, 0.0
    for speed_mm_s, kinetic_N, dt_s in steps:
        force_N, deflection_mm = friction.advance(deflection_mm, speed_mm_s, kinetic_N, dt_s)
        work_mJ += force_N * speed_mm_s * dt_s
        stored_mJ = 0.5 * friction.presliding_stiffness_N_mm * deflection_mm**2
        assert work_mJ >= stored_mJ - 1e-9 * (1.0 + work_mJ)


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
    update, state, force = SERIES.discretise(dt_s), SERIES.relaxed(0.0), 0.0
    for index in range(1, 101):
        force, state = update.advance(state, index * dt_s)
    time_s = 100 * dt_s
    branches = sum(
        g * tau * -math.expm1(-time_s / tau) for g, tau in zip(SERIES.fractions, SERIES.times_s, strict=True)
    )
    assert force == pytest.approx(0.87 * time_s + branches, rel=1e-12)


def test_a_rested_element_carries_the_equilibrium_share_and_may_undershoot() -> None:
    update, state = SERIES.discretise(1e-3), SERIES.relaxed(5.0)
    assert update.advance(state, 5.0)[0] == pytest.approx(0.87 * 5.0)
    assert update.advance(state, 0.5)[0] == pytest.approx(0.87 * 0.5 - 0.13 * 4.5, rel=1e-3)


def test_a_series_without_branches_is_the_identity() -> None:
    empty = PronySeries((), ())
    assert empty.discretise(1e-4).advance(empty.relaxed(1.0), 3.0) == (3.0, (3.0,))
