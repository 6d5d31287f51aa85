"""The gap reference: follows a moving target as fast as the carriages can, and no faster."""

import math
from typing import NamedTuple

from tormagd.config import Position

APPROACH_S = 0.01
"Time constant of the last stretch: below it the reference would chase every quantum of its target."

SMOOTHING_S = 0.002
"The acceleration is for feed-forward: smoothed, because the motor's current follows it."


class Reference(NamedTuple):
    """Where the gap should be, mm, and how fast it moves there, mm/s and (smoothed) mm/s^2."""

    gap_mm: float
    speed_mm_s: float = 0.0
    acceleration_mm_s2: float = 0.0


def follow(
    limits: Position,
    reference: Reference,
    target_mm: float,
    target_speed_mm_s: float,
    dt_s: float,
    no_load_speed_mm_s: float,
) -> tuple[Reference, bool]:
    """The reference `dt_s` later, and whether the speed limit holds it back from the target.

    The closing speed is the largest from which the distance left still suffices to brake, so that a step is
    time-optimal under the limits and does not overshoot; the target's own speed is added, so that a moving target is
    followed without lag. Speeding up, the acceleration falls with speed to nothing at `no_load_speed_mm_s`.
    """
    distance = target_mm - reference.gap_mm
    change = limits.gap_acceleration_mm_s2 * dt_s
    braking = (math.sqrt(change * change + 8.0 * limits.gap_acceleration_mm_s2 * abs(distance)) - change) / 2.0
    closing = math.copysign(min(braking, abs(distance) / max(APPROACH_S, dt_s)), distance)
    wanted = target_speed_mm_s + closing
    bounded = min(max(wanted, -limits.gap_speed_mm_s), limits.gap_speed_mm_s)
    torque = max(0.0, 1.0 - abs(reference.speed_mm_s) / no_load_speed_mm_s)
    is_opening = reference.speed_mm_s > 0.0
    up, down = (change * torque, change) if is_opening else (change, change * torque)
    step = min(max(bounded - reference.speed_mm_s, -down), up)
    speed = reference.speed_mm_s + step
    acceleration = reference.acceleration_mm_s2
    acceleration += dt_s / (SMOOTHING_S + dt_s) * (step / dt_s - acceleration)
    return Reference(reference.gap_mm + speed * dt_s, speed, acceleration), bounded != wanted
