"""How well the force is followed: the RMS of measured less asked force, with and without the best-fitting delay.

Only ticks at which the force could be followed count: ENABLED, a setpoint that the device can give, and a handle that
slides. The way to the first force does not count, nor does the decay after the last.
"""

import math
from collections import deque
from collections.abc import Collection
from typing import Final

from tormagd_client.messages import MAX_DISPLACEMENT_MM, FollowingReport

PERIOD_S: Final = 0.02
MAX_DELAY_S: Final = 0.4
"Greatest delay that is taken out: the budget from sensor to force."
NEAR_N: Final = 0.1
"The first force counts as reached this close to it."
MIN_S: Final = 1.0
"Looks over a shorter time give no figure."
SLIDES_MM_S: Final = 1.0
SLID_MM: Final = MAX_DISPLACEMENT_MM
"A handle feels all of the brake's force only this far after a turn or a stop."
NOT_FOLLOWED: Final = frozenset({"RANGE", "STANDBY", "F_MIN", "F_MAX", "TAKEOVER"})
"Under these limits another force is rendered than was asked."


class Following:
    def __init__(self, period_s: float = PERIOD_S, forgets_s: float = math.inf) -> None:
        self._period_s = period_s
        self._kept = math.exp(-period_s / forgets_s)
        count = round(MAX_DELAY_S / period_s) + 1
        self._asked_N: deque[float] = deque(maxlen=count)
        self._squares, self._weight = [0.0] * count, 0.0
        self._has_arrived = False
        self._rate_mm_s = self._turned_mm = 0.0

    @property
    def counted_s(self) -> float:
        return self._weight * self._period_s

    def look(
        self,
        state: str | None,
        limits: Collection[str],
        asked_N: float | None,
        measured_N: float | None,
        handle_mm: float | None,
        rate_mm_s: float | None,
    ) -> None:
        """Look once, and add the error for each delay."""
        if self._kept < 1.0:
            self._weight *= self._kept
            self._squares = [self._kept * known for known in self._squares]
        if state not in ("ENABLED", None) or asked_N is None:
            self.begin()
            return
        self._asked_N.appendleft(asked_N)
        slides = self._slides(rate_mm_s, handle_mm)
        if not slides or measured_N is None or not NOT_FOLLOWED.isdisjoint(limits):
            return
        self._has_arrived = self._has_arrived or abs(measured_N - asked_N) <= NEAR_N
        if not self._has_arrived:
            self._asked_N.clear()
        elif len(self._asked_N) == len(self._squares):
            self._weight += 1.0
            self._squares = [
                known + (measured_N - then_N) ** 2 for known, then_N in zip(self._squares, self._asked_N, strict=True)
            ]

    def begin(self) -> None:
        """Forget what was asked: the next force is a first force again."""
        self._asked_N.clear()
        self._has_arrived = False

    def _slides(self, rate_mm_s: float | None, place_mm: float | None) -> bool:
        """Whether the handle has slid SLID_MM since it last turned or stuck."""
        if rate_mm_s is None or place_mm is None:
            return True
        if rate_mm_s * self._rate_mm_s < SLIDES_MM_S**2:
            self._turned_mm = place_mm
        self._rate_mm_s = rate_mm_s
        return abs(place_mm - self._turned_mm) >= SLID_MM

    def report(self) -> FollowingReport | None:
        """Return the RMS error, the RMS error with the best delay taken out, and that delay."""
        if self.counted_s < MIN_S:
            return None
        least = min(self._squares)
        return FollowingReport(
            rms_N=round(math.sqrt(self._squares[0] / self._weight), 4),
            aligned_rms_N=round(math.sqrt(least / self._weight), 4),
            delay_ms=round(1e3 * self._period_s * self._squares.index(least), 1),
        )


def in_words(known: FollowingReport | None) -> str:
    """Say how well the force was followed; empty for None."""
    if known is None:
        return ""
    aligned = f"{known.aligned_rms_N * 1e3:.0f} mN with a delay of {known.delay_ms:.0f} ms taken out"
    return f"to {known.rms_N * 1e3:.0f} mN RMS, {aligned if known.delay_ms else 'without a delay'}"
