"""The first stage: positions, speeds and the handle's motion from a device's measurements, how plausible and how old.

sight      the loop is blind while the device is silent, and right after a stall of the loop: a State is sent only in
           answer to a Drive, so the State that waits after a stall is as old as the stall
plausible  no encoder takes a step that no motor makes, shows a place that does not exist, or contradicts an end switch
"""

import math
from typing import Final, final

from firmware_protocol.codec import Switches
from firmware_protocol.value import Value
from tormagd.control.interpolation import low_pass
from tormagd.control.records import Handle, Measured
from tormagd.element.model.displacement import MOVING_MM_S, Turn
from tormagd.hardware.measurement import Measurement

RATE_FILTER_S: Final = 0.05
QUICK_FILTER_S: Final = 0.01
"The quicker of the handle's two rates shows a stop sooner."
SLIDING_MM: Final = 0.3
"Travel over which friction takes on the level of another rate."
FAST_MM_S: Final = 2.0 * MOVING_MM_S
"Friction hardly depends on the rate above this."
MIN_DT_S: Final = 5e-6
"Half a step of the device's clock: a shorter time gives no speed."
BLIND_S: Final = 0.005
BLIND_PERIODS: Final = 5.0
"Without a new State for longer than both, the carriages' places are too uncertain to drive them."
UNSENSED_S: Final = 0.02
"Without a new Sense for longer than both, force and handle are not measured."
SHOWN_S: Final = 0.1
LEAP_SPEEDS: Final = 3.0
"Neither a motor nor the magnets' pull moves a carriage faster than this many times the motor's full speed."
LEAP_MM: Final = 0.1
"Backlash, a screw that springs back and the encoder's resolution come to less than this."
OVERRUN_MM: Final = 2.5
"A carriage overruns its switches or its closed end by less than this."
CLOSED_END_MM: Final = 45.0
"The device's smallest gap: another scene may have left the carriages closer than this scene closes."
OPEN_SWITCH_MM: Final = 0.4
"An open switch switches this near the zero that homing found there to within 0.3 mm."
CLOSED_SWITCH_MM: Final = 1.0
"A closed switch closes this near the closed end: the stroke is known to 2 %."
TOLD_S: Final = 0.02
"The carriages' places and the switches' word may be this far apart in time."

_LEFT_OPEN: Final = int(Switches.LEFT_OPEN)
_RIGHT_OPEN: Final = int(Switches.RIGHT_OPEN)
_LEFT_CLOSED: Final = int(Switches.LEFT_CLOSED)
_RIGHT_CLOSED: Final = int(Switches.RIGHT_CLOSED)


@final
class Sight:
    """Whether the loop is blind, told from the times of steps and of new States."""

    seen_s: float = math.inf
    "inf before the first State."
    stalled_s: float = -math.inf
    stall_s: float = 0.0
    "Length of the last stall, or of the longest within SHOWN_S of each other."
    is_blind: bool = False
    was_blind: bool = False

    def __init__(self, period_s: float) -> None:
        self._blind_s: Final = max(BLIND_S, BLIND_PERIODS * period_s)

    def has_stalled(self, now_s: float) -> bool:
        return now_s - self.stalled_s < SHOWN_S

    def is_waiting(self, now_s: float) -> bool:
        """Tell whether the answer to the first Drive after a stall may still be on its way."""
        return self.is_blind and now_s - self.stalled_s < 2.0 * self._blind_s

    def update(self, last_s: float, now_s: float, is_new: bool) -> None:
        stall_s, self.was_blind = now_s - last_s, self.is_blind
        if stall_s > self._blind_s:
            before_s = self.stall_s if self.has_stalled(now_s) else 0.0
            self.seen_s, self.stalled_s, self.stall_s, self.is_blind = now_s, now_s, max(stall_s, before_s), True
        elif is_new:
            self.seen_s, self.is_blind = now_s, False
        elif now_s - self.seen_s > self._blind_s:
            self.is_blind = True


def unsensed_s(period_s: float) -> float:
    return max(UNSENSED_S, BLIND_PERIODS * period_s)


@final
class Leap(Value):
    """A step of the encoders that no carriage can make."""

    def __init__(self, seen_s: float, within_s: float, before: Measured, after: Measured) -> None:
        self.seen_s: Final = seen_s
        self.within_s: Final = within_s
        self.before: Final = before
        self.after: Final = after

    def __str__(self) -> str:
        left_mm, right_mm = self.after.left_mm - self.before.left_mm, self.after.right_mm - self.before.right_mm
        return f"left {left_mm:+.2f} mm, right {right_mm:+.2f} mm within {self.within_s * 1e3:.1f} ms"


def can_come(before: Measured, after: Measured, full_speed_mm_s: float, within_s: float) -> bool:
    """Tell whether both carriages can come from where one record has them to where the other has them."""
    max_mm = LEAP_SPEEDS * full_speed_mm_s * within_s + LEAP_MM
    return abs(after.left_mm - before.left_mm) <= max_mm and abs(after.right_mm - before.right_mm) <= max_mm


def leap_between(
    last: Measured, measured: Measured, full_speed_mm_s: float, now_s: float, seen_s: float
) -> Leap | None:
    within_s = max(measured.device_time_s - last.device_time_s, now_s - seen_s)
    is_possible = can_come(last, measured, full_speed_mm_s, within_s)
    return None if is_possible else Leap(now_s, within_s, last, measured)


def is_outside(measured: Measured, closed_mm: float, open_mm: float) -> bool:
    min_mm, max_mm = min(closed_mm, CLOSED_END_MM) / 2.0 - OVERRUN_MM, open_mm / 2.0 + OVERRUN_MM
    return not (min_mm <= measured.left_mm <= max_mm and min_mm <= measured.right_mm <= max_mm)


def is_contradicted(measured: Measured, switches: int, closed_mm: float, open_mm: float) -> bool:
    """Tell whether an end switch contradicts its carriage's place."""
    inner_mm, home_mm = min(closed_mm, CLOSED_END_MM) / 2.0 + CLOSED_SWITCH_MM, open_mm / 2.0
    is_left_wrong = _is_contradicted(
        measured.left_mm, measured.left_mm_s, switches & _LEFT_OPEN, switches & _LEFT_CLOSED, inner_mm, home_mm
    )
    return is_left_wrong or _is_contradicted(
        measured.right_mm, measured.right_mm_s, switches & _RIGHT_OPEN, switches & _RIGHT_CLOSED, inner_mm, home_mm
    )


def _is_contradicted(
    at_mm: float, speed_mm_s: float, is_open: int, is_closed: int, inner_mm: float, home_mm: float
) -> bool:
    moved_mm = TOLD_S * abs(speed_mm_s)
    near_mm = OPEN_SWITCH_MM + moved_mm
    is_elsewhere = at_mm < home_mm - near_mm if is_open else at_mm > home_mm + near_mm
    return is_elsewhere or (is_closed != 0 and at_mm > inner_mm + moved_mm)


@final
class Measure:
    """The stage that turns one device's messages into positions, filtered speeds and the handle's motion."""

    measured: Measured | None = None
    "None until the device has said something."
    leap: Leap | None = None
    "A step of the encoders that no carriage can make, until the device has said whether it was reset."

    def __init__(
        self, home_mm: float, derivative_filter_s: float, turns: bool, full_speed_mm_s: float, period_s: float
    ) -> None:
        self.sight = Sight(period_s)
        self._period_s: Final = period_s
        self._home_mm: Final = home_mm
        self._derivative_filter_s: Final = derivative_filter_s
        self._turns: Final = turns
        self._full_speed_mm_s: Final = full_speed_mm_s

    def update(self, last_s: float, now_s: float, measurement: Measurement, needs_homing: bool) -> Measured:
        """Measure at `now_s`, one tick after `last_s`, and keep the record in `measured`."""
        last, seen_s = self.measured, self.sight.seen_s
        is_new = last is None or measurement.number != last.number
        self.sight.update(last_s, now_s, is_new)
        measured = self.measured = self._measured(last, measurement)
        if self.leap is not None:
            # a device that was reset says so itself; after a burst of noise on the line the counts are right again
            is_over, since_s = needs_homing or not measurement.is_homed, self.leap.within_s + now_s - self.leap.seen_s
            if is_over or can_come(self.leap.before, measured, self._full_speed_mm_s, since_s):
                self.leap = None
        elif is_new and last is not None and last.is_homed and measurement.is_homed:
            self.leap = leap_between(last, measured, self._full_speed_mm_s, now_s, seen_s)
        return measured

    def without_position(self, measured: Measured) -> Measured:
        self.measured = measured.replaced(is_homed=False) if measured.is_homed else measured
        return self.measured

    def lose_device(self) -> None:
        self.measured = None

    def forget(self) -> None:
        self.measured, self.leap, self.sight = None, None, Sight(self._period_s)

    def begin(self, measurement: Measurement) -> Measured:
        """Replace the newest record by one of `measurement` at rest."""
        self.measured = Measured(
            number=measurement.number,
            is_homed=measurement.is_homed,
            device_time_s=measurement.device_time_s,
            left_mm=self._home_mm + measurement.left_mm,
            right_mm=self._home_mm + measurement.right_mm,
            left_mm_s=0.0,
            right_mm_s=0.0,
            force_N=measurement.force_N,
            handle=Handle(0.0, 0.0, Turn(1.0, measurement.handle_mm, measurement.handle_mm)),
            handle_mm=measurement.handle_mm,
            sensed_s=measurement.sensed_s,
            handle_time_s=measurement.device_time_s,
        )
        return self.measured

    def _measured(self, last: Measured | None, measurement: Measurement) -> Measured:
        if last is None:
            return self.begin(measurement)
        dt_s = measurement.device_time_s - last.device_time_s
        if measurement.number == last.number or dt_s < MIN_DT_S:
            return last
        left_mm, right_mm = self._home_mm + measurement.left_mm, self._home_mm + measurement.right_mm
        # a handle without a new Sense has not stopped: its motion is judged over the time since the last Sense
        handle, handle_time_s = last.handle, last.handle_time_s
        if measurement.sensed_s != last.sensed_s:
            handle = self._handle(last, measurement.handle_mm, measurement.device_time_s - handle_time_s)
            handle_time_s = measurement.device_time_s
        return Measured(
            number=measurement.number,
            is_homed=measurement.is_homed,
            device_time_s=measurement.device_time_s,
            left_mm=left_mm,
            right_mm=right_mm,
            left_mm_s=low_pass(last.left_mm_s, (left_mm - last.left_mm) / dt_s, dt_s, self._derivative_filter_s),
            right_mm_s=low_pass(last.right_mm_s, (right_mm - last.right_mm) / dt_s, dt_s, self._derivative_filter_s),
            force_N=measurement.force_N * handle.turn.direction,
            handle=handle,
            handle_mm=measurement.handle_mm,
            sensed_s=measurement.sensed_s,
            handle_time_s=handle_time_s,
        )

    def _handle(self, last: Measured, position_mm: float, dt_s: float) -> Handle:
        before = last.handle
        travel_mm = position_mm - last.handle_mm
        rate_mm_s = low_pass(before.turn.direction * before.rate_mm_s, travel_mm / dt_s, dt_s, RATE_FILTER_S)
        quick_mm_s = low_pass(before.turn.direction * before.quick_mm_s, travel_mm / dt_s, dt_s, QUICK_FILTER_S)
        slid = abs(travel_mm) / (SLIDING_MM + abs(travel_mm))
        # friction has one level at 42 and 300 mm/s and another at 4: a greater rate before counts as FAST_MM_S
        from_mm_s = min(before.sliding_mm_s, max(abs(rate_mm_s), FAST_MM_S))
        sliding_mm_s = from_mm_s + slid * (abs(rate_mm_s) - from_mm_s)
        turn = before.turn.moved_to(position_mm) if self._turns else before.turn
        displacement_mm = turn.displacement_mm(position_mm) if self._turns else max(position_mm, 0.0)
        return Handle(displacement_mm, turn.direction * rate_mm_s, turn, sliding_mm_s, turn.direction * quick_mm_s)
