"""How well the force is followed: the RMS of measured less asked force, with and without the delay that explains most.

Only ticks at which the force could be followed count: ENABLED, a setpoint that the device can give, and a handle that
slides. The way to the first force does not count, nor does the decay after the last.
"""

import math
from collections import deque
from typing import Final

from tormagd.daemon.verdict import HOLDING
from tormagd.safety.codes import Limit
from tormagd.safety.operating_state import OperatingState
from tormagd_client.messages import MAX_DISPLACEMENT_MM, FollowingReport, TickRecord

MOST_DELAY_S: Final = 0.4
"Greatest delay that is taken out: the budget of the whole way."
FORGETS_S: Final = 5.0
"After this time an error counts a third (1/e)."
LEAST_S: Final = 1.0
"No figure is told of fewer ticks than fill this time: some seconds after the last one that counted there is none."
SLIDES_MM_S: Final = 1.0
SLID_MM: Final = MAX_DISPLACEMENT_MM
"A slower handle sticks, and one that has turned feels all of the brake's force only so much further."
NOT_FOLLOWED: Final = HOLDING | {Limit.TAKEOVER}


class Following:
    """Measures how well the force is followed: RMS error, and the delay that explains most of it.

    Takes ticks `period_s` apart. Keeps the forces asked for in the last MOST_DELAY_S, and a sum of squared errors for
    each delay.
    """

    def __init__(self, period_s: float, tolerance_N: float) -> None:
        """Begin without figures. `tolerance_N` is the scene's RMS tolerance.

        Errors count only after the measured force has first come this near to what was asked.
        """
        self._period_s, self._tolerance_N = period_s, tolerance_N
        self._kept = math.exp(-period_s / FORGETS_S)
        count = round(MOST_DELAY_S / period_s) + 1
        self._asked_N: deque[float] = deque(maxlen=count)
        self._squares, self._weight = [0.0] * count, 0.0
        self._has_arrived = False
        self._rate_mm_s = self._turned_mm = 0.0

    def look(self, tick: TickRecord) -> None:
        """Take one tick, and add its squared error for each delay where it counts.

        It counts ENABLED, with a sliding handle, a measured force, and no limit of NOT_FOLLOWED. It does so after
        MOST_DELAY_S of setpoints, from the first force within the tolerance on. Sums fade by a factor e in FORGETS_S.
        Out of ENABLED or without a setpoint, arrival and setpoints are forgotten.
        """
        asked_N, measured_N, kept = tick.setpoint_cf, tick.measured_cf, self._kept
        self._weight *= kept
        self._squares = [kept * known for known in self._squares]
        if tick.operating_state != OperatingState.ENABLED or asked_N is None:
            self._asked_N.clear()
            self._has_arrived = False
            return
        self._asked_N.appendleft(asked_N)
        slides = self._slides(tick.handle_rate_mm_s, tick.handle_mm)
        if not slides or measured_N is None or not NOT_FOLLOWED.isdisjoint(tick.plan_limits):
            return
        self._has_arrived = self._has_arrived or abs(measured_N - asked_N) <= self._tolerance_N
        if not self._has_arrived:
            self._asked_N.clear()
        elif len(self._asked_N) == len(self._squares):
            self._weight += 1.0
            self._squares = [
                known + (measured_N - then_N) ** 2 for known, then_N in zip(self._squares, self._asked_N, strict=True)
            ]

    def _slides(self, rate_mm_s: float | None, place_mm: float | None) -> bool:
        """Tell whether the handle has slid SLID_MM since it last turned or was slower than about SLIDES_MM_S.

        True for a handle that is not measured. Remembers where it turned.
        """
        if rate_mm_s is None or place_mm is None:
            return True
        if rate_mm_s * self._rate_mm_s < SLIDES_MM_S**2:
            self._turned_mm = place_mm
        self._rate_mm_s = rate_mm_s
        return abs(place_mm - self._turned_mm) >= SLID_MM

    def report(self) -> FollowingReport | None:
        """Return the RMS error, N, the RMS error with the best delay taken out, N, and that delay, ms.

        None where fewer ticks count than fill LEAST_S: at first, and some seconds after the last one that counted.
        """
        if self._weight * self._period_s < LEAST_S:
            return None
        least = min(self._squares)
        return FollowingReport(
            rms_N=round(math.sqrt(self._squares[0] / self._weight), 4),
            aligned_rms_N=round(math.sqrt(least / self._weight), 4),
            delay_ms=round(1e3 * self._period_s * self._squares.index(least), 1),
        )
