"""How late carriages are: learned of where they are found, off no other cause."""

import math

import pytest

from tormagd.control.believe.carriage_lag import AGE_S, CAUGHT_UP_MM, CarriageLag, MAX_LAG_S, ON_TIME, found, surprised

FASTEST_MM_S, PERIOD_S = 38.0, 0.01


def swing_mm(time_s: float) -> float:
    return 70.0 + 2.0 * math.sin(2.0 * math.pi * time_s)


def swung(late_s: float, seconds: float, *, off_mm: float = 0.0, before: CarriageLag = ON_TIME) -> CarriageLag:
    """Of carriages that follow a planned swing as much later, measured off by so much."""
    known = before
    for tick in range(round(seconds / PERIOD_S)):
        now_s = tick * PERIOD_S
        measured_s = now_s - AGE_S - late_s
        gap_mm = swing_mm(measured_s) + off_mm
        speed_mm_s = (swing_mm(measured_s + 1e-4) - swing_mm(measured_s - 1e-4)) / 2e-4
        known = found(known, PERIOD_S, swing_mm(now_s), gap_mm, speed_mm_s, FASTEST_MM_S)
    return known


@pytest.mark.parametrize("late_s", [0.0, 0.007, 0.02, 0.045])
def test_it_comes_to_the_lag_and_stays_there(late_s: float) -> None:
    """However long it goes on. A lag of first order turns a swing's phase by a little less than a delay does."""
    nearest_s = math.tan(2.0 * math.pi * late_s) / (2.0 * math.pi)
    assert swung(late_s, 10.0).lag_s == pytest.approx(nearest_s, abs=1.5e-3)
    assert swung(late_s, 40.0).lag_s == pytest.approx(nearest_s, abs=1.5e-3)


def test_a_beat_teaches_most_of_it() -> None:
    assert swung(0.02, 1.0).lag_s > 0.01


def test_a_gap_that_is_off_is_not_late() -> None:
    assert swung(0.01, 10.0, off_mm=0.2).lag_s == pytest.approx(swung(0.01, 10.0).lag_s, abs=2e-3)


@pytest.mark.parametrize(("late_s", "learned_s"), [(-0.01, 0.0), (0.058, 0.058), (0.2, MAX_LAG_S)])
def test_it_has_bounds(late_s: float, learned_s: float) -> None:
    assert swung(late_s, 20.0).lag_s == pytest.approx(learned_s, abs=2e-3)


def test_a_jump_teaches_nothing_until_it_is_caught_up_with() -> None:
    known, gap_mm = CarriageLag(0.01), 80.0
    for _ in range(100):
        known = found(known, PERIOD_S, 60.0, gap_mm, -FASTEST_MM_S if gap_mm > 60.0 else 0.0, FASTEST_MM_S)
        if gap_mm > 60.0 + CAUGHT_UP_MM + 0.06:
            assert known.is_on_its_way
        assert known.lag_s == pytest.approx(0.01, abs=1e-3)
        gap_mm = max(gap_mm - FASTEST_MM_S * PERIOD_S, 60.0)
    assert not known.is_on_its_way


def test_what_comes_as_a_surprise_teaches_nothing_and_forgets_nothing() -> None:
    known = swung(0.02, 3.0)
    after = surprised(known)
    assert (after.lag_s, after.motion_mm2_s, after.expected_mm) == (known.lag_s, known.motion_mm2_s, None)
    assert surprised(after) is after


@pytest.mark.parametrize("elapsed_s", [0.0, -1.0, 1e-9, 1e9])
@pytest.mark.parametrize("speed_mm_s", [0.0, 1e6, -1e6])
def test_no_clock_and_no_speed_upsets_it(elapsed_s: float, speed_mm_s: float) -> None:
    known = CarriageLag(0.01, expected_mm=70.0)
    for _ in range(100):
        known = found(known, elapsed_s, 70.0, 70.0, speed_mm_s, FASTEST_MM_S)
        assert 0.0 <= known.lag_s <= MAX_LAG_S
        assert math.isfinite(known.motion_mm2_s)
        assert known.motion_mm2_s >= 0.0
