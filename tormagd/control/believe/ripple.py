"""How one device's friction varies over the angle of its handle.

    share     a polygon over the angle: a corner amid each of PLACES; its mean over the places seen twice is 0
    slope     by how much the share rises from one place to the next
    update    a slope by what its two newest passes agree in

A pass compares the mean readings at two neighbouring places, the known ripple taken off, each as a share of what the
device first showed. A force that falls all the while rises on the way back, or falls alike at all places: it has no
slope. In a pass the rate stays. Places not yet seen close the turn.
"""

import math
from itertools import accumulate
from typing import Final, final

TURN: Final[float] = math.tau
"Compiled, a plain float."
QUIET: Final = 0.015
"A ripple that nowhere exceeds this is none: noise and relaxing leave as much."
PLACES: Final = 36
"Waves of up to three a turn are cut by 4 % at most."
STEEPEST: Final = 0.08
"Three waves of 15 % change no faster from place to place, nor does the gap."
HEARD: Final = 12
"Fewer readings at a place leave noise that looks like a ripple: three at 300 mm/s, ten at 100."
SETTLES: Final = 3
"After a change of rate or gap so many passes teach nothing."
STEADY_MM_S: Final = 8.0
"In a pass the handle's rate may change by so much: friction differs with the rate."


@final
class Ripple:
    """Estimator of the friction's share over the handle's angle."""

    place: int = 0
    total: float = 0.0
    "Sum of the readings there, over the anchor, the known ripple put on."
    readings: int = 0
    "How many they are."
    last: int = -1
    "The place before."
    mean: float = 0.0
    "The mean of the readings there."
    force_N: float = math.inf
    "The anchor's force as the handle left it."
    rate_mm_s: float = 0.0
    passes: int = -SETTLES
    "Passes in a row that taught; less than 0 while something settles."

    def __init__(self) -> None:
        self.shares = [0.0] * PLACES
        """At each place, as far as it is trusted."""
        self.slopes = [0.0] * PLACES
        self.before = [0.0] * PLACES
        """What the newest pass of each place had left to teach."""
        self.is_seen = [False] * PLACES
        """Whether it was passed twice."""

    def share(self, angle: float) -> float:
        """Return by which share the friction at the handle's `angle` is greater than its mean over a turn."""
        corner = angle * PLACES / TURN - 0.5
        at = math.floor(corner)
        here, there = self.shares[at % PLACES], self.shares[(at + 1) % PLACES]
        return here + (corner - at) * (there - here)

    def update(self, angle: float, rate_mm_s: float, force_N: float, reading_N: float) -> None:
        """Take a reading at the handle's `angle`, the known ripple taken off, beside the anchor's `force_N` > 0."""
        place = math.floor(angle * PLACES / TURN)
        if place != self.place:
            self._pass(rate_mm_s, force_N)
            self.place, self.total, self.readings = place, 0.0, 0
        self.total += reading_N / force_N * (1.0 + self.share(angle))
        self.readings += 1

    def _pass(self, rate_mm_s: float, force_N: float) -> None:
        """Compare the place that the handle leaves with the place before."""
        mean, way, at = self.total / max(self.readings, 1), self.place - self.last, min(self.place, self.last) % PLACES
        rose = mean - self.mean
        is_even = max(abs(rose), abs(self.force_N / force_N - 1.0)) <= STEEPEST
        is_steady = abs(way) == 1 and abs(rate_mm_s - self.rate_mm_s) <= STEADY_MM_S
        self.passes = self.passes + 1 if is_even and is_steady and self.readings >= HEARD else -SETTLES
        if self.passes > 0:
            self._learn(at, way * rose - self.slopes[at])
        self.last, self.mean, self.force_N, self.rate_mm_s = self.place, mean, force_N, rate_mm_s

    def _learn(self, at: int, rise: float) -> None:
        """Learn the slope at a place from what its passes agree in, and draw the shares anew."""
        before = self.before[at]
        agreed = math.copysign(min(abs(rise), abs(before)), rise) if rise * before > 0.0 else 0.0
        self.before[at] = rise - agreed
        self.slopes[at] += agreed
        self.is_seen[at] = self.is_seen[at] or before != 0.0
        unseen = self.is_seen.count(False)
        closing, places = sum(self.slopes) / (unseen or PLACES), list(zip(self.slopes, self.is_seen, strict=True))
        rises = [slope - (0.0 if unseen and is_seen else closing) for slope, is_seen in places]
        shares = [0.0, *accumulate(rises[:-1])]
        seen = [share for share, (_, is_seen) in zip(shares, places, strict=True) if is_seen]
        mean = sum(seen) / max(len(seen), 1)
        trust = 1.0 - (QUIET / max(QUIET, *[abs(share - mean) for share in shares])) ** 2
        self.shares = [trust * (share - mean) for share in shares]
