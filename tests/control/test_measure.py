"""What is measured: gap and speeds from the encoders, the handle's motion since it turned."""

import math

import pytest
from hypothesis import given, strategies as st

from firmware_protocol.codec import Switches
from tormagd.control.measure import Measure
from tormagd.control.records import Measured
from tormagd.element.model.displacement import MOBILISED_MM, TURN_MM
from tormagd.hardware.measurement import Measurement

HANDLE_COUNT_MM = 2.0 * math.pi * 20.0 / 16384.0


class Look:
    def __init__(self) -> None:
        self._stage = Measure(47.5, 0.003, turns=True, full_speed_mm_s=20.0, period_s=1e-3)

    def __call__(self, *measurements: Measurement) -> Measured:
        for measurement in measurements:
            measured = self._stage.update(0.0, 1e-3, measurement, needs_homing=False)
        assert measured is self._stage.measured
        return measured


@pytest.fixture
def look() -> Look:
    return Look()


@pytest.fixture(scope="session")
def follow_handle(measure):
    def follow(positions: list[float], force_N: float = 0.6) -> Measured:
        look = Look()
        for number, mm in enumerate(positions):
            received_s = number * 1e-3 + 0.05 * (number % 2)  # late delivery is not slow motion
            measured = look(measure(number, handle_mm=mm, force_N=force_N, received_s=received_s))
        return measured

    return follow


def test_the_first_is_at_rest(look: Look, measure) -> None:
    measured = look(measure(3, left_mm=-10.0, right_mm=-10.5))
    assert (measured.left_mm, measured.right_mm, measured.gap_mm, measured.skew_mm) == (37.5, 37.0, 74.5, 0.5)
    at_rest = measured.left_mm_s, measured.right_mm_s, measured.handle.rate_mm_s, measured.handle.displacement_mm
    assert at_rest == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("number", "changes"),
    [
        (5, {"received_s": 9.0}),
        (6, {"device_time_s": 0.005}),
        (6, {"device_time_s": 0.004}),
        (6, {"device_time_s": -1.0}),
    ],
)
def test_the_same_measurement_or_device_time_again_changes_nothing(
    look: Look, measure, number: int, changes: dict[str, float]
) -> None:
    last = look(measure(4), measure(5))
    assert look(measure(number, left_mm=-6.0, **changes)) is last


@given(speed=st.floats(-40.0, 40.0), dt_s=st.floats(2e-4, 5e-3))
def test_speeds_are_those_of_a_steady_motion(measure, speed: float, dt_s: float) -> None:
    look = Look()
    for number in range(200):
        way_mm = speed * number * dt_s
        moved = {"left_mm": -20.0 + way_mm, "right_mm": -20.0 - way_mm}
        measured = look(measure(number, device_time_s=number * dt_s, **moved))
    assert (measured.left_mm_s, measured.right_mm_s) == pytest.approx((speed, -speed), rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("missing", [1, 10, 100])
def test_a_handle_that_nobody_hears_of_has_not_stopped(look: Look, measure, missing: int) -> None:
    before = look(*[measure(number) for number in range(300)]).handle
    assert before.rate_mm_s == pytest.approx(42.0, rel=0.01)
    old = measure(299)
    for number in range(300, 300 + missing):
        measured = look(measure(number, handle_mm=old.handle_mm, force_N=old.force_N, sensed_s=old.sensed_s))
        assert (measured.handle, measured.sensed_s) == (before, old.sensed_s)
    handle = look(measure(300 + missing)).handle
    assert (handle.rate_mm_s, handle.sliding_mm_s) == pytest.approx((42.0, 42.0), rel=0.01)


FORTH_MM = [0.1 * k for k in range(51)]


@pytest.mark.parametrize(
    ("way_mm", "direction", "turned_mm", "displacement_mm"),
    [
        (FORTH_MM, 1.0, 0.0, MOBILISED_MM),
        ([*FORTH_MM, 4.9, 4.5, 4.0], -1.0, 5.0, 1.0),
        ([*FORTH_MM, *[5.0 - 0.1 * k for k in range(1, 100)]], -1.0, 5.0, MOBILISED_MM),
        # many small steps back are one, from the furthest point
        ([0.0, 3.0, *[3.0 - HANDLE_COUNT_MM * k for k in range(20)]], -1.0, 3.0, 19 * HANDLE_COUNT_MM),
    ],
    ids=["from the start", "from the reversal", "mobilised again", "a slow creep back"],
)
def test_displacement_counts_from_the_reversal_until_friction_is_mobilised(
    follow_handle, way_mm: list[float], direction: float, turned_mm: float, displacement_mm: float
) -> None:
    handle = follow_handle(way_mm).handle
    found = handle.turn.direction, handle.turn.turned_mm, handle.displacement_mm
    assert found == pytest.approx((direction, turned_mm, displacement_mm))


@given(wobble=st.lists(st.floats(-TURN_MM, 0.0), min_size=1, max_size=30))
def test_a_wobble_below_the_threshold_is_no_reversal(follow_handle, wobble: list[float]) -> None:
    turn = follow_handle([0.0, 1.0, 3.0, *(3.0 + offset for offset in wobble)]).handle.turn
    assert (turn.direction, turn.furthest_mm) == (1.0, 3.0)


def test_encoder_noise_at_rest_is_no_reversal(follow_handle) -> None:
    handle = follow_handle([3.0 + HANDLE_COUNT_MM * (k % 2) for k in range(500)]).handle
    assert handle.turn.direction == 1.0
    assert abs(handle.rate_mm_s) < 1.0


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_force_and_rate_are_positive_along_the_motion(follow_handle, way: float) -> None:
    measured = follow_handle([way * 0.05 * k for k in range(200)], force_N=way * 0.6)
    assert (measured.force_N, measured.handle.rate_mm_s) == (0.6, pytest.approx(50.0, rel=0.05))


def test_whether_it_is_homed_is_the_devices_word(measure) -> None:
    assert [Look()(measure(0, switches=seen)).is_homed for seen in (Switches.HOMED, Switches(0))] == [True, False]
