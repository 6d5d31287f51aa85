"""Whether the loop sees the device: not while the device is silent, and not right after a stall of the loop.

A State is sent only in answer to a Drive. After a stall, the State that waits is therefore as old as the stall. Only
the answer to the next Drive tells what the device does now.
"""

import math
from typing import Final, final

BLIND_S: Final = 0.005
BLIND_PERIODS: Final = 5.0
"Without a new State for longer than both, the carriages' places are too uncertain to drive them."
UNSENSED_S: Final = 0.02
"Without a new Sense for longer than both, force and handle are not measured."
SHOWN_S: Final = 0.1


@final
class Sight:
    """Whether the loop is blind, told from the times of steps and of new States."""

    seen_s: float = math.inf
    "inf before the first State."
    stalled_s: float
    stall_s: float = 0.0
    "Length of the last stall, or of the longest within SHOWN_S of each other."
    is_blind: bool = False
    was_blind: bool = False

    def __init__(self, period_s: float) -> None:
        self.stalled_s = -math.inf
        self._blind_s: Final = max(BLIND_S, BLIND_PERIODS * period_s)

    def has_stalled(self, now_s: float) -> bool:
        return now_s - self.stalled_s < SHOWN_S

    def is_waiting(self, now_s: float) -> bool:
        """Tell whether the answer to the first Drive after a stall may still be on its way."""
        return self.is_blind and now_s - self.stalled_s < 2.0 * self._blind_s

    def update(self, last_s: float, now_s: float, is_new: bool) -> None:
        stall_s, self.was_blind = now_s - last_s, self.is_blind
        if stall_s > self._blind_s:
            before_s = self.stall_s if self.has_stalled(now_s) else 0.0
            self.seen_s, self.stalled_s, self.stall_s, self.is_blind = now_s, now_s, max(stall_s, before_s), True
        elif is_new:
            self.seen_s, self.is_blind = now_s, False
        elif now_s - self.seen_s > self._blind_s:
            self.is_blind = True


def unsensed_s(period_s: float) -> float:
    return max(UNSENSED_S, BLIND_PERIODS * period_s)
