"""A handle whose encoder is lost: what its force shows, and no resting hand's does."""

import math
from collections.abc import Callable
from operator import attrgetter

import pytest

from tormagd.control.believe.handle import (
    BRISTLES_N_MM,
    FASTEST_MM_S,
    FORGETS_S,
    MODEL_RISES_N,
    RISES_N,
    SETTLES_S,
    SLOWS_S,
    STANDS_MM,
    HandleWatch,
)
from tormagd.control.records import Handle, Measured
from tormagd.element.model.displacement import Turn

PERIOD_S = 0.002
seen = attrgetter("heard_s", "at_mm", "still_s", "force_N", "min_N", "min_model_N", "rested_N", "creep_mm_s", "is_lost")
STIFFEST_N_MM = 12.0
"No believable elastomer is stiffer."


def at(sensed_s: float, handle_mm: float, force_N: float, sliding_mm_s: float = 42.0) -> Measured:
    handle = Handle(0.0, 0.0, Turn(1.0, 0.0, 0.0), sliding_mm_s)
    return Measured(1, True, 0.0, 40.0, 40.0, 0.0, 0.0, force_N, handle, handle_mm, sensed_s, 0.0)


def watched(
    duration_s: float,
    handle_mm: Callable[[float], float],
    force_N: Callable[[float], float],
    model_N: Callable[[float], float],
    watch: HandleWatch | None = None,
) -> HandleWatch:
    watch = watch or HandleWatch()
    from_s = watch.heard_s
    for reading in range(1, round(duration_s / PERIOD_S) + 1):
        now_s = from_s + reading * PERIOD_S
        watch.update(at(now_s, handle_mm(now_s), force_N(now_s)), model_N(now_s))
    return watch


def still(now_s: float) -> float:
    return 3.0


def swinging(now_s: float) -> float:
    return 1.5 + 0.2 * math.sin(math.tau * now_s)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_force_that_swings_with_the_gap_under_a_handle_that_stands_is_a_lost_encoder(sign: float) -> None:
    assert watched(SETTLES_S + 1.5, still, lambda now_s: sign * swinging(now_s), swinging).is_lost


def test_it_is_lost_until_it_moves() -> None:
    lost = watched(2.0, still, swinging, swinging)
    assert watched(10.0, lambda now_s: 3.0 + 0.9 * STANDS_MM, lambda now_s: 1.5, swinging, lost).is_lost
    assert not watched(PERIOD_S, lambda now_s: 3.0 + 1.1 * STANDS_MM, swinging, swinging, lost).is_lost


def test_friction_at_rest_falls_with_the_gap_and_does_not_come_back() -> None:
    watch, held_N = HandleWatch(), 2.0
    for reading in range(1, 5_000):
        held_N = min(held_N, swinging(reading * PERIOD_S))
        watch.update(at(reading * PERIOD_S, 3.0, held_N), swinging(reading * PERIOD_S))
        assert not watch.is_lost


def pressing(now_s: float) -> float:
    """A hand that presses within a count."""
    return 1.0 + STIFFEST_N_MM * STANDS_MM / 2.0 * math.sin(math.tau * now_s)


def still_moving(now_s: float) -> float:
    return 2.0 - math.exp(-now_s / 0.05)


def drifting(now_s: float) -> float:
    return 1.0 + 0.3 * RISES_N / FORGETS_S * now_s


@pytest.mark.parametrize(
    ("duration_s", "speed_mm_s", "force_N", "model_N"),
    [
        *((5.0, speed_mm_s, swinging, swinging) for speed_mm_s in (-42.0, -0.1, 0.1, 0.5, 42.0)),
        (10.0, 0.0, pressing, swinging),
        (3.0, 0.0, still_moving, still_moving),
        (20.0 * FORGETS_S, 0.0, drifting, swinging),
    ],
)
def test_a_handle_that_moves_or_is_pressed_or_a_zero_that_drifts_is_no_lost_encoder(
    duration_s: float, speed_mm_s: float, force_N: Callable[[float], float], model_N: Callable[[float], float]
) -> None:
    assert not watched(duration_s, lambda now_s: speed_mm_s * now_s, force_N, model_N).is_lost


def test_a_force_that_leaps_while_the_gap_stands_is_the_sensors_own() -> None:
    watch = watched(2.0, still, lambda now_s: 1.5, lambda now_s: 1.5)
    assert not watched(2.0, still, lambda now_s: 2.3, lambda now_s: 1.5 + 0.9 * MODEL_RISES_N, watch).is_lost


def test_a_gap_that_moved_since_the_handle_came_to_stand_moved_at_rest() -> None:
    watch = watched(1.0, still, swinging, still)
    assert not watch.moved_gap_at_rest(3.0 - 0.9 * MODEL_RISES_N)
    assert watch.moved_gap_at_rest(3.0 - 1.1 * MODEL_RISES_N)
    watch.update(at(1.1, 4.0, 1.5), 2.0)
    assert not watch.moved_gap_at_rest(2.0)


def test_a_silence_and_times_that_are_none_are_no_time_of_standing() -> None:
    watch = watched(0.6, still, swinging, swinging)
    assert not watch.is_lost
    heard = seen(watch)
    for none_s in (watch.heard_s, math.nan):
        watch.update(at(none_s, 9.0, 9.0), 9.0)
        assert seen(watch) == heard
    watch.update(at(watch.heard_s + 60.0, 3.0, 9.0), 9.0)
    assert watch.still_s == 0.0
    for _ in range(2):
        watch.update(at(math.inf, 3.0, 1.0), 1.0)
        assert (watch.heard_s, watch.still_s, watch.force_N) == (math.inf, 0.0, 1.0)


def test_friction_follows_a_rise_over_travel_and_a_fall_at_once() -> None:
    watch, reach_mm = HandleWatch(), 2.0 / BRISTLES_N_MM
    assert watch.update(at(0.0, 0.0, 1.0), 2.0) == 0.0
    for step in range(1, 101):
        watch.update(at(0.0, 0.01 * reach_mm * step, 1.0), 2.0)
    assert watch.followed_N == pytest.approx(2.0 * (1.0 - math.exp(-1.0)), rel=1e-9)
    assert watch.update(at(0.0, reach_mm, 1.0), 0.3) == pytest.approx(0.3)
    assert watch.update(at(0.0, 0.0, 1.0), 1.0) > 0.3


def test_a_handle_that_sticks_for_a_moment_does_not_creep() -> None:
    watch = HandleWatch()
    for after, rate_mm_s, shown_mm_s in ((0.0, 20.0, 20.0), (0.3, 1.0, 7.9), (20.0, 1.0, 1.3), (20.01, 20.0, 20.0)):
        watch.update(at(1.0 + after * SLOWS_S, 3.0, 1.0, rate_mm_s), 1.0)
        assert watch.creep_mm_s == pytest.approx(shown_mm_s, abs=0.2)
    assert shown_mm_s > FASTEST_MM_S
