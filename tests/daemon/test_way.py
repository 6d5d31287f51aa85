"""The way of a setpoint, part by part; what comes of it in a closed loop is in tests/closed_loop/test_sources.py."""

import math

import pytest
from tormagd.control.plan import PlanState
from tormagd.control.step import StepState

from tormagd.assembly.build import build_core
from tormagd.config import Config
from tormagd.control.move.reference import Reference
from tormagd.control.records import Handle, Measured
from tormagd.daemon.way import MOST_BEHIND_MM, Way
from tormagd.model.displacement import Turn


@pytest.fixture(scope="module")
def resting() -> PlanState:
    return build_core(Config()).planner.start(0.0)


@pytest.fixture
def estimate() -> Measured:
    return Measured(1, True, 0.0, 35.0, 35.0, 0.0, 0.0, 1.0, Handle(0.0, 0.0, Turn(1.0, 0.0, 0.0)), 0.0, 0.0, 0.0)


def planned(resting: PlanState, stamp_s: float, gap_mm: float = 70.0) -> PlanState:
    return resting.replaced(
        governor=resting.governor.replaced(stamp_s=stamp_s), plan=resting.plan.replaced(gap_mm=gap_mm)
    )


def test_each_setpoint_ends_its_way_once_with_the_first_duty_that_follows_it(resting: PlanState) -> None:
    way = Way()
    way.ticked(StepState(0.5), planned(resting, -math.inf))
    way.refresh()
    assert way.report(400.0).to_duty_us.max == 0.0
    for tick in range(1_000):
        now_s = 1.0 + tick * 1e-3
        # a new one every 10 ms, 20 ms old when it is followed first
        way.ticked(StepState(now_s), planned(resting, 1.0 + tick // 10 * 0.01 - 0.02))
    way.refresh()
    found = way.report(400.0)
    assert found.to_duty_us.max == pytest.approx(20_000.0, abs=1.0)
    assert (found.to_duty_us.p50, found.carriages_ms, found.total_ms) == (pytest.approx(20_000.0, rel=0.04), None, None)
    # one that has gone stale ends no way
    way.ticked(StepState(9.0), planned(resting, -math.inf))
    way.refresh()
    assert way.report(None).to_duty_us.max == pytest.approx(20_000.0, abs=1.0)


def swings(way: Way, resting: PlanState, estimate: Measured, lag_s: float, jump_mm: float = 0.0) -> None:
    """A gap that swings, and is so late."""
    for tick in range(4_000):
        now_s = 1.0 + tick * 1e-3
        phase = math.tau * 0.5 * now_s
        speed_mm_s = 10.0 * math.cos(phase)
        gap_mm = 70.0 + 10.0 / (math.tau * 0.5) * math.sin(phase)
        late = estimate.replaced(left_mm=gap_mm / 2.0, right_mm=gap_mm / 2.0)
        state = StepState(now_s, estimate=late, reference=Reference(gap_mm, speed_mm_s))
        way.ticked(state, planned(resting, now_s - 0.01, gap_mm + lag_s * speed_mm_s + jump_mm))


@pytest.mark.parametrize("lag_s", [0.0, 0.013, 0.05])
def test_the_carriages_delay_is_how_far_they_are_behind_over_how_fast(
    resting: PlanState, estimate: Measured, lag_s: float
) -> None:
    way = Way()
    swings(way, resting, estimate, lag_s)
    way.refresh()
    found = way.report(400.0)
    assert found.carriages_ms == pytest.approx(1e3 * lag_s, abs=0.01)
    assert found.total_ms == pytest.approx(10.0 + 0.4 + 1e3 * lag_s, abs=0.2)


def test_a_gap_that_is_on_its_way_after_a_jump_is_not_late(resting: PlanState, estimate: Measured) -> None:
    way = Way()
    swings(way, resting, estimate, 0.0, 2.0 * MOST_BEHIND_MM)
    assert way.report(400.0).carriages_ms is None


def test_an_unarmed_device_ends_no_way_in_the_carriages(resting: PlanState) -> None:
    way = Way()
    for tick in range(100):
        way.ticked(StepState(tick * 1e-3), planned(resting, tick * 1e-3))
    assert way.report(400.0).carriages_ms is None
