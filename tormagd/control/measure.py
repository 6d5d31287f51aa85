"""Positions, speeds and the handle's motion from a device's measurements, their plausibility and their age."""

from typing import Final, final

from tormagd.control.filter import low_pass
from tormagd.control.plausible import Leap, leap_between
from tormagd.control.records import Handle, Measured
from tormagd.control.sight import Sight
from tormagd.hardware.measurement import Measurement
from tormagd.model.displacement import MOVING_MM_S, Turn

RATE_FILTER_S: Final = 0.05
QUICK_FILTER_S: Final = 0.01
"Time constants of the handle's rate, and of the rate that shows a stop sooner."
SLIDING_MM: Final = 0.3
"Travel over which friction takes on the level of another rate; without travel its level stays."
FAST_MM_S: Final = 2.0 * MOVING_MM_S
"At higher rates friction hardly depends on the rate."
MIN_DT_S: Final = 5e-6
"Half a step of the device's clock: less time gives no speed."


@final
class Measure:
    """The stage that turns one device's messages into positions, filtered speeds and the handle's motion.

    It keeps the newest record, `measured`. `sight` tells whether the device is silent, `leap` whether an encoder has
    stepped as no carriage moves.
    """

    measured: Measured | None = None
    "The newest record; None while the device has said nothing."
    leap: Leap | None = None
    "The step of the encoders that no carriage makes, until the device has said whether it was reset; else None."

    def __init__(
        self, home_mm: float, derivative_filter_s: float, turns: bool, full_speed_mm_s: float, period_s: float
    ) -> None:
        """Take the constants of one device.

        `home_mm` is a carriage's distance from the centre plane on its home switch. `derivative_filter_s` is the time
        constant of carriage speeds, `full_speed_mm_s` one carriage's greatest speed, `period_s` the control period.
        With `turns` the element is a handle that turns round. Without it a finger presses, whose force always has the
        same sign.
        """
        self.sight = Sight(period_s)
        self._home_mm: Final = home_mm
        self._derivative_filter_s: Final = derivative_filter_s
        self._turns: Final = turns
        self._full_speed_mm_s: Final = full_speed_mm_s

    def update(self, last_s: float, now_s: float, measurement: Measurement, needs_homing: bool) -> Measured:
        """Measure at `now_s`, one tick after `last_s`: return the new record, and keep it in `measured`.

        Times are the host's, s. A `measurement` of the last number, or whose device time is less than MIN_DT_S after
        the last or before it, gives the last record again. Updates `sight`, and begins or ends a `leap`. A leap begins
        only between two measurements of a homed device. It ends when the counts come back, when the device says that it
        is not homed, or with `needs_homing`. Nothing is refused: call it with a measurement that `is_finite` only, as
        NaN would stay in the filters.
        """
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
        """Return `measured`, the newest record, marked as not homed, and keep it as the newest.

        A record that is not homed is returned as it is; one that is not the newest would become it. The places stay in
        the record. The next new measurement brings the device's own word again.
        """
        self.measured = measured.replaced(is_homed=False) if measured.is_homed else measured
        return self.measured

    def lose_device(self) -> None:
        """Drop the newest measurement: `measured` is None, and the next one is taken at rest. `sight` and `leap`
        stay."""
        self.measured = None

    def forget(self) -> None:
        """Drop the newest measurement and `leap`, and bring `sight` to its state before the first step."""
        self.measured, self.leap = None, None
        self.sight.forget()

    def begin(self, measurement: Measurement) -> None:
        """Replace the newest record by one of `measurement` at rest: speeds are 0, and the handle has not travelled.

        `sight` and `leap` stay. It serves while the origin of the places moves.
        """
        self.measured = self._first(measurement)

    def _first(self, measurement: Measurement) -> Measured:
        """Return a record of `measurement` at rest: speeds and the handle's rates are 0, it has not travelled.

        The handle's way, which the sign of the force is by, counts as positive; `sliding_mm_s` begins at MOVING_MM_S.
        The caller keeps the record. Nothing is checked.
        """
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
        """Return the record of `measurement`, or `last` again where the device has said nothing new.

        Nothing new is the same number, or a device time less than MIN_DT_S after that of `last`. `last` is None before
        the first: the record is one at rest. The force is positive against the handle's way. Without a new Sense the
        handle's motion stays that of `last`. Speeds are filtered derivatives over the *device's* clock, so that late
        delivery is not mistaken for slow motion. The caller keeps the record.
        """
        if last is None:
            return self._first(measurement)
        dt_s = measurement.device_time_s - last.device_time_s
        if measurement.number == last.number or dt_s < MIN_DT_S:
            return last
        left_mm, right_mm = self._home_mm + measurement.left_mm, self._home_mm + measurement.right_mm
        # a handle without a new Sense has not stopped: its motion is judged over all the time since the last Sense
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
        """Return the motion of a handle or finger that comes to `position_mm` on its encoder, `dt_s` > 0 after `last`.

        `dt_s` is from the last Sense, on the device's clock. Rates are filtered over RATE_FILTER_S and QUICK_FILTER_S,
        with their sign along the way of the handle, or inwards for a finger. `sliding_mm_s` follows the rate over
        SLIDING_MM of travel: a handle that stops keeps it, FAST_MM_S at most. A finger's depth is its position, and at
        least 0 mm; its `turn` stays. Nothing is kept here, and nothing checked.
        """
        before = last.handle
        travel_mm = position_mm - last.handle_mm
        rate_mm_s = low_pass(before.turn.direction * before.rate_mm_s, travel_mm / dt_s, dt_s, RATE_FILTER_S)
        quick_mm_s = low_pass(before.turn.direction * before.quick_mm_s, travel_mm / dt_s, dt_s, QUICK_FILTER_S)
        slid = abs(travel_mm) / (SLIDING_MM + abs(travel_mm))
        # friction has one level at 42 and 300 mm/s, another at 4: a greater rate before counts as FAST_MM_S
        from_mm_s = min(before.sliding_mm_s, max(abs(rate_mm_s), FAST_MM_S))
        sliding_mm_s = from_mm_s + slid * (abs(rate_mm_s) - from_mm_s)
        if not self._turns:
            return Handle(max(position_mm, 0.0), rate_mm_s, before.turn, sliding_mm_s, quick_mm_s)
        turn = before.turn.moved_to(position_mm)
        onward = turn.direction
        displacement_mm = turn.displacement_mm(position_mm)
        return Handle(displacement_mm, onward * rate_mm_s, turn, sliding_mm_s, onward * quick_mm_s)
