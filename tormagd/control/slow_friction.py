"""What friction does at a creep, beside what the device has shown at speed: static friction differs from device to
device, and a fit that was learned at other forces may be wrong at this one.

Learned while the handle slides slowly, and believed there only: slow motion says nothing of what holds at speed. More
force than expected is learned freely, because that opens the gap; less only as far as static friction differs, because
nothing judges the sensor at a creep.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value

STRIBECK_MM_S: Final = 5.0
"Handles of this speed have left most of static friction behind (plant card)."
SLOWEST_MM_S: Final = 0.3
"A slower handle may stand."
REACH_MM: Final = 0.35
"Over this travel friction follows a field that rises: 2.5 N bend the bristles so far before they slide."
LEARNED_S: Final = 0.3
LEAST: Final = 0.9
MOST: Final = 1.45
"""Static over kinetic friction is 1.08 to 1.25, and 1.15 on the device of the model. A fit from 0.7 N may be wrong by a
fifth at 2 N besides."""


@final
class SlowFriction(Value):
    """The device's force at a creep over what its fit says, and the share of that which was learned at a creep; the
    model's force as far as the bristles have followed it, N; and where the handle was then, mm."""

    __match_args__ = ("factor", "learned", "followed_N", "handle_mm")
    __slots__ = __match_args__

    def __init__(
        self, factor: float = 1.0, learned: float = 0.0, followed_N: float = 0.0, handle_mm: float = 0.0
    ) -> None:
        self.factor: Final = factor
        self.learned: Final = learned
        self.followed_N: Final = followed_N
        self.handle_mm: Final = handle_mm

    def factor_at(self, rate_mm_s: float) -> float:
        """The factor for a handle that slides at this rate, 0 or more: 1 at speed."""
        return 1.0 + _slowness(rate_mm_s) * (self.factor - 1.0)

    def followed(self, model_N: float, handle_mm: float) -> "SlowFriction":
        """After the handle went to `handle_mm` where the model says `model_N`: at once to less, over travel to more."""
        rise_N = model_N - self.followed_N
        if rise_N > 0.0:
            rise_N *= 1.0 - math.exp(-abs(handle_mm - self.handle_mm) / REACH_MM)
        return SlowFriction(self.factor, self.learned, self.followed_N + rise_N, handle_mm)

    def beside(self, before_N: float, after_N: float) -> "SlowFriction":
        """Beside a fit that has learned to expect `after_N` where it expected `before_N`: the same force at a creep, as
        far as that was learned there."""
        if before_N == after_N or self.learned == 0.0 or not (before_N > 0.0 and after_N > 0.0):
            return self
        factor = min(max(self.factor * math.pow(before_N / after_N, self.learned), LEAST), MOST)
        return SlowFriction(factor, self.learned, self.followed_N, self.handle_mm)

    def observed(self, expected_N: float, rate_mm_s: float, reading_N: float, elapsed_s: float) -> "SlowFriction":
        """After a reading along a motion at `rate_mm_s`, where the fit makes `expected_N` > 0 of what was followed."""
        slowness = _slowness(rate_mm_s)
        share = slowness * elapsed_s / (LEARNED_S + elapsed_s)
        found = self.factor + share * (1.0 + (reading_N / expected_N - 1.0) / slowness - self.factor)
        learned = self.learned + share * (1.0 - self.learned)
        return SlowFriction(min(max(found, LEAST), MOST), learned, self.followed_N, self.handle_mm)


def _slowness(rate_mm_s: float) -> float:
    ratio = rate_mm_s / STRIBECK_MM_S
    return math.exp(-ratio * ratio)


NOTHING_SLOW: Final = SlowFriction()
