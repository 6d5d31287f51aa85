"""The way of a setpoint, part by part; what comes of it in a closed loop is in tests/closed_loop/test_sources.py."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from tormagd.control.move.reference import Reference
from tormagd.control.records import Handle, Measured, Plan
from tormagd.daemon.way import MOST_BEHIND_MM, Way
from tormagd.model.displacement import Turn


def stepped(now_s: float, measured: Measured | None = None, reference: Reference | None = None) -> Any:
    """What is looked at of a stepper."""
    return SimpleNamespace(time_s=now_s, measured=measured, move=SimpleNamespace(reference=reference))


def planned(stamp_s: float, gap_mm: float = 70.0) -> Plan:
    return Plan(1, 0.0, 1.0, 0.0, 1.0, None, 400.0, gap_mm, 0.0, 1.0, (), stamp_s=stamp_s)


def test_each_setpoint_ends_its_way_once_with_the_first_duty_that_follows_it() -> None:
    way = Way()
    way.ticked(stepped(0.5), planned(-math.inf))
    way.refresh()
    assert way.report(400.0).to_duty_us.max == 0.0
    for tick in range(1_000):
        now_s = 1.0 + tick * 1e-3
        # a new one every 10 ms, 20 ms old when it is followed first
        way.ticked(stepped(now_s), planned(1.0 + tick // 10 * 0.01 - 0.02))
    way.refresh()
    found = way.report(400.0)
    assert found.to_duty_us.max == pytest.approx(20_000.0, abs=1.0)
    assert (found.to_duty_us.p50, found.carriages_ms, found.total_ms) == (pytest.approx(20_000.0, rel=0.04), None, None)
    # one that has gone stale ends no way
    way.ticked(stepped(9.0), planned(-math.inf))
    way.refresh()
    assert way.report(None).to_duty_us.max == pytest.approx(20_000.0, abs=1.0)


def swings(way: Way, lag_s: float, jump_mm: float = 0.0) -> None:
    """A gap that swings, and is so late."""
    handle = Handle(0.0, 0.0, Turn(1.0, 0.0, 0.0))
    for tick in range(4_000):
        now_s = 1.0 + tick * 1e-3
        phase = math.tau * 0.5 * now_s
        speed_mm_s = 10.0 * math.cos(phase)
        gap_mm = 70.0 + 10.0 / (math.tau * 0.5) * math.sin(phase)
        late = Measured(1, True, 0.0, gap_mm / 2.0, gap_mm / 2.0, 0.0, 0.0, 1.0, handle, 0.0, 0.0, 0.0)
        plan = planned(now_s - 0.01, gap_mm + lag_s * speed_mm_s + jump_mm)
        way.ticked(stepped(now_s, late, Reference(gap_mm, speed_mm_s)), plan)


@pytest.mark.parametrize("lag_s", [0.0, 0.013, 0.05])
def test_the_carriages_delay_is_how_far_they_are_behind_over_how_fast(lag_s: float) -> None:
    way = Way()
    swings(way, lag_s)
    way.refresh()
    found = way.report(400.0)
    assert found.carriages_ms == pytest.approx(1e3 * lag_s, abs=0.01)
    assert found.total_ms == pytest.approx(10.0 + 0.4 + 1e3 * lag_s, abs=0.2)


def test_a_gap_that_is_on_its_way_after_a_jump_is_not_late() -> None:
    way = Way()
    swings(way, 0.0, 2.0 * MOST_BEHIND_MM)
    assert way.report(400.0).carriages_ms is None


def test_an_unarmed_device_ends_no_way_in_the_carriages() -> None:
    way = Way()
    for tick in range(100):
        way.ticked(stepped(tick * 1e-3), planned(tick * 1e-3))
    assert way.report(400.0).carriages_ms is None
