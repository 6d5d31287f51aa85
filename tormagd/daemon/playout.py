"""The playout buffer: holds setpoints back until a stated time after their stamps, so that their way's jitter goes.

No I/O and no clock: times are arguments.
"""

from collections import deque
from typing import NamedTuple

from tormagd.control.records import TimedSetpoint
from tormagd.daemon.rate_group import Histogram
from tormagd.daemon.source_clock import JITTER_SHARE
from tormagd_client.messages import PlayoutReport

MAX_WAITING = 1_024
"Setpoints that wait at most, the newest: what one publisher may send in the longest playout."


class Taken(NamedTuple):
    """A setpoint that was taken, with its source and its `seq`."""

    setpoint: TimedSetpoint
    source: str
    seq: int

    @property
    def due_s(self) -> float:
        return self.setpoint.stamp_s + self.setpoint.playout_s


class Playout:
    """Holds back the setpoints that were taken until they are due; the newest that is due is in force."""

    def __init__(self) -> None:
        self.held = Histogram()
        "How long setpoints waited here."
        self.in_force: Taken | None = None
        "The setpoint to follow; None before the first."
        self._waiting: deque[Taken] = deque(maxlen=MAX_WAITING)
        self._setpoints = self._late = 0
        self._held_s = self._jitter_s = 0.0

    def forget(self) -> None:
        """Forget all setpoints; the counts stay."""
        self.in_force = None
        self._waiting.clear()

    @property
    def newest(self) -> Taken | None:
        return self._waiting[-1] if self._waiting else self.in_force

    def update(self, now_s: float, taken: Taken | None = None) -> bool:
        """Take a setpoint, if there is one, and put the newest that is due in force; return True where `in_force`
        changed."""
        if taken is not None:
            self._count(now_s, taken)
            while self._waiting and self._waiting[-1].due_s >= taken.due_s:
                self._waiting.pop()
            self._waiting.append(taken)
        before = self.in_force
        while self._waiting and self._waiting[0].due_s <= now_s:
            self.in_force = self._waiting.popleft()
        return self.in_force is not before

    def report(self, playout_ms: float) -> PlayoutReport | None:
        """Return the delay that is added, the jitter that is taken out, and counts; None where `playout_ms` is 0."""
        if playout_ms == 0.0:
            return None
        return PlayoutReport(
            playout_ms=playout_ms,
            held_us=self.held.report,
            jitter_us=round(self._jitter_s * 1e6, 1),
            setpoints=self._setpoints,
            late=self._late,
        )

    def _count(self, now_s: float, taken: Taken) -> None:
        """Count a setpoint that is to be held, for how long, and by how much that differs from the one before."""
        if taken.setpoint.playout_s == 0.0:
            return
        held_s = max(taken.due_s - now_s, 0.0)
        self.held.add(now_s, held_s * 1e6)
        if self._setpoints:
            self._jitter_s += JITTER_SHARE * (abs(held_s - self._held_s) - self._jitter_s)
        self._held_s = held_s
        self._setpoints += 1
        self._late += taken.due_s < now_s
