"""The interface to what moves the gap: a plan in, two duties out, and what is known of the motion."""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.move.reference import Reference
from tormagd.control.records import Measured, Plan
from tormagd.control.safety.codes import Limit
from tormagd.hardware.measurement import Measurement


@final
class Acted:
    """The number of ticks in which each limit of the output has acted."""

    rate: int = 0
    "The speed of the gap's reference was limited."
    slew: int = 0
    "The acceleration of the gap's reference was limited."
    not_finite: int = 0
    range: int = 0
    "A duty was limited."


@final
class Drive(Value):
    """The duties of one tick, and the limits that held the gap back."""

    def __init__(
        self, left_duty: float, right_duty: float, left_motor: float, right_motor: float, limits: list[Limit]
    ) -> None:
        self.left_duty: Final = left_duty
        self.right_duty: Final = right_duty
        self.left_motor: Final = left_motor
        self.right_motor: Final = right_motor
        self.limits: Final = limits


class Actuator:
    """What makes the gap follow a plan, by the duties of two motors."""

    reference: Reference | None = None
    "None while nothing is driven."
    acceleration_scale: float = 1.0
    "What the actuator has shown over what every device must reach, 1 or more."

    def __init__(self) -> None:
        self.acted = Acted()

    @property
    def reference_mm(self) -> float:
        return math.nan if self.reference is None else self.reference.gap_mm

    def begin(self, gap_mm: float) -> None:
        """Begin to drive at the gap `gap_mm`, at rest."""
        raise NotImplementedError

    def resume(self, measured: Measured) -> None:
        """Go on from the measured gap, and without a jump from its speed, after a blind time."""
        self.begin(measured.gap_mm)

    def update(
        self,
        now_s: float,
        dt_s: float,
        plan: Plan | None,
        measurement: Measurement,
        measured: Measured,
        is_over: bool,
    ) -> Drive:
        """Return the duties of one tick, `dt_s` > 0 after the last. Call `begin` first, and again after `stop`. Raises
        DomainError for a duty that is not finite; call `forget` then.
        """
        raise NotImplementedError

    def stop(self) -> None:
        self.reference = None

    def lose_device(self) -> None:
        """Forget how fast this device's motors accelerate, because another device may come."""
        self.acceleration_scale = 1.0

    def forget(self) -> None:
        """Stop, forget the device, and count a number that was not finite."""
        self.stop()
        self.lose_device()
        self.acted.not_finite += 1
