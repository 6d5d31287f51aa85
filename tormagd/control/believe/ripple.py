"""How one device's friction varies over the angle of its handle: once, twice and three times a turn.

    share    sum of a_k cos k angle + b_k sin k angle                   k = 1, 2, 3
    update   a_k -= LEARNS / k sin(k angle) de,  b_k += LEARNS / k cos(k angle) de

e is by which share a reading, the known ripple taken off, is over what the device first showed. Only its changes de
over the angle count, so a force that falls all the while is no ripple: over a turn its sines and cosines add up to 0.
"""

import math
from typing import Final, final

from tormagd.control.believe.anchor import Anchor

HARMONICS: Final = (1, 2, 3)
LEARNS: Final = 0.2
"A turn leaves exp(-pi LEARNS) of a wave."
QUIET: Final = 0.01
"So much of a wave is not believed: steps and relaxing leave as much."
STEP_RAD: Final = 0.1
"Changes are taken over this angle; none over three times as much without a reading."
STEEPEST: Final = 0.045
"No ripple changes by a greater share over STEP_RAD, nor moves the gap by as much."
STEADY_MM_S: Final = 5.0
"Over STEP_RAD the handle's rate may change by so much: friction differs with the rate."
SETTLES_RAD: Final = 1.5
"After a change of rate or gap nothing is learned for this angle."
LEAST_N: Final = 0.1
"Least force that a share is of."


@final
class Ripple:
    """Estimator of the friction's share over the handle's angle."""

    shares: list[float]
    "a_1, b_1, a_2, b_2, a_3, b_3."
    at_rad: float = math.inf
    "The angle at which the last change ended."
    reading_N: float = 0.0
    "The reading there."
    model_N: float = 0.0
    "The model's force there."
    rate_mm_s: float = 0.0
    "The handle's rate there."
    steady_rad: float = 0.0
    "Over which angle gap and rate have been steady."

    def __init__(self) -> None:
        self.shares = [0.0] * 6

    def share(self, angle: float) -> float:
        """Return by which share the friction at the handle's `angle` is greater than its mean over a turn."""
        share = 0.0
        for k in HARMONICS:
            a, b = self.shares[2 * k - 2], self.shares[2 * k - 1]
            believed = 1.0 - QUIET / max(math.hypot(a, b), QUIET)
            share += believed * (a * math.cos(k * angle) + b * math.sin(k * angle))
        return share

    def update(self, angle: float, rate_mm_s: float, model_N: float, reading_N: float, anchor: Anchor) -> None:
        """Take a mean of readings at the handle's `angle`, the known ripple taken off."""
        step_rad = angle - self.at_rad
        if abs(step_rad) < STEP_RAD:
            return
        force_N, before_N = max(anchor.force_N(model_N), LEAST_N), max(anchor.force_N(self.model_N), LEAST_N)
        changed = math.copysign(1.0, step_rad) * (reading_N / force_N - self.reading_N / before_N)
        is_steady = abs(step_rad) <= 3.0 * STEP_RAD and abs(rate_mm_s - self.rate_mm_s) <= STEADY_MM_S
        is_steady = is_steady and max(abs(changed), abs(before_N / force_N - 1.0)) <= STEEPEST
        self.steady_rad = self.steady_rad + abs(step_rad) if is_steady else 0.0
        self.at_rad, self.rate_mm_s, self.model_N, self.reading_N = angle, rate_mm_s, model_N, reading_N
        if self.steady_rad < SETTLES_RAD:
            return
        for k in HARMONICS:
            self.shares[2 * k - 2] -= LEARNS * changed / k * math.sin(k * (angle - 0.5 * step_rad))
            self.shares[2 * k - 1] += LEARNS * changed / k * math.cos(k * (angle - 0.5 * step_rad))
