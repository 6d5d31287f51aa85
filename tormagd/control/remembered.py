"""What the element remembers of its gaps, followed from those measured: what has relaxed, and how far its field lags.

Both are expected of every device, so they are no part of what is learned of one: a step that a device was not seen to
make before is right as far as the model knows what the elastomer has been through.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.model.memory import Memory


@final
class Remembered(Value):
    """The field of the newest gap, mT, and how far the element's own is behind it; the force without memory behind a
    low-pass of each time, N; how much of the force has relaxed, N; all at `time_s`, before which nothing is known but
    by how much the gap had been opened, mm, since the device was switched on."""

    __match_args__ = ("field_mT", "lag_mT", "slow_N", "relaxed_N", "time_s", "opened_mm")
    __slots__ = __match_args__

    def __init__(
        self,
        field_mT: float = 0.0,
        lag_mT: float = 0.0,
        slow_N: tuple[float, ...] = (),
        relaxed_N: float = 0.0,
        time_s: float = -math.inf,
        opened_mm: float = 0.0,
    ) -> None:
        self.field_mT: Final = field_mT
        self.lag_mT: Final = lag_mT
        self.slow_N: Final = slow_N
        self.relaxed_N: Final = relaxed_N
        self.time_s: Final = time_s
        self.opened_mm: Final = opened_mm


NOTHING_REMEMBERED: Final = Remembered()


@final
class Remembering:
    """The constants of an element's memory; `relaxes` says whether a force is followed. Its methods change nothing."""

    __slots__ = ("_fractions", "_lag_mT", "_times_s", "_turn_mT", "relaxes")

    def __init__(self, memory: Memory) -> None:
        self._fractions: Final = list(memory.fractions)
        self._times_s: Final = list(memory.times_s)
        self._lag_mT: Final = memory.lag_mT
        self._turn_mT: Final = memory.turn_mT
        self.relaxes: Final = len(memory.fractions) > 0

    def rested(self, field_mT: float, force_N: float, now_s: float) -> Remembered:
        """After a long rest at that field, where the force without memory is `force_N`."""
        relaxed_N = 0.0
        for fraction in self._fractions:
            relaxed_N += fraction * force_N
        return Remembered(field_mT, 0.0, tuple([force_N for _ in self._fractions]), relaxed_N, now_s)

    def lag_at_mT(self, before: Remembered, field_mT: float) -> float:
        """How far the element's field is behind the gap's once that is `field_mT`, on a straight way from `before`; 0
        before anything is known."""
        if before.time_s == -math.inf:
            return 0.0
        change_mT = field_mT - before.field_mT
        if change_mT == 0.0:
            return before.lag_mT
        side_mT = math.copysign(self._lag_mT, change_mT)
        return side_mT + (before.lag_mT - side_mT) * math.exp(-abs(change_mT) / self._turn_mT)

    def followed(self, before: Remembered, field_mT: float, lag_mT: float, force_N: float, now_s: float) -> Remembered:
        """After `before`, at a field with that lag, where the force without memory is `force_N`."""
        elapsed_s = max(now_s - before.time_s, 0.0)
        slow, relaxed_N = [], 0.0
        for place, fraction in enumerate(self._fractions):
            slow_N = force_N + (before.slow_N[place] - force_N) * math.exp(-elapsed_s / self._times_s[place])
            slow.append(slow_N)
            relaxed_N += fraction * slow_N
        return Remembered(field_mT, lag_mT, tuple(slow), relaxed_N, now_s)
