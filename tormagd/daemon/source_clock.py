"""A publisher's clock offset, and the delay of its messages, from stamps and arrivals alone.

The lateness of a message, our time less its stamp, is the clock's offset plus the time on the way. Three facts part
them. No message arrives before it was sent, those of one publisher do not overtake each other, and clocks drift slowly.
So the least lateness is an envelope: the offset plus the constant part of the way. Lateness above it is delay; what
moves it is the clock. Without a round trip, a constant offset and a constant way cannot be told apart: up to MAX_WAY_S
counts as the way.

No I/O and no clock: times are arguments.
"""

import math
from typing import final

from tormagd.hardware.link_statistics import DeviceClock

MAX_WAY_S = 0.2
"""A least lateness up to this is taken for the way: half of what the whole way from sensor to force may take."""
MAX_LATE_S = 1.0
"""A least lateness between the two may be either: the clock is corrected by it, and the limits of sources count it as
the way."""
AHEAD_S = 0.05
"A stamp may be this far ahead before its clock has shown itself; a clock that is further off than this is wrong."
SETTLED_S = 0.2
"A new publisher's clock is believed to be wrong once its stamps have said so for this long: a backlog is drained."
STEP_S = 0.005
"Stamps of one publisher that run back by more than this prove that its clock was set back."
DRIFT = 500e-6
"No clock drifts faster, and no faster rise of the envelope is taken for drift."
FORGOTTEN_S = 5.0
"After a longer silence the clock may have been set by any amount."
JITTER_SHARE = 1.0 / 16.0
"Of each new difference, as in RFC 3550."


@final
class SourceClock:
    """Estimates one publisher's clock offset and the delay of its messages, from stamps and arrivals."""

    def __init__(self) -> None:
        self.offset_s = 0.0
        "How far the clock is behind ours, s, as far as it can be told."
        self.way_s = 0.0
        "The constant part of the way, as far as it can be told."
        self.jitter_s = 0.0
        "How much the delay varies from message to message: RFC 3550's interarrival jitter."
        self.steps = 0
        "How often the clock was seen to be set."
        self.stepped_s = 0.0
        "By how much the clock was set last, forward positive."
        self.stepped_at_s = -math.inf
        "When the clock was last seen to be set; -inf before."
        self._lateness_s = self._leaked_s = 0.0
        self._heard_s: float | None = None
        self._settles_s: float | None = None
        self.line = DeviceClock()
        "The line through the last half minute, or since the clock was set."

    @property
    def is_settled(self) -> bool:
        return self._settles_s is None

    @property
    def is_wrong(self) -> bool:
        return self.is_settled and not -AHEAD_S <= self.offset_s <= AHEAD_S

    @property
    def hidden_s(self) -> float:
        return self.offset_s if 0.0 < self.offset_s < MAX_LATE_S and not self.steps else 0.0

    def hear(self, now_s: float, lateness_s: float, *, is_continued: bool = True) -> float:
        """Take the message that came at `now_s`, and return its delay, s."""
        if self._heard_s is None:
            self._begin(now_s, lateness_s)
        else:
            self._follow(now_s, lateness_s, now_s - self._heard_s, is_continued)
        self._heard_s, self._lateness_s = now_s, lateness_s
        self.line.add(now_s, now_s - lateness_s)
        if self._settles_s is not None:
            if now_s < self._settles_s:
                return lateness_s
            self._settle()
        return max(lateness_s - self.offset_s, 0.0)

    def _begin(self, now_s: float, lateness_s: float) -> None:
        """Begin with nothing known but this lateness, and a new line; the counts of steps stay."""
        self.offset_s, self.way_s, self._leaked_s, self.jitter_s = lateness_s, 0.0, 0.0, 0.0
        self._settles_s = now_s + SETTLED_S
        self.line = DeviceClock()
        if -AHEAD_S <= lateness_s <= MAX_WAY_S:
            self._settle()

    def _settle(self) -> None:
        """Count the offset as known; one that a way can take becomes the constant part of the way."""
        self._settles_s = None
        if 0.0 < self.offset_s <= MAX_WAY_S:
            self.offset_s, self.way_s = 0.0, self.offset_s

    def _follow(self, now_s: float, lateness_s: float, gap_s: float, is_continued: bool) -> None:
        """Update offset, way and jitter from a message that came `gap_s` after the last, both on our clock."""
        rise_s = lateness_s - self._lateness_s
        if not is_continued or gap_s > FORGOTTEN_S:
            above_s = lateness_s - self.offset_s - self.way_s
            if not -STEP_S <= above_s <= MAX_WAY_S:
                self._begin(now_s, lateness_s)
                return
        elif rise_s > gap_s + STEP_S:
            # sent later but stamped earlier, which no delay explains. The way is taken to be as before
            self.offset_s += rise_s
            self._set(now_s, -rise_s)
        else:
            self.jitter_s += JITTER_SHARE * (abs(rise_s) - self.jitter_s)
            leak_s = DRIFT * gap_s
            self.offset_s += leak_s
            self._leaked_s += leak_s
        fall_s = self.offset_s + self.way_s - lateness_s
        if fall_s >= 0.0:
            self._fall(now_s, fall_s)

    def _fall(self, now_s: float, fall_s: float) -> None:
        """Lower offset and way by `fall_s`, not negative: the message was less late than both of them together."""
        granted_s = min(fall_s, self._leaked_s)
        self.offset_s -= granted_s
        self._leaked_s -= granted_s
        shorter_s = min(fall_s - granted_s, self.way_s)
        self.way_s -= shorter_s
        ahead_s = fall_s - granted_s - shorter_s
        was_hidden = self.hidden_s > 0.0
        self.offset_s -= ahead_s
        if ahead_s > STEP_S and self.is_settled and not (was_hidden and self.hidden_s > 0.0):
            self._set(now_s, ahead_s)

    def _set(self, now_s: float, by_s: float) -> None:
        """Count that the clock was set by `by_s`, forward positive, and begin its line anew."""
        self.steps += 1
        self.stepped_s, self.stepped_at_s = by_s, now_s
        self.line = DeviceClock()
