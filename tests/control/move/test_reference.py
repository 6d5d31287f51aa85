"""The gap reference: within its limits whatever the target does, on a step without overshoot, on a ramp without lag."""

import math
from collections.abc import Iterable, Iterator

import pytest
from hypothesis import example, given, settings, strategies as st

from tormagd.config import Config, Position
from tormagd.control.move.actuator import Reference
from tormagd.control.move.carriages import Expected, follow
from tormagd.control.move.motor import full_speed_mm_s
from tormagd.control.records import GapSpeeds

DT_S = 1e-3
LIMITS = Config().position
MAX_MM_S2 = LIMITS.gap_acceleration_mm_s2
NO_LOAD_MM_S = 2.0 * full_speed_mm_s(Config().motor)
FASTEST_MM_S = LIMITS.gap_speed_mm_s
SPEEDS = GapSpeeds(FASTEST_MM_S, FASTEST_MM_S, FASTEST_MM_S, NO_LOAD_MM_S)
HALF_COUNT_MM = 0.5 * 8.0 / 4480.0


def followed(
    start_mm: float,
    targets: Iterable[Reference],
    dt_s: float = DT_S,
    speeds: GapSpeeds = SPEEDS,
    floor_mm: float = -math.inf,
) -> Iterator[Reference]:
    reference = Reference(start_mm)
    for target in targets:
        reference, _, _ = follow(MAX_MM_S2, reference, target, dt_s, speeds, floor_mm)
        yield reference


gaps = st.floats(45.0, 95.0)
limits = st.builds(Position, gap_acceleration_mm_s2=st.floats(100.0, 5_000.0))
slow = st.floats(5.0, 60.0)
fastest = st.builds(GapSpeeds, slow, slow, slow, st.floats(40.0, 60.0))
periods = st.floats(1e-5, 0.1)


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(
    position=limits,
    speeds=fastest,
    start=gaps,
    targets=st.lists(st.tuples(gaps, st.floats(-200.0, 200.0), st.floats(-1e4, 1e4), periods), min_size=1, max_size=60),
)
def test_speed_and_acceleration_limits_hold_for_any_target(
    position: Position, speeds: GapSpeeds, start: float, targets: list[tuple[float, float, float, float]]
) -> None:
    reference = Reference(start)
    for target, speed, turning, dt_s in targets:
        last = reference
        reference, _, _ = follow(position.gap_acceleration_mm_s2, last, Reference(target, speed, turning), dt_s, speeds)
        assert math.isfinite(reference.gap_mm + reference.speed_mm_s + reference.acceleration_mm_s2)
        rounding = 1.0 + 1e-12
        assert -speeds.sure_mm_s * rounding <= reference.speed_mm_s <= speeds.opening_mm_s * rounding
        change = reference.speed_mm_s - last.speed_mm_s
        most = position.gap_acceleration_mm_s2 * dt_s
        # away from its target a motor's own speed brakes, too
        is_away = last.speed_mm_s * (target - last.gap_mm) < 0.0
        braking = most * (1.0 + min(abs(last.speed_mm_s) / speeds.no_load_mm_s, 1.0) * is_away)
        assert abs(change) <= braking * (1.0 + 1e-9) + 1e-12
        is_speeding_up = abs(reference.speed_mm_s) > abs(last.speed_mm_s) and reference.speed_mm_s * last.speed_mm_s > 0
        if is_speeding_up:
            torque = max(0.0, 1.0 - abs(last.speed_mm_s) / speeds.no_load_mm_s)
            assert abs(change) <= most * torque * (1.0 + 1e-9) + 1e-12
        assert (reference.gap_mm, reference.acceleration_mm_s2) == (
            pytest.approx(last.gap_mm + reference.speed_mm_s * dt_s),
            pytest.approx(change / dt_s, rel=1e-6, abs=1e-6),
        )


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(position=limits, speeds=fastest, start=gaps, target=gaps)
@example(position=LIMITS, speeds=SPEEDS, start=70.0, target=69.0)
@example(position=LIMITS, speeds=SPEEDS, start=95.0, target=45.0)
def test_a_step_is_reached_without_overshoot(
    position: Position, speeds: GapSpeeds, start: float, target: float
) -> None:
    reference = Reference(start)
    distance = abs(target - start)
    for _ in range(round(1_000 * (distance / min(speeds.no_load_mm_s, speeds.opening_mm_s, speeds.sure_mm_s) + 1.0))):
        reference, _, _ = follow(position.gap_acceleration_mm_s2, reference, Reference(target), DT_S, speeds)
        assert (reference.gap_mm - target) * math.copysign(1.0, target - start) <= HALF_COUNT_MM
    assert reference.gap_mm == pytest.approx(target, abs=1e-3)
    assert abs(reference.speed_mm_s) < 0.1


@given(start=st.floats(60.0, 80.0), speed=st.floats(-0.8, 0.8).map(lambda share: share * LIMITS.gap_speed_mm_s))
def test_a_ramp_slower_than_the_limit_is_followed_without_lag(start: float, speed: float) -> None:
    reference, target, is_limited = Reference(start), start, True
    for _ in range(800):
        target += speed * DT_S
        reference, is_limited, _ = follow(MAX_MM_S2, reference, Reference(target, speed), DT_S, SPEEDS)
    assert abs(reference.gap_mm - target) <= abs(speed) * DT_S + 1e-6
    assert (reference.speed_mm_s, is_limited) == (pytest.approx(speed, abs=1e-3), False)


@given(start=gaps, target=gaps, dt_s=periods)
@example(start=95.0, target=45.0, dt_s=1e-5)
@example(start=95.0, target=45.0, dt_s=0.1)
def test_any_period_stays_finite_and_arrives(start: float, target: float, dt_s: float) -> None:
    # one period of full braking covers a dt^2 / 2: a slow loop cannot stop more exactly than a part of that
    grain = HALF_COUNT_MM + 0.2 * LIMITS.gap_acceleration_mm_s2 * dt_s**2
    for reference in followed(start, [Reference(target)] * 400, dt_s):
        assert math.isfinite(reference.gap_mm + reference.speed_mm_s + reference.acceleration_mm_s2)
        assert min(start, target) - grain <= reference.gap_mm <= max(start, target) + grain
    if dt_s * 400 > 4.0:
        assert reference.gap_mm == pytest.approx(target, abs=0.01)


def test_a_target_that_turns_is_met_where_it_turns() -> None:
    rate, excess_mm = 2.0 * math.pi * 3.0, []
    for is_known in (True, False):
        phases = [rate * tick * DT_S for tick in range(1_000)]
        targets = [
            Reference(71.0 - math.cos(phase), rate * math.sin(phase), rate**2 * math.cos(phase) * is_known)
            for phase in phases
        ]
        ways = zip(followed(70.0, targets), targets, strict=True)
        excess_mm.append(max(abs(reference.gap_mm - target.gap_mm) for reference, target in ways))
    assert excess_mm[0] <= excess_mm[1]
    assert excess_mm[0] < 0.1


@given(
    references=st.lists(st.tuples(gaps, st.floats(-40.0, 40.0), periods), min_size=1, max_size=40),
    lag_s=st.floats(0.0, 0.02),
    filter_s=st.floats(1e-4, 0.1),
)
def test_what_is_expected_never_leaves_what_was_asked(
    references: list[tuple[float, float, float]], lag_s: float, filter_s: float
) -> None:
    expected = Expected()
    expected.begin(references[0][0])
    for gap_mm, speed_mm_s, dt_s in references:
        expected.update(Reference(gap_mm, speed_mm_s), dt_s, lag_s, filter_s)
    reached = [gap for gap, _, _ in references]
    fastest = max(abs(speed) for _, speed, _ in references)
    assert min(reached) - 1e-9 <= expected.gap_mm <= max(reached) + 1e-9
    assert max(abs(expected.speed_mm_s), abs(expected.filtered_mm_s)) <= fastest + 1e-9


def test_what_is_expected_of_a_ramp_is_late_by_the_lag() -> None:
    expected, lag_s = Expected(), 0.004
    expected.begin(60.0)
    for tick in range(200):
        expected.update(Reference(60.0 + 20.0 * tick * DT_S, 20.0), DT_S, lag_s, 0.003)
    assert (60.0 + 20.0 * 199 * DT_S - expected.gap_mm, expected.filtered_mm_s) == pytest.approx(
        (20.0 * lag_s, 20.0), rel=1e-6
    )


@settings(max_examples=150, deadline=None)
@given(
    start=st.floats(70.0, 95.0),
    path=st.lists(st.tuples(gaps, st.floats(-60.0, 60.0), st.floats(-1e3, 1e3)), min_size=1, max_size=300),
)
@example(start=75.0, path=[(75.0 - 0.038 * tick, -38.0, 0.0) for tick in range(400)])
def test_no_target_leads_it_beyond_its_floor(start: float, path: list[tuple[float, float, float]]) -> None:
    for reference in followed(start, [Reference(*target) for target in path], floor_mm=70.0):
        assert reference.gap_mm >= 70.0 - MAX_MM_S2 * DT_S**2 / 8.0  # 0.2 um: it brakes in whole periods
