"""The interface to what moves the gap: a plan in, two duties out, and what is known of the motion."""

from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.records import Measured, Plan
from tormagd.control.safety.codes import Limit
from tormagd.hardware.measurement import Measurement

CARRY_S: Final = 0.012
"A plan's gap is carried on for no more than three inference periods."


@final
class Reference(Value):
    """A place to drive the gap to, with its speed and acceleration."""

    def __init__(self, gap_mm: float, speed_mm_s: float = 0.0, acceleration_mm_s2: float = 0.0) -> None:
        self.gap_mm: Final = gap_mm
        self.speed_mm_s: Final = speed_mm_s
        self.acceleration_mm_s2: Final = acceleration_mm_s2


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
        self, left_duty: float, right_duty: float, left_motor: float, right_motor: float, limits: tuple[Limit, ...]
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


def target_of(plan: Plan, now_s: float, lag_s: float, floor_mm: float, open_mm: float) -> Reference:
    """Return where `plan` leads `lag_s` from now, when the present duty takes effect."""
    age_s = min(max(now_s - plan.time_s, 0.0), CARRY_S) + lag_s
    gap_mm = plan.gap_mm + age_s * (plan.gap_speed_mm_s + age_s * plan.gap_acceleration_mm_s2 / 2.0)
    speed_mm_s = plan.gap_speed_mm_s + age_s * plan.gap_acceleration_mm_s2
    acceleration_mm_s2 = plan.gap_acceleration_mm_s2
    if gap_mm < floor_mm:
        gap_mm, speed_mm_s, acceleration_mm_s2 = floor_mm, max(speed_mm_s, 0.0), max(acceleration_mm_s2, 0.0)
    if gap_mm > open_mm:
        gap_mm, speed_mm_s, acceleration_mm_s2 = open_mm, min(speed_mm_s, 0.0), min(acceleration_mm_s2, 0.0)
    return Reference(gap_mm, speed_mm_s, acceleration_mm_s2)
