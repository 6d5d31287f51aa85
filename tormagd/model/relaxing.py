"""What an elastomer remembers, for a model that knows how it relaxes: the daemon's side of the relaxation-aware model.

The network gives F0, the force without memory. What of it is there without field and what the field adds relax each by
fractions of their own (`tormagd.physics.relaxation`). A field that changes now changes F0 alone, so the memory is a
shift, the same for every field: the force is F0 less what has relaxed away, and any search finds the field for F0.
"""

from typing import Final, final

from firmware_protocol.value import Value
from tormagd.physics.relaxation import PronySeries, PronyState


@final
class Relaxed(Value):
    """The branches of both parts as of `time_s`, N, and what has relaxed away of the force by then, N."""

    __match_args__ = ("time_s", "free", "added", "lost_N")
    __slots__ = __match_args__

    def __init__(self, time_s: float, free: PronyState, added: PronyState, lost_N: float = 0.0) -> None:
        self.time_s: Final = time_s
        self.free: Final = free
        self.added: Final = added
        self.lost_N: Final = lost_N


@final
class Relaxing:
    """How one elastomer relaxes: the force it has without field, and what the field adds."""

    __slots__ = ("_added", "_free")

    def __init__(self, free: PronySeries, added: PronySeries) -> None:
        self._free: Final = free
        self._added: Final = added

    def rested(self, time_s: float) -> Relaxed:
        """Of an elastomer that has rested for long without load."""
        return Relaxed(time_s, self._free.relaxed(0.0), self._added.relaxed(0.0))

    def advance(self, before: Relaxed, now_s: float, free_N: float, added_N: float) -> Relaxed:
        """At `now_s`, when F0 is `free_N` without field and the field adds `added_N`; both went there evenly."""
        dt_s = max(now_s - before.time_s, 0.0)
        relaxed_N, free = self._free.discretise(dt_s).advance(before.free, free_N)
        field_N, added = self._added.discretise(dt_s).advance(before.added, added_N)
        return Relaxed(now_s, free, added, free_N + added_N - relaxed_N - field_N)


NOTHING_RELAXED: Final = Relaxed(0.0, (), ())
"Of a model that knows of no relaxation."
