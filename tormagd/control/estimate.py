"""From a measurement to what the controller needs: gap, carriage speeds, and the handle's motion since it turned."""

from typing import Final, final

from firmware_protocol.value import Value
from tormagd.hardware.measurement import Measurement
from tormagd.model.displacement import MOVING_MM_S, Turn

RATE_FILTER_S: Final = 0.05
SLIDING_MM: Final = 0.3
"Friction takes on the level of another rate over some such travel; without travel it does not change."
FAST_MM_S: Final = 2.0 * MOVING_MM_S
"From here on friction hardly depends on the rate: what Stribeck's part there is has faded."
LEAST_DT_S: Final = 5e-6
"Half a step of the device's clock; positions over less time than that would give speeds without bound."


@final
class Handle(Value):
    """The handle's motion: its signed rate, the turn that displacement counts from, and how far it is from there. Of a
    finger in a pad, which does not turn: how deep it is, and how fast it presses in.

    `sliding_mm_s` is the rate at which friction slides, of either sign of the motion: the rate over the last travel, so
    that a handle that stops keeps it. `rate_mm_s` is positive the way the handle went last.
    """

    def __init__(self, displacement_mm: float, rate_mm_s: float, turn: Turn, sliding_mm_s: float = MOVING_MM_S) -> None:
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.turn: Final = turn
        self.sliding_mm_s: Final = sliding_mm_s


@final
class Estimate(Value):
    """Carriages in mm from the centre plane, speeds in mm/s (opening is positive), force in N against the motion.

    Where they are not homed, positions mean nothing: they count from wherever the carriages were, or counts were lost.
    Force and handle are of a Sense that came at `sensed_s` on the host's clock, `handle_time_s` on the device's.
    """

    def __init__(
        self,
        number: int,
        is_homed: bool,
        device_time_s: float,
        left_mm: float,
        right_mm: float,
        left_mm_s: float,
        right_mm_s: float,
        force_N: float,
        handle: Handle,
        handle_mm: float,
        sensed_s: float,
        handle_time_s: float,
    ) -> None:
        self.number: Final = number
        self.is_homed: Final = is_homed
        self.device_time_s: Final = device_time_s
        self.left_mm: Final = left_mm
        self.right_mm: Final = right_mm
        self.left_mm_s: Final = left_mm_s
        self.right_mm_s: Final = right_mm_s
        self.force_N: Final = force_N
        self.handle: Final = handle
        self.handle_mm: Final = handle_mm
        self.sensed_s: Final = sensed_s
        self.handle_time_s: Final = handle_time_s

    @property
    def gap_mm(self) -> float:
        """Distance between the magnets, mm."""
        return self.left_mm + self.right_mm

    @property
    def skew_mm(self) -> float:
        """Left carriage minus right carriage, mm."""
        return self.left_mm - self.right_mm


def first_estimate(measurement: Measurement, home_mm: float) -> Estimate:
    """The estimate from one measurement: everything at rest. `home_mm` is a carriage's distance from the centre
    plane when it is on its home switch.
    """
    return Estimate(
        number=measurement.number,
        is_homed=measurement.is_homed,
        device_time_s=measurement.device_time_s,
        left_mm=home_mm + measurement.left_mm,
        right_mm=home_mm + measurement.right_mm,
        left_mm_s=0.0,
        right_mm_s=0.0,
        force_N=measurement.force_N,
        handle=Handle(0.0, 0.0, Turn(1.0, measurement.handle_mm, measurement.handle_mm)),
        handle_mm=measurement.handle_mm,
        sensed_s=measurement.sensed_s,
        handle_time_s=measurement.device_time_s,
    )


def update(
    last: Estimate | None, measurement: Measurement, home_mm: float, derivative_filter_s: float, turns: bool = True
) -> Estimate:
    """The estimate after one more measurement; the same one again where the device has said nothing new. `turns` tells
    a handle from a finger, whose force always pushes the same way.

    Speeds are filtered derivatives over the *device's* clock, so that late delivery is not mistaken for slow motion.
    """
    if last is None:
        return first_estimate(measurement, home_mm)
    dt_s = measurement.device_time_s - last.device_time_s
    if measurement.number == last.number or dt_s < LEAST_DT_S:
        return last
    left, right = home_mm + measurement.left_mm, home_mm + measurement.right_mm
    share = dt_s / (derivative_filter_s + dt_s)
    # without news of the handle it has not stopped: its motion is judged over all the time since the last
    handle, handle_time_s = last.handle, last.handle_time_s
    if measurement.sensed_s != last.sensed_s:
        handle = _handle(last, measurement.handle_mm, measurement.device_time_s - handle_time_s, turns)
        handle_time_s = measurement.device_time_s
    return Estimate(
        number=measurement.number,
        is_homed=measurement.is_homed,
        device_time_s=measurement.device_time_s,
        left_mm=left,
        right_mm=right,
        left_mm_s=last.left_mm_s + share * ((left - last.left_mm) / dt_s - last.left_mm_s),
        right_mm_s=last.right_mm_s + share * ((right - last.right_mm) / dt_s - last.right_mm_s),
        force_N=measurement.force_N * handle.turn.direction,
        handle=handle,
        handle_mm=measurement.handle_mm,
        sensed_s=measurement.sensed_s,
        handle_time_s=handle_time_s,
    )


def _handle(last: Estimate, position_mm: float, dt_s: float, turns: bool) -> Handle:
    before = last.handle
    share = dt_s / (RATE_FILTER_S + dt_s)
    speed = before.turn.direction * before.rate_mm_s
    travel_mm = position_mm - last.handle_mm
    speed += share * (travel_mm / dt_s - speed)
    slid = abs(travel_mm) / (SLIDING_MM + abs(travel_mm))
    # friction's level is one of 300 and 42 mm/s, and another of 4: how much faster it has been does not count
    from_mm_s = min(before.sliding_mm_s, max(abs(speed), FAST_MM_S))
    sliding = from_mm_s + slid * (abs(speed) - from_mm_s)
    if not turns:
        return Handle(max(position_mm, 0.0), speed, before.turn, sliding)
    turn = before.turn.moved_to(position_mm)
    return Handle(turn.displacement_mm(position_mm), turn.direction * speed, turn, sliding)
