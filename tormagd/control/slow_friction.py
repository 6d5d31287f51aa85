"""What friction does at a creep, beside what the device has shown at speed: static friction differs from device to
device, and a fit that was learned at other forces may be wrong at this one.

Learned while the handle slides slowly, and believed there only: slow motion says nothing of what holds at speed. It is
learned as far as static friction differs from device to device, and the fit is uncertain: of a device that was never
seen at speed a creep shows nearly all, of one that is known it shows its static friction and no more.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.device_fit import LEAST_SCALE, MOST_SCALE, RELAXES_MOST, DeviceFit

STRIBECK_MM_S: Final = 5.0
"Handles of this speed have left most of static friction behind (plant card)."
SLOWEST_MM_S: Final = 0.3
"A slower handle may stand."
REACH_MM: Final = 0.35
"Over this travel friction follows a field that rises: 2.5 N bend the bristles so far before they slide."
LEARNED_S: Final = 0.3
STATIC_LEAST: Final = 0.9
STATIC_MOST: Final = 1.15
"""Static over kinetic friction is 1.08 to 1.25, and 1.15 on the device of the model; and the speeds at which it fades
differ."""
LEAST: Final = LEAST_SCALE * STATIC_LEAST
MOST: Final = MOST_SCALE * STATIC_MOST
"Of any device."
BELIEVED_SD: Final = 3.0
"""Standard deviations of the fit within which a creep is believed. Chosen on draws 0 to 39: with two, seven of them are
held at this bound, for up to a hundredth of the time in which they creep at first."""
LEAST_SHARE: Final = LEAST_SCALE * (1.0 - RELAXES_MOST)
NOISE_N: Final = 0.03
"A sensor that reads less than this share of the model's force, and its noise, teaches nothing: no device is so weak."


@final
class SlowFriction(Value):
    """The device's force at a creep over what its fit says, and the share of that which was learned at a creep; the
    model's force as far as the bristles have followed it, N; and where the handle was then, mm."""

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

    def observed(self, fit: DeviceFit, rate_mm_s: float, reading_N: float, elapsed_s: float) -> "SlowFriction":
        """After a reading along a motion at `rate_mm_s`, where the fit makes more than nothing of what was followed."""
        if reading_N < LEAST_SHARE * self.followed_N - NOISE_N:
            return self
        slowness = _slowness(rate_mm_s)
        share = slowness * elapsed_s / (LEARNED_S + elapsed_s)
        found = self.factor + share * (1.0 + (reading_N / fit.force_N(self.followed_N) - 1.0) / slowness - self.factor)
        learned = self.learned + share * (1.0 - self.learned)
        least, most = believable(fit, self.followed_N)
        return SlowFriction(min(max(found, least), most), learned, self.followed_N, self.handle_mm)


def believable(fit: DeviceFit, model_N: float) -> tuple[float, float]:
    """The least and the greatest factor of a device with that fit, where the model says `model_N`."""
    unsure = BELIEVED_SD * fit.deviation_N(model_N) / fit.force_N(model_N)
    return max(STATIC_LEAST - unsure, LEAST), min(STATIC_MOST + unsure, MOST)


def _slowness(rate_mm_s: float) -> float:
    ratio = rate_mm_s / STRIBECK_MM_S
    return math.exp(-ratio * ratio)


NOTHING_SLOW: Final = SlowFriction()
