"""Positions, speeds and the handle's motion from a device's measurements, with their plausibility and age."""

from typing import Final, final

from tormagd.control.interpolation import low_pass
from tormagd.control.plausible import Leap, leap_between
from tormagd.control.records import Handle, Measured
from tormagd.control.sight import Sight
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
            is_over = needs_homing or not measurement.is_homed
            if is_over or self.leap.has_come_back(measured, self._full_speed_mm_s, now_s):
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

    def begin(self, measurement: Measurement) -> None:
        """Replace the newest record by one of `measurement` at rest."""
        self.measured = self._first(measurement)

    def _first(self, measurement: Measurement) -> Measured:
        return Measured(
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

    def _measured(self, last: Measured | None, measurement: Measurement) -> Measured:
        if last is None:
            return self._first(measurement)
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
        if not self._turns:
            return Handle(max(position_mm, 0.0), rate_mm_s, before.turn, sliding_mm_s, quick_mm_s)
        turn = before.turn.moved_to(position_mm)
        onward = turn.direction
        displacement_mm = turn.displacement_mm(position_mm)
        return Handle(displacement_mm, onward * rate_mm_s, turn, sliding_mm_s, onward * quick_mm_s)
