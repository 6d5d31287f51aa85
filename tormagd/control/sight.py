"""Whether the loop sees the device: not while the device is silent, and not right after a stall of its own.

States only answer Drives. So whatever a process finds that has just been stopped is as old as its stall, and what the
device does now is not known before it has answered the next Drive. Pure functions.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value

BLIND_S: Final = 0.005
BLIND_PERIODS: Final = 5.0
"""Without a new state for longer than both, where the carriages are is not known well enough to drive them. The answer
to the first Drive after a stall may take twice as long: a wire that needs more is slow for a loop."""
UNSENSED_S: Final = 0.02
"Without a new Sense for longer than this and BLIND_PERIODS, force and handle are not measured."
SHOWN_S: Final = 0.1
"A stall is shown for this long after it, or nobody would see it: telemetry comes every 20 ms."


@final
class Sight(Value):
    """What is remembered of it. `seen_s` is when a new state was last found, `stalled_s` when a stall last ended."""

    def __init__(
        self, seen_s: float = math.inf, stalled_s: float = -math.inf, stall_s: float = 0.0, is_blind: bool = False
    ) -> None:
        self.seen_s: Final = seen_s
        self.stalled_s: Final = stalled_s
        self.stall_s: Final = stall_s
        "How long that stall was, or the longest of those that came within SHOWN_S of each other."
        self.is_blind: Final = is_blind

    def has_stalled(self, now_s: float) -> bool:
        """Whether a stall ended not long ago."""
        return now_s - self.stalled_s < SHOWN_S

    def is_waiting(self, now_s: float, period_s: float) -> bool:
        """Whether the answer to the first Drive after a stall may still be on its way."""
        return self.is_blind and now_s - self.stalled_s < 2.0 * _blind_s(period_s)


UNSEEING: Final = Sight()
"Before the first step."


def look(sight: Sight, last_s: float, now_s: float, period_s: float, is_new: bool) -> Sight:
    """The sight of a step at `now_s` after one at `last_s`; `is_new`: it was given a state that the other was not."""
    stall_s, blind_s = now_s - last_s, _blind_s(period_s)
    if stall_s > blind_s:
        before_s = sight.stall_s if sight.has_stalled(now_s) else 0.0
        return Sight(now_s, now_s, max(stall_s, before_s), is_blind=True)
    if is_new:
        return Sight(now_s, sight.stalled_s, sight.stall_s)
    if sight.is_blind or now_s - sight.seen_s <= blind_s:
        return sight
    return Sight(sight.seen_s, sight.stalled_s, sight.stall_s, is_blind=True)


def unsensed_s(period_s: float) -> float:
    """How old a Sense may be: force and handle of an older one are not measured."""
    return max(UNSENSED_S, BLIND_PERIODS * period_s)


def _blind_s(period_s: float) -> float:
    return max(BLIND_S, BLIND_PERIODS * period_s)
