"""Contact of hand and element, in the model's terms: the hand slides a handle, or presses a finger.

Each kind states the motion that the model is asked for, `planned` ahead and `motion_now`, and whether the latter
`is_known`. Its `displacement_mm` and `rate_mm_s` are the motion that the portrait is drawn for. Where it `slides`,
friction makes the force.
"""

from typing import Final, TypeAlias, final

from tormagd.control.records import Measured, TimedSetpoint
from tormagd.element.model.displacement import MOBILISED_MM, MOVING_MM_S

ROLLER_RATE_MM_S: Final = 42.0
"The thesis turns at 20 rpm; the portrait is drawn for a handle in motion."
CREEP_MM_S: Final = 0.5
"A slower handle is planned for at this rate, because its friction is static."
GONE_BACK_MM: Final = 0.01
"A handle that has gone back by more (just over one encoder count) may be turning."
PRESSED: Final = 0.9
"A finger that is less deep than this share of the scene's depth is on its way in or out."


@final
class Sliding:
    """The sliding handle of a brake. Plans take it as moving, with its friction mobilised."""

    displacement_mm: Final[float] = MOBILISED_MM
    rate_mm_s: Final[float] = ROLLER_RATE_MM_S
    slides: Final[bool] = True

    def planned(self, setpoint: TimedSetpoint | None, measured: Measured | None) -> tuple[float, float]:
        displacement_mm = MOBILISED_MM
        rate_mm_s = MOVING_MM_S if measured is None else measured.handle.sliding_mm_s
        if setpoint is not None:
            if setpoint.displacement_mm is not None:
                displacement_mm = setpoint.displacement_mm
            # the device's fit is learned at the measured rate; at the stated rate it would describe another device
            if setpoint.rate_mm_s is not None and (measured is None or not self.is_known(measured)):
                rate_mm_s = abs(setpoint.rate_mm_s)
        return displacement_mm, max(rate_mm_s, CREEP_MM_S)

    def motion_now(self, measured: Measured) -> tuple[float, float]:
        return MOBILISED_MM, abs(measured.handle.rate_mm_s)

    def is_known(self, measured: Measured) -> bool:
        """Tell whether friction is mobilised, so that the model can give the present force."""
        handle = measured.handle
        gone_back_mm = abs(measured.handle_mm - handle.turn.furthest_mm)
        return handle.displacement_mm >= MOBILISED_MM and gone_back_mm <= GONE_BACK_MM


@final
class Pressing:
    """A finger that presses into a pad. Until `is_known`, the force is planned for the scene's depth, at rest."""

    rate_mm_s: Final[float] = 0.0
    slides: Final[bool] = False

    def __init__(self, depth_mm: float) -> None:
        self.displacement_mm: Final = depth_mm

    def planned(self, setpoint: TimedSetpoint | None, measured: Measured | None) -> tuple[float, float]:
        depth_mm, rate_mm_s = self.displacement_mm, 0.0
        if measured is not None and self.is_known(measured):
            depth_mm, rate_mm_s = self.motion_now(measured)
        if setpoint is None:
            return depth_mm, rate_mm_s
        told_mm, told_mm_s = setpoint.displacement_mm, setpoint.rate_mm_s
        return depth_mm if told_mm is None else told_mm, rate_mm_s if told_mm_s is None else told_mm_s

    def motion_now(self, measured: Measured) -> tuple[float, float]:
        return measured.handle.displacement_mm, measured.handle.rate_mm_s

    def is_known(self, measured: Measured) -> bool:
        return measured.handle.displacement_mm >= PRESSED * self.displacement_mm


ElementContact: TypeAlias = Sliding | Pressing
