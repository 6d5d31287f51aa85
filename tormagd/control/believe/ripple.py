"""How one device's friction varies over the angle of its handle: once, twice and three times a turn.

    share    sum of a_k cos k angle + b_k sin k angle                   k = 1, 2, 3
    turn     a_k = -1/(pi k) sum of sin k angle de,  b_k = 1/(pi k) sum of cos k angle de    over one whole turn

e is by which share a reading, the known ripple taken off, is over what the device first showed. Only its changes de
count: a force that falls all the while is no ripple. Two turns that agree teach; in each the rate stays.
"""

import math
from typing import Final, final

from tormagd.control.believe.anchor import Anchor

HARMONICS: Final = (1, 2, 3)
QUIET: Final = 0.01
"A smaller wave is none: noise and relaxing leave as much."
AGREES: Final = 0.5
"Two turns agree where they differ by at most this share of the wave."
STEP_RAD: Final = 0.1
"Changes are taken over this angle; none over three times as much without a reading."
STEEPEST: Final = 0.06
"No ripple changes by a greater share over STEP_RAD, nor moves the gap by as much."
STEADY_MM_S: Final = 8.0
"Over a turn the handle's rate may change by so much: friction differs with the rate."
SETTLES_RAD: Final = 0.5
"After a change of rate or gap a turn begins so much later."
LEAST_N: Final = 0.1
"Least force that a share is of."


@final
class Ripple:
    """Estimator of the friction's share over the handle's angle. It keeps the turn that is being read, and the last."""

    shares: list[float]
    "a_1, b_1, a_2, b_2, a_3, b_3."
    turn: list[float]
    "The same of the turn that is being read."
    before: list[float]
    "The same of the whole turn before, less what it taught."
    left_rad: float = 0.0
    "How far it is to the turn's end."
    rate_mm_s: float = 0.0
    "The handle's rate as the turn began."
    at_rad: float = math.inf
    "The angle of the newest reading."
    reading_N: float = 0.0
    "That reading."
    model_N: float = 0.0
    "The model's force there."

    def __init__(self) -> None:
        self.shares, self.turn, self.before = [0.0] * 6, [0.0] * 6, [0.0] * 6

    def share(self, angle: float) -> float:
        """Return by which share the friction at the handle's `angle` is greater than its mean over a turn."""
        share = 0.0
        for k in HARMONICS:
            share += self.shares[2 * k - 2] * math.cos(k * angle) + self.shares[2 * k - 1] * math.sin(k * angle)
        return share

    def update(self, angle: float, rate_mm_s: float, model_N: float, reading_N: float, anchor: Anchor) -> None:
        """Take a mean of readings at the handle's `angle`, the known ripple taken off."""
        step_rad = angle - self.at_rad
        if abs(step_rad) < STEP_RAD:
            return
        force_N, before_N = max(anchor.force_N(model_N), LEAST_N), max(anchor.force_N(self.model_N), LEAST_N)
        change = math.copysign(1.0, step_rad) * (reading_N / force_N - self.reading_N / before_N)
        is_steady = abs(step_rad) <= 3.0 * STEP_RAD and abs(rate_mm_s - self.rate_mm_s) <= STEADY_MM_S
        if not is_steady or max(abs(change), abs(before_N / force_N - 1.0)) > STEEPEST:
            self.turn, self.left_rad, self.rate_mm_s = [0.0] * 6, 2.0 * math.pi + SETTLES_RAD, rate_mm_s
        elif self.left_rad <= 2.0 * math.pi:
            for k in HARMONICS:
                self.turn[2 * k - 2] -= change / (math.pi * k) * math.sin(k * (angle - 0.5 * step_rad))
                self.turn[2 * k - 1] += change / (math.pi * k) * math.cos(k * (angle - 0.5 * step_rad))
        self.at_rad, self.model_N, self.reading_N = angle, model_N, reading_N
        self.left_rad -= abs(step_rad)
        if self.left_rad <= 0.0:
            self._learn()

    def _learn(self) -> None:
        """Learn the waves in which the turn agrees with the turn before, and begin another."""
        for at in (0, 2, 4):
            wave, before = self.turn[at : at + 2], self.before[at : at + 2]
            if math.hypot(*wave) > max(QUIET, math.dist(wave, before) / AGREES):
                self.shares[at] += 0.5 * (wave[0] + before[0])
                self.shares[at + 1] += 0.5 * (wave[1] + before[1])
                self.turn[at], self.turn[at + 1] = 0.0, 0.0
        self.before, self.turn, self.left_rad = self.turn, [0.0] * 6, 2.0 * math.pi
