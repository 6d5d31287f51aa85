"""Prony element: closed forms, independence of the step, refusals."""

import math

import pytest
from hypothesis import given, strategies as st

from tormagd.physics.errors import DomainError
from tormagd.physics.relaxation import PronySeries

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


@given(st.lists(st.tuples(forces, forces), min_size=1, max_size=20), st.floats(1e-6, 10.0))
def test_superposition(pairs: list[tuple[float, float]], dt_s: float) -> None:
    update = SERIES.discretise(dt_s)
    one, two, both = SERIES.relaxed(0.0), SERIES.relaxed(0.0), SERIES.relaxed(0.0)
    for first, second in pairs:
        force_one, one = update.advance(one, first)
        force_two, two = update.advance(two, second)
        force_both, both = update.advance(both, first + second)
        assert force_both == pytest.approx(force_one + force_two, abs=1e-12)


@given(st.lists(forces, min_size=1, max_size=50), st.floats(1e-6, 10.0))
def test_the_response_stays_bounded_by_the_driving_force(driving: list[float], dt_s: float) -> None:
    update, state = SERIES.discretise(dt_s), SERIES.relaxed(0.0)
    for driving_N in driving:
        force_N, state = update.advance(state, driving_N)
        assert abs(force_N) <= (1.0 + sum(SERIES.fractions)) * max(map(abs, driving)) + 1e-12


def test_a_rested_element_carries_the_equilibrium_share_and_may_undershoot() -> None:
    update, state = SERIES.discretise(1e-3), SERIES.relaxed(5.0)
    assert update.advance(state, 5.0)[0] == pytest.approx(0.87 * 5.0)
    assert update.advance(state, 0.5)[0] == pytest.approx(0.87 * 0.5 - 0.13 * 4.5, rel=1e-3)


def test_a_series_without_branches_is_the_identity() -> None:
    empty = PronySeries((), ())
    assert empty.discretise(1e-4).advance(empty.relaxed(1.0), 3.0) == (3.0, (3.0,))


@pytest.mark.parametrize(
    ("fractions", "times_s"),
    [
        ((0.5, 0.5), (1.0, 2.0)),
        ((-0.1,), (1.0,)),
        ((math.nan,), (1.0,)),
        ((0.1,), (0.0,)),
        ((0.1,), (math.inf,)),
        ((0.1, 0.1), (1.0,)),
    ],
)
def test_series_are_checked(fractions: tuple[float, ...], times_s: tuple[float, ...]) -> None:
    with pytest.raises(DomainError):
        PronySeries(fractions, times_s)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    with pytest.raises(DomainError, match="driving_N"):
        SERIES.discretise(1e-4).advance(SERIES.relaxed(0.0), bad)
    with pytest.raises(DomainError, match="driving_N"):
        SERIES.relaxed(bad)
    with pytest.raises(DomainError, match="dt_s"):
        SERIES.discretise(bad)


def test_a_state_of_another_series_is_refused() -> None:
    with pytest.raises(DomainError, match="state"):
        SERIES.discretise(1e-4).advance((0.0, 0.0), 1.0)
