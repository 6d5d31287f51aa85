"""The way of a setpoint, part by part; what comes of it in a closed loop is in tests/closed_loop/test_sources.py."""

import math

import pytest

from tormagd.control.records import Plan
from tormagd.daemon.way import Way


def planned(stamp_s: float) -> Plan:
    return Plan(1, 0.0, 1.0, 0.0, 1.0, None, 400.0, 70.0, 0.0, 1.0, (), stamp_s=stamp_s)


def test_each_setpoint_ends_its_way_once_with_the_first_duty_that_follows_it() -> None:
    way = Way()
    way.ticked(0.5, planned(-math.inf))
    way.refresh()
    found = way.report(400.0, 0.013)
    assert (found.to_duty_us.max, found.total_ms) == (0.0, None)
    for tick in range(1_000):
        # a new one every 10 ms, 20 ms old when it is followed first
        way.ticked(1.0 + tick * 1e-3, planned(1.0 + tick // 10 * 0.01 - 0.02))
    way.refresh()
    found = way.report(400.0, 0.013)
    assert found.to_duty_us.max == pytest.approx(20_000.0, abs=1.0)
    assert found.to_duty_us.p50 == pytest.approx(20_000.0, rel=0.04)
    # one that has gone stale ends no way
    way.ticked(9.0, planned(-math.inf))
    way.refresh()
    assert way.report(None, 0.013).to_duty_us.max == pytest.approx(20_000.0, abs=1.0)


def test_the_whole_way_is_the_sum_of_what_is_known_of_its_parts() -> None:
    way = Way()
    for tick in range(1, 100):
        way.ticked(tick * 1e-2, planned(tick * 1e-2 - 0.02))
    way.refresh()
    found = way.report(400.0, 0.013)
    assert (found.device_us, found.carriages_ms) == (400.0, 13.0)
    assert found.total_ms == pytest.approx(20.0 + 0.4 + 13.0, abs=0.7)
    assert way.report(None, 0.013).total_ms is None
