"""Plausibility of encoders and end switches: steps that no motor makes, places that do not exist, contradictions."""

from typing import Final, final

from firmware_protocol.codec import Switches
from firmware_protocol.value import Value
from tormagd.control.records import Measured

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
class Leap(Value):
    """A step of the encoders that no carriage can make."""

    def __init__(
        self,
        seen_s: float,
        left_mm: float,
        right_mm: float,
        within_s: float,
        left_from_mm: float,
        right_from_mm: float,
    ) -> None:
        self.seen_s: Final = seen_s
        self.left_mm: Final = left_mm
        self.right_mm: Final = right_mm
        self.within_s: Final = within_s
        self.left_from_mm: Final = left_from_mm
        self.right_from_mm: Final = right_from_mm

    def has_come_back(self, measured: Measured, full_speed_mm_s: float, now_s: float) -> bool:
        """Tell whether both carriages can have come to where they read from before the step."""
        max_mm = LEAP_SPEEDS * full_speed_mm_s * (self.within_s + now_s - self.seen_s) + LEAP_MM
        return (
            abs(measured.left_mm - self.left_from_mm) <= max_mm
            and abs(measured.right_mm - self.right_from_mm) <= max_mm
        )

    def __str__(self) -> str:
        return f"left {self.left_mm:+.2f} mm, right {self.right_mm:+.2f} mm within {self.within_s * 1e3:.1f} ms"


def leap_between(
    last: Measured, measured: Measured, full_speed_mm_s: float, now_s: float, seen_s: float
) -> Leap | None:
    left_mm, right_mm = measured.left_mm - last.left_mm, measured.right_mm - last.right_mm
    within_s = max(measured.device_time_s - last.device_time_s, now_s - seen_s)
    max_mm = LEAP_SPEEDS * full_speed_mm_s * within_s + LEAP_MM
    if -max_mm <= left_mm <= max_mm and -max_mm <= right_mm <= max_mm:
        return None
    return Leap(now_s, left_mm, right_mm, within_s, last.left_mm, last.right_mm)


def is_outside(measured: Measured, closed_mm: float, open_mm: float) -> bool:
    min_mm, max_mm = min(closed_mm, CLOSED_END_MM) / 2.0 - OVERRUN_MM, open_mm / 2.0 + OVERRUN_MM
    return not (min_mm <= measured.left_mm <= max_mm and min_mm <= measured.right_mm <= max_mm)


def is_contradicted(measured: Measured, switches: int, closed_mm: float, open_mm: float) -> bool:
    """Tell whether an end switch contradicts its carriage's place."""
    inner_mm, home_mm = min(closed_mm, CLOSED_END_MM) / 2.0 + CLOSED_SWITCH_MM, open_mm / 2.0
    left_open, left_closed = switches & _LEFT_OPEN != 0, switches & _LEFT_CLOSED != 0
    right_open, right_closed = switches & _RIGHT_OPEN != 0, switches & _RIGHT_CLOSED != 0
    return _is_contradicted(
        measured.left_mm, measured.left_mm_s, left_open, left_closed, inner_mm, home_mm
    ) or _is_contradicted(measured.right_mm, measured.right_mm_s, right_open, right_closed, inner_mm, home_mm)


def _is_contradicted(
    at_mm: float, speed_mm_s: float, is_open: bool, is_closed: bool, inner_mm: float, home_mm: float
) -> bool:
    moved_mm = TOLD_S * abs(speed_mm_s)
    near_mm = OPEN_SWITCH_MM + moved_mm
    is_elsewhere = at_mm < home_mm - near_mm if is_open else at_mm > home_mm + near_mm
    return is_elsewhere or (is_closed and at_mm > inner_mm + moved_mm)
