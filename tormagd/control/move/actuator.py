"""The seam to what moves the gap: a plan in, two duties out, and what is known of the motion."""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.move.reference import Reference
from tormagd.control.records import Measured, Plan
from tormagd.hardware.measurement import Measurement
from tormagd.safety.codes import Limit


@final
class Acted:
    """In how many ticks each limit of the output has acted, in the order in which they stand.

    Duties have no slew limit: the reference's acceleration bounds what is asked of the motors, their windings smooth
    the rest within `motor.inductance`, and a limit in between would only take phase away from the position loop.
    """

    rate: int = 0
    "The speed of the gap's reference,"
    slew: int = 0
    "its acceleration,"
    not_finite: int = 0
    "a number that was not finite,"
    range: int = 0
    "a duty out of its range."


@final
class Drive(Value):
    """Duties as the device takes them, each within its limit; what limits them; and the motors' part of them, before
    the device's own supply is allowed for."""

    def __init__(
        self, left_duty: float, right_duty: float, left_motor: float, right_motor: float, limits: list[Limit]
    ) -> None:
        self.left_duty: Final = left_duty
        self.right_duty: Final = right_duty
        self.left_motor: Final = left_motor
        self.right_motor: Final = right_motor
        self.limits: Final = limits


class Actuator:
    """Follows a plan's gap. The carriages are one; another is made by giving the methods that raise here."""

    reference: Reference | None = None
    "Where the gap is driven; None while nothing is driven."
    acceleration_scale: float = 1.0
    "1 or more: how fast the actuator has shown to gain speed, times what is asked of all."

    def __init__(self) -> None:
        self.acted = Acted()

    @property
    def reference_mm(self) -> float:
        """Where the gap is driven; NaN while nothing is."""
        return math.nan if self.reference is None else self.reference.gap_mm

    def begin(self, gap_mm: float) -> None:
        """Begins from that gap, at rest."""
        raise NotImplementedError

    def resume(self, measured: Measured) -> None:
        """Goes on, without a leap, from where the gap has come to while nobody saw it."""
        raise NotImplementedError

    def update(
        self,
        now_s: float,
        dt_s: float,
        plan: Plan | None,
        measurement: Measurement,
        measured: Measured,
        is_over: bool,
    ) -> Drive:
        """One tick, `dt_s` > 0 after the last. Without a `plan` the gap is held; it opens while the force `is_over`
        what it may be. The gap is never to be closer than the plan's least. Raises DomainError for what is not
        finite: `forget` follows."""
        raise NotImplementedError

    def stop(self) -> None:
        """Nothing is driven."""
        self.reference = None

    def lose_device(self) -> None:
        """Another device may come."""
        self.acceleration_scale = 1.0

    def forget(self) -> None:
        """A number was not finite: nothing that it may have come into is kept."""
        self.stop()
        self.lose_device()
        self.acted.not_finite += 1
