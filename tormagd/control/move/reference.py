"""The reference of the gap: it follows a moving target as fast as the motors can, and no faster."""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.interpolation import low_pass
from tormagd.control.records import GapSpeeds, Plan

CARRY_S: Final = 0.012
"A plan's gap is carried on for no more than three inference periods."
APPROACH_S: Final = 0.01
"With less the reference would chase every quantum of its target."
MIN_BRAKING: Final = 0.2
"Share of the acceleration that is left to brake with, however hard the target turns."


@final
class Reference(Value):
    """A place to drive the gap to, with its speed and acceleration."""

    def __init__(self, gap_mm: float, speed_mm_s: float = 0.0, acceleration_mm_s2: float = 0.0) -> None:
        self.gap_mm: Final = gap_mm
        self.speed_mm_s: Final = speed_mm_s
        self.acceleration_mm_s2: Final = acceleration_mm_s2


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


def follow(
    acceleration_mm_s2: float,
    reference: Reference,
    target: Reference,
    dt_s: float,
    speeds: GapSpeeds,
    floor_mm: float = -math.inf,
) -> tuple[Reference, bool, bool]:
    """Return the reference `dt_s` later, and whether its speed and its acceleration held it back."""
    distance = target.gap_mm - reference.gap_mm
    relative = acceleration_mm_s2 + math.copysign(1.0, distance) * target.acceleration_mm_s2
    relative = max(relative, MIN_BRAKING * acceleration_mm_s2)
    closing = math.copysign(_stopping_mm_s(abs(distance), relative, dt_s), distance)
    wanted = target.speed_mm_s + closing
    wanted = max(wanted, -_stopping_mm_s(max(reference.gap_mm - floor_mm, 0.0), acceleration_mm_s2, dt_s))
    bounded = min(max(wanted, -speeds.sure_mm_s), speeds.opening_mm_s)
    share = min(abs(reference.speed_mm_s) / speeds.no_load_mm_s, 1.0)
    speeding_up = acceleration_mm_s2 * (1.0 - share)
    braking = acceleration_mm_s2 * (1.0 + share if reference.speed_mm_s * distance < 0.0 else 1.0)
    up, down = (speeding_up, braking) if reference.speed_mm_s > 0.0 else (braking, speeding_up)
    asked = (bounded - reference.speed_mm_s) / dt_s
    chosen = min(max(asked, -down), up)
    speed = reference.speed_mm_s + chosen * dt_s
    return Reference(reference.gap_mm + speed * dt_s, speed, chosen), bounded != wanted, chosen != asked


def _stopping_mm_s(distance_mm: float, braking_mm_s2: float, dt_s: float) -> float:
    """Return the greatest speed from which `distance_mm` suffices to stop in steps of `dt_s`."""
    change = braking_mm_s2 * dt_s
    fastest = (math.sqrt(change * change + 8.0 * braking_mm_s2 * distance_mm) - change) / 2.0
    return min(fastest, distance_mm / max(APPROACH_S, dt_s))


@final
class Expected:
    """Where the carriages are expected: the reference with its jerk limited."""

    gap_mm: float = 0.0
    speed_mm_s: float = 0.0
    filtered_mm_s: float = 0.0
    "Filtered like the measured speeds."

    def begin(self, gap_mm: float, speed_mm_s: float = 0.0) -> None:
        self.gap_mm, self.speed_mm_s, self.filtered_mm_s = gap_mm, speed_mm_s, speed_mm_s

    def update(self, reference: Reference, dt_s: float, lag_s: float, filter_s: float) -> None:
        self.speed_mm_s = low_pass(self.speed_mm_s, reference.speed_mm_s, dt_s, lag_s)
        self.gap_mm = low_pass(self.gap_mm, reference.gap_mm, dt_s, lag_s)
        self.filtered_mm_s = low_pass(self.filtered_mm_s, self.speed_mm_s, dt_s, filter_s)
