"""The estimate: gap and speeds from the encoders, the handle's motion since it turned."""

import math

import pytest
from hypothesis import given, settings, strategies as st

from firmware_protocol.codec import Switches
from tormagd.control.records import Measured
from tormagd.control.measure import first_estimate, update
from tormagd.model.displacement import MOBILISED_MM, TURN_MM

HOME_MM = 47.5
FILTER_S = 0.003
COUNT_MM = 8.0 / 4480.0
HANDLE_COUNT_MM = 2.0 * math.pi * 20.0 / 16384.0


@pytest.fixture(scope="session")
def follow_handle(measure):
    """The estimate after the handle has been at each of these places, a millisecond apart."""

    def follow(positions: list[float], force_N: float = 0.6) -> Measured:
        estimate: Measured | None = None
        for number, position in enumerate(positions):
            estimate = update(estimate, measure(number, handle_mm=position, force_N=force_N), HOME_MM, FILTER_S)
        assert estimate is not None
        return estimate

    return follow


def test_the_first_estimate_is_at_rest(measure) -> None:
    estimate = update(None, measure(3, left_mm=-10.0, right_mm=-10.5), HOME_MM, FILTER_S)
    assert (estimate.left_mm, estimate.right_mm) == (37.5, 37.0)
    assert estimate.gap_mm == 74.5
    assert estimate.skew_mm == 0.5
    assert (estimate.left_mm_s, estimate.right_mm_s, estimate.handle.rate_mm_s) == (0.0, 0.0, 0.0)
    assert estimate.handle.displacement_mm == 0.0


def test_the_same_measurement_again_changes_nothing(measure) -> None:
    first = update(None, measure(0), HOME_MM, FILTER_S)
    second = update(first, measure(1, left_mm=-7.4), HOME_MM, FILTER_S)
    assert update(second, measure(1, left_mm=-7.4, received_s=9.0), HOME_MM, FILTER_S) is second


@pytest.mark.parametrize("device_time_s", [0.005, 0.004, -1.0])
def test_a_device_clock_that_does_not_advance_gives_no_speed(measure, device_time_s: float) -> None:
    last = update(None, measure(5), HOME_MM, FILTER_S)
    assert update(last, measure(6, device_time_s=device_time_s, left_mm=-6.0), HOME_MM, FILTER_S) is last


@settings(max_examples=40, deadline=None)
@given(speed=st.floats(-40.0, 40.0), dt_s=st.floats(2e-4, 5e-3))
def test_speeds_are_those_of_a_steady_motion(measure, speed: float, dt_s: float) -> None:
    estimate = None
    for number in range(200):
        at_s = number * dt_s
        moved = measure(number, device_time_s=at_s, left_mm=-20.0 + speed * at_s, right_mm=-20.0 - speed * at_s)
        estimate = update(estimate, moved, HOME_MM, FILTER_S)
    assert estimate is not None
    assert estimate.left_mm_s == pytest.approx(speed, rel=1e-3, abs=1e-6)
    assert estimate.right_mm_s == pytest.approx(-speed, rel=1e-3, abs=1e-6)


def test_late_delivery_is_not_slow_motion(measure) -> None:
    """Speeds are over the device's clock: when a measurement was received does not matter."""
    estimates = []
    for delay_s in (0.0, 0.05):
        estimate = None
        for number in range(20):
            late = measure(number, left_mm=-20.0 + 0.01 * number, received_s=number * 1e-3 + delay_s * (number % 2))
            estimate = update(estimate, late, HOME_MM, FILTER_S)
        estimates.append(estimate)
    assert estimates[0] == estimates[1].replaced(sensed_s=estimates[0].sensed_s)


@pytest.mark.parametrize("missing", [1, 10, 100])
def test_a_handle_that_nobody_hears_of_has_not_stopped(measure, missing: int) -> None:
    """States come without a Sense for a while; the handle goes on at 42 mm/s meanwhile."""
    estimate = None
    for number in range(300):
        estimate = update(estimate, measure(number), HOME_MM, FILTER_S)
    before = estimate.handle
    assert before.rate_mm_s == pytest.approx(42.0, rel=0.01)
    old = measure(299)
    for number in range(300, 300 + missing):
        unsensed = measure(number, handle_mm=old.handle_mm, force_N=old.force_N, sensed_s=old.sensed_s)
        estimate = update(estimate, unsensed, HOME_MM, FILTER_S)
        assert (estimate.handle, estimate.sensed_s) == (before, old.sensed_s)
    estimate = update(estimate, measure(300 + missing), HOME_MM, FILTER_S)
    assert estimate.handle.rate_mm_s == pytest.approx(42.0, rel=0.01)
    assert estimate.handle.sliding_mm_s == pytest.approx(42.0, rel=0.01)


def test_one_encoder_count_is_filtered(measure) -> None:
    """A count in a millisecond is 1.8 mm/s of noise; the filter takes three quarters of it."""
    last = update(None, measure(0), HOME_MM, FILTER_S)
    after = update(last, measure(1, left_mm=-7.5 + COUNT_MM), HOME_MM, FILTER_S)
    assert after.left_mm_s == pytest.approx(COUNT_MM / 1e-3 / 4.0)
    assert after.right_mm_s == 0.0


def test_displacement_counts_from_the_reversal(follow_handle) -> None:
    forth = [0.1 * k for k in range(51)]
    estimate = follow_handle([*forth, 4.9, 4.5, 4.0])
    assert estimate.handle.turn.direction == -1.0
    assert estimate.handle.turn.turned_mm == pytest.approx(5.0)  # where it turned, not where that was noticed
    assert estimate.handle.displacement_mm == pytest.approx(1.0)


def test_displacement_saturates_where_friction_is_mobilised(follow_handle) -> None:
    forth = [0.1 * k for k in range(51)]
    assert follow_handle(forth).handle.displacement_mm == MOBILISED_MM
    back = [5.0 - 0.1 * k for k in range(1, 100)]
    assert follow_handle(forth + back).handle.displacement_mm == MOBILISED_MM


@settings(max_examples=60, deadline=None)
@given(wobble=st.lists(st.floats(-TURN_MM, 0.0), min_size=1, max_size=30))
def test_a_wobble_below_the_threshold_is_no_reversal(follow_handle, wobble: list[float]) -> None:
    estimate = follow_handle([0.0, 1.0, 3.0, *(3.0 + offset for offset in wobble)])
    assert estimate.handle.turn.direction == 1.0
    assert estimate.handle.turn.furthest_mm == 3.0


def test_encoder_noise_at_rest_is_no_reversal(follow_handle) -> None:
    estimate = follow_handle([3.0 + HANDLE_COUNT_MM * (k % 2) for k in range(500)])
    assert estimate.handle.turn.direction == 1.0
    assert abs(estimate.handle.rate_mm_s) < 1.0


def test_slow_creep_back_is_a_reversal_in_the_end(follow_handle) -> None:
    """A reversal is counted from the furthest point: many small steps back are one."""
    steps = [3.0 - HANDLE_COUNT_MM * k for k in range(20)]
    assert follow_handle([0.0, 3.0, *steps]).handle.turn.direction == -1.0


@settings(max_examples=60, deadline=None)
@given(positions=st.lists(st.floats(-50.0, 50.0), min_size=2, max_size=60))
def test_displacement_never_leaves_its_range(follow_handle, positions: list[float]) -> None:
    handle = follow_handle(positions).handle
    assert 0.0 <= handle.displacement_mm <= MOBILISED_MM
    assert handle.turn.direction in (-1.0, 1.0)
    assert math.isfinite(handle.rate_mm_s)


def test_force_and_rate_are_positive_along_the_motion(follow_handle) -> None:
    forth = [0.05 * k for k in range(200)]
    assert follow_handle(forth, force_N=0.6).force_N == 0.6
    assert follow_handle(forth).handle.rate_mm_s == pytest.approx(50.0, rel=0.05)
    back = follow_handle([-position for position in forth], force_N=-0.6)
    assert back.force_N == 0.6  # the sensor's sign is the motion's; the estimate's is resistance
    assert back.handle.rate_mm_s == pytest.approx(50.0, rel=0.05)


def test_whether_it_is_homed_is_the_devices_word(measure) -> None:
    assert first_estimate(measure(0), HOME_MM).is_homed
    assert not first_estimate(measure(0, switches=Switches(0)), HOME_MM).is_homed
