"""How late carriages are: learned from where they are found, whatever else is wrong."""

import math

import pytest

from tormagd.control.believe.carriage_lag import AGE_S, FORGETTING_S, MAX_LAG_S, SETTLED_MM, CarriageLag

TOP_SPEED_MM_S, PERIOD_S = 38.0, 0.01


def swing_mm(time_s: float) -> float:
    return 70.0 + 2.0 * math.sin(2.0 * math.pi * time_s)


def swung(late_s: float, seconds: float, *, off_mm: float = 0.0) -> CarriageLag:
    carriages = CarriageLag()
    for tick in range(round(seconds / PERIOD_S)):
        now_s = tick * PERIOD_S
        measured_s = now_s - AGE_S - late_s
        gap_mm = swing_mm(measured_s) + off_mm
        speed_mm_s = (swing_mm(measured_s + 1e-4) - swing_mm(measured_s - 1e-4)) / 2e-4
        carriages.update(PERIOD_S, swing_mm(now_s), gap_mm, speed_mm_s, TOP_SPEED_MM_S)
    return carriages


@pytest.mark.parametrize("late_s", [0.0, 0.007, 0.02, 0.045])
def test_it_comes_to_the_lag_and_stays_there(late_s: float) -> None:
    nearest_s = math.tan(2.0 * math.pi * late_s) / (2.0 * math.pi)
    assert [swung(late_s, seconds).lag_s for seconds in (10.0, 40.0)] == pytest.approx([nearest_s] * 2, abs=1.5e-3)


def test_a_beat_teaches_most_of_it() -> None:
    assert swung(0.02, 1.0).lag_s > 0.01


def test_of_a_swing_as_much_is_known_as_of_the_last_seconds() -> None:
    mean_mm2_s2 = 0.5 * (2.0 * 2.0 * math.pi) ** 2
    assert swung(0.02, 40.0).information_mm2_s == pytest.approx(FORGETTING_S * mean_mm2_s2, rel=0.1)


def test_a_gap_that_is_off_is_not_late() -> None:
    assert swung(0.01, 10.0, off_mm=0.2).lag_s == pytest.approx(swung(0.01, 10.0).lag_s, abs=2e-3)


@pytest.mark.parametrize(("late_s", "learned_s"), [(-0.01, 0.0), (0.058, 0.058), (0.2, MAX_LAG_S)])
def test_it_has_bounds(late_s: float, learned_s: float) -> None:
    assert swung(late_s, 20.0).lag_s == pytest.approx(learned_s, abs=2e-3)


def test_a_jump_teaches_nothing_until_it_is_caught_up_with_and_standing_beside_the_plan_nothing() -> None:
    carriages, gap_mm, stands_mm = CarriageLag(), 80.0, 60.0 + 0.5 * SETTLED_MM
    carriages.lag_s = 0.01
    for _ in range(100):
        carriages.update(PERIOD_S, 60.0, gap_mm, -TOP_SPEED_MM_S if gap_mm > stands_mm else 0.0, TOP_SPEED_MM_S)
        if gap_mm > 60.0 + SETTLED_MM + 0.06:
            assert carriages.is_settling
        assert carriages.lag_s == pytest.approx(0.01, abs=1e-3)
        gap_mm = max(gap_mm - TOP_SPEED_MM_S * PERIOD_S, stands_mm)
    assert not carriages.is_settling


def test_what_comes_as_a_surprise_teaches_nothing_and_forgets_nothing() -> None:
    carriages = swung(0.02, 3.0)
    known = carriages.lag_s, carriages.information_mm2_s
    for _ in range(2):
        carriages.update(PERIOD_S, None, 60.0, 30.0, TOP_SPEED_MM_S)
        found = carriages.lag_s, carriages.information_mm2_s, carriages.expected_mm, carriages.is_settling
        assert found == (*known, None, False)
    carriages.update(PERIOD_S, 60.0, 60.0, 0.0, TOP_SPEED_MM_S)
    assert carriages.expected_mm == 60.0


@pytest.mark.parametrize("dt_s", [0.0, -1.0, 1e-9, 1e9])
@pytest.mark.parametrize("speed_mm_s", [0.0, 1e6, -1e6])
def test_no_clock_and_no_speed_upsets_it(dt_s: float, speed_mm_s: float) -> None:
    carriages = CarriageLag()
    carriages.lag_s, carriages.expected_mm = 0.01, 70.0
    for _ in range(100):
        carriages.update(dt_s, 70.0, 70.0, speed_mm_s, TOP_SPEED_MM_S)
        assert 0.0 <= carriages.lag_s <= MAX_LAG_S
        assert 0.0 <= carriages.information_mm2_s < math.inf
