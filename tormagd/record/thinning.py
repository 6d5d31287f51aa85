"""Fewer ticks where nothing happens: all around a fault or a mark, one of every N elsewhere."""

from collections import deque
from typing import Any, NamedTuple

AROUND_S = 10.0
AROUND_NS = round(AROUND_S * 1e9)


class Shown(NamedTuple):
    """A message of a recording: topic, time in ns since 1970, number within the topic and file."""

    topic: str
    t_ns: int
    sequence: int
    message: Any


class Thinning:
    """Keeps one tick of `every`, and all within AROUND_S of a fault or a mark."""

    def __init__(self, every: int) -> None:
        self.every = every
        self._waiting: deque[Shown] = deque()
        self._count = 0
        self._full_to_ns = 0
        self._faults: Any = ()

    def happened(self, t_ns: int) -> None:
        self._full_to_ns = max(self._full_to_ns, t_ns + AROUND_NS)

    def take(self, tick: Shown) -> list[Shown]:
        """Add a tick, and return the ticks to be written now, often none."""
        if self.every == 1:
            return [tick]
        t_ns, faults = tick.t_ns, tick.message.get("faults", ())
        if faults != self._faults and faults:
            self.happened(t_ns)
        self._faults = faults
        self._waiting.append(tick)
        if t_ns <= self._full_to_ns:
            return self.rest(1)
        given = []
        while self._waiting and self._waiting[0].t_ns < t_ns - AROUND_NS:
            given += self._thinned(self._waiting.popleft(), self.every)
        return given

    def rest(self, every: int) -> list[Shown]:
        """Return one of `every` waiting ticks, and forget them all."""
        given = [kept for tick in self._waiting for kept in self._thinned(tick, every)]
        self._waiting.clear()
        return given

    def _thinned(self, tick: Shown, every: int) -> list[Shown]:
        self._count += 1
        return [] if self._count % every else [tick]
