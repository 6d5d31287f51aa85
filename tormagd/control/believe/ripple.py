"""How one device's friction varies over the angle of its handle: once, twice and three times a turn.

    factor   1 + sum of a_k cos k angle + b_k sin k angle            k = 1, 2, 3
    turn     a_k = -1/(pi k) sum of sin k angle de,  b_k = 1/(pi k) sum of cos k angle de    over one whole turn

e is a reading over what the device first showed. Only changes of e count: a force that falls all the while is no
ripple. Two turns that agree teach.
"""

import math
from typing import Final, final

from tormagd.control.believe.anchor import Anchor

HARMONICS: Final = (1, 2, 3)
QUIET: Final = 0.01
"A smaller share is no ripple: noise and relaxing leave as much."
AGREES: Final = 0.5
"Two turns agree where they differ by no more than this share."
MOST: Final = 0.15
"No shaft varies by a greater share."
LEAST_N: Final = 0.1
"Least force that a share is of."
LONGEST_RAD: Final = 0.3
"After a longer way without a reading a turn begins anew."


@final
class Ripple:
    """Estimator of the friction's share over the handle's angle. It keeps the turn that is being read, and the last."""

    shares: list[float]
    "a_1, b_1, a_2, b_2, a_3, b_3."
    turn: list[float]
    "The same of the turn that is being read."
    before: list[float]
    "The same of the last turn, less what it taught."
    is_known: bool
    "Whether any of `shares` has been learned."
    from_rad: float = 0.0
    "Where the turn began."
    at_rad: float
    "The angle of the newest reading; inf before the first of a turn."
    reading_N: float = 0.0
    "The newest reading."
    model_N: float = 0.0
    "The model's force at that reading."

    def __init__(self, radius_mm: float) -> None:
        self._radius_mm: Final = radius_mm
        self.forget()

    def forget(self) -> None:
        """Begin with a friction that does not vary."""
        self.shares, self.turn, self.before = [0.0] * 6, [0.0] * 6, [0.0] * 6
        self.at_rad, self.is_known = math.inf, False

    def share(self, handle_mm: float) -> float:
        """Return by which share the friction at the handle's place is greater than its mean over a turn."""
        angle, shares = handle_mm / self._radius_mm, self.shares
        if not self.is_known:
            return 0.0
        return sum(
            [shares[2 * k - 2] * math.cos(k * angle) + shares[2 * k - 1] * math.sin(k * angle) for k in HARMONICS]
        )

    def update(self, handle_mm: float, model_N: float, reading_N: float, anchor: Anchor) -> None:
        """Take the readings' mean, the known ripple taken off, beside what the device first showed, `anchor`."""
        angle = handle_mm / self._radius_mm
        step_rad, gone_rad = angle - self.at_rad, angle - self.from_rad
        if abs(step_rad) > LONGEST_RAD or step_rad * gone_rad < 0.0:
            self.turn, self.from_rad, gone_rad = [0.0] * 6, angle, 0.0
        else:
            force_N = anchor.force_N(model_N)
            changed_N = reading_N - self.reading_N - force_N + anchor.force_N(self.model_N)
            changed = math.copysign(changed_N, changed_N * gone_rad) / (math.pi * max(force_N, LEAST_N))
            for k in HARMONICS:
                self.turn[2 * k - 2] -= changed / k * math.sin(k * (angle - 0.5 * step_rad))
                self.turn[2 * k - 1] += changed / k * math.cos(k * (angle - 0.5 * step_rad))
        self.at_rad, self.reading_N, self.model_N = angle, reading_N, model_N
        if abs(gone_rad) >= 2.0 * math.pi:
            self._learn()

    def _learn(self) -> None:
        """Learn from a turn that is over what the turn before has shown, too, and begin another."""
        turn, before = self.turn, self.before
        for k in HARMONICS:
            a, b = 2 * k - 2, 2 * k - 1
            size = math.hypot(turn[a], turn[b])
            if size > QUIET and math.hypot(turn[a] - before[a], turn[b] - before[b]) < AGREES * size:
                self.shares[a] += 0.5 * (turn[a] + before[a])
                self.shares[b] += 0.5 * (turn[b] + before[b])
                turn[a], turn[b], self.is_known = 0.0, 0.0, True
        self.before, self.at_rad = turn, math.inf
