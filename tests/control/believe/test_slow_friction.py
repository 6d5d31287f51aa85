"""Friction at a creep: learned as far as static friction differs and the fit is uncertain, and nothing at speed."""

import pytest
from hypothesis import given, strategies as st

from tormagd.config import Config
from tormagd.control.believe.slow_friction import (
    MAX_STATIC,
    MIN_STATIC,
    STRIBECK_MM_S,
    SlowFriction,
    factor_bounds,
)
from tormagd.control.believe.strength import MAX_RELAXED, UNSEEN, DeviceFit
from tormagd.ground.plain_values import plain

PERIOD_S = 0.003
BOUNDS = Config().trim
MIN_FACTOR, MAX_FACTOR = factor_bounds(BOUNDS)
MIN_SHARE = BOUNDS.least * (1.0 - MAX_RELAXED)


def crept(share: float, seconds: float, rate_mm_s: float = 1.0, fit: DeviceFit = UNSEEN) -> SlowFriction:
    slow = SlowFriction(BOUNDS)
    for _ in range(round(seconds / PERIOD_S)):
        slow.update(fit, 1.5, rate_mm_s, 1.5 * share, PERIOD_S)
    return slow


def rescaled(slow: SlowFriction, before_N: float, after_N: float, rate_mm_s: float = 42.0) -> SlowFriction:
    """Return what is known of slow friction once the fit has learned at that rate."""
    after = SlowFriction(BOUNDS)
    after.factor, after.learned, after.slowness = slow.factor, slow.learned, slow.slowness
    after.rescale(before_N, after_N, rate_mm_s)
    return after


def test_what_a_creep_shows_is_learned_and_not_believed_at_speed() -> None:
    slow = crept(1.2, 3.0)
    assert slow.factor_at(1.0) == pytest.approx(1.2, abs=0.01)
    assert slow.factor_at(0.0) > 1.2
    assert slow.factor_at(3.0 * STRIBECK_MM_S) == pytest.approx(1.0, abs=1e-3)


def test_it_is_learned_within_the_time_that_a_person_takes_to_notice() -> None:
    assert crept(1.2, 0.5).factor_at(1.0) > 1.12


def test_of_a_device_that_was_never_seen_a_creep_shows_nearly_all() -> None:
    shares = [0.75, 1.35, 0.59]
    assert [crept(share, 10.0).factor_at(1.0) for share in shares] == pytest.approx(shares, abs=0.01)
    assert crept(0.5, 10.0).factor == MIN_FACTOR
    assert crept(5.0, 10.0).factor <= MAX_FACTOR


@pytest.mark.parametrize("share", [0.0, 0.9 * MIN_SHARE])
def test_a_sensor_that_reads_less_than_any_device_makes_teaches_nothing(share: float) -> None:
    assert plain(crept(share, 10.0)) == plain(crept(1.0, 0.0))
    assert crept(MIN_SHARE, 10.0).factor == MIN_FACTOR


def test_what_is_believed_of_a_creep_grows_by_three_deviations_of_the_fit() -> None:
    known, unsure = (DeviceFit(scale_variance=sd * sd, offset_variance_N2=0.0) for sd in (0.0, 0.02))
    shown = [crept(share, 20.0, fit=fit).factor for fit in (known, unsure) for share in (0.6, 5.0)]
    assert shown == pytest.approx([MIN_STATIC, MAX_STATIC, MIN_STATIC - 0.06, MAX_STATIC + 0.06])


@pytest.mark.parametrize("rate_mm_s", [0.5, 2.0, 4.0])
def test_beside_a_fit_that_learned_the_force_at_a_creep_stays(rate_mm_s: float) -> None:
    slow = crept(1.05, 9.0, rate_mm_s)
    assert rescaled(slow, 1.0, 1.05).factor_at(rate_mm_s) * 1.05 == pytest.approx(slow.factor_at(rate_mm_s), rel=1e-3)
    # a fit that learned there shows what the force at a creep is
    assert rescaled(slow, 1.0, 1.05, rate_mm_s).factor == pytest.approx(slow.factor)


def test_a_fit_that_errs_by_rate_and_comes_back_leaves_slow_friction_as_it_was() -> None:
    slow = crept(1.05, 9.0, 4.0)
    gone = rescaled(slow, 1.0, 1.5)
    assert (gone.factor_at(0.0), rescaled(gone, 1.5, 1.0).factor) == (MIN_FACTOR, pytest.approx(slow.factor))


def test_what_a_creep_has_not_shown_is_what_the_fit_says() -> None:
    slow = crept(1.1, 3.0)
    assert rescaled(slow, 1.0, 1.0).factor == pytest.approx(slow.factor)
    assert rescaled(slow, 1.0, -0.1).factor == slow.factor
    assert rescaled(crept(1.0, 9.0), 1.0, 0.4).factor_at(0.0) == MAX_FACTOR
    assert rescaled(SlowFriction(BOUNDS), 1.0, 0.8).factor == 1.0


@given(
    start=st.floats(MIN_FACTOR, MAX_FACTOR),
    events=st.lists(
        st.tuples(st.floats(0.1, 5.0), st.floats(0.0, 5.0), st.floats(-33.0, 33.0), st.floats(0.0, 0.02)),
        max_size=40,
    ),
)
def test_nothing_leaves_its_bounds(start: float, events: list[tuple[float, float, float, float]]) -> None:
    slow, fit = SlowFriction(BOUNDS), DeviceFit(0.9, 0.05)
    slow.factor = start
    for expected_N, rate_mm_s, reading_N, dt_s in events:
        slow.update(fit, expected_N, rate_mm_s, reading_N, dt_s)
        slow.rescale(expected_N, abs(reading_N), rate_mm_s)
        assert MIN_FACTOR <= slow.factor_at(rate_mm_s) <= MAX_FACTOR
