"""What the element remembers, followed from its measured gaps: what has relaxed, and how far its field lags behind.

The model gives the force without memory. What of it is there without field and what the field adds relax each by a
series of their own, along a way that is taken for straight between two plans. A field that changes now changes the
force without memory alone, so what has relaxed is a shift, the same for every field, and any search finds the field.
Both are expected of every device, so they are no part of what is learned of one: a step that a device was not seen to
make before is right as far as the model knows what the elastomer has been through.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.model.force_curve import ForceCurve, within
from tormagd.model.memory import Memory
from tormagd.physics.relaxation import PronyState


@final
class Remembered(Value):
    """The field of the newest gap, mT, and how far the element's own is behind it; the branches of the force without
    field and of what the field adds, N; how much of the force has relaxed, N; all at `time_s`, before which nothing is
    known but by how much the gap had been opened, mm, since the device was switched on."""

    def __init__(
        self,
        field_mT: float = 0.0,
        lag_mT: float = 0.0,
        free: PronyState = (),
        added: PronyState = (),
        relaxed_N: float = 0.0,
        time_s: float = -math.inf,
        opened_mm: float = 0.0,
    ) -> None:
        self.field_mT: Final = field_mT
        self.lag_mT: Final = lag_mT
        self.free: Final = free
        self.added: Final = added
        self.relaxed_N: Final = relaxed_N
        self.time_s: Final = time_s
        self.opened_mm: Final = opened_mm

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been followed yet."""
        return self.time_s == -math.inf


NOTHING_REMEMBERED: Final = Remembered()


@final
class Remembering:
    """The constants of an element's memory. Its methods change nothing. A `curve` is the force without memory of the
    element as it is touched now, which is asked for fields within `fields_mT`; `free_N` is its force without field."""

    def __init__(self, memory: Memory, fields_mT: tuple[float, float]) -> None:
        self._free: Final = memory.free
        self._added: Final = memory.added
        self._lag_mT: Final = memory.lag_mT
        self._turn_mT: Final = memory.turn_mT
        self._fields_mT: Final = fields_mT
        self._relaxes: Final = len(memory.fractions) > 0

    def unloaded(self, field_mT: float, now_s: float) -> Remembered:
        """At that field, after a long rest without load."""
        return Remembered(field_mT, 0.0, self._free.relaxed(0.0), self._added.relaxed(0.0), 0.0, now_s)

    def free_N(self, curve: ForceCurve) -> float:
        """The force without field."""
        return curve.force_N(within(0.0, self._fields_mT))

    def rested(self, curve: ForceCurve, free_N: float, field_mT: float, now_s: float) -> Remembered:
        """After a long rest at that field."""
        added_N = curve.force_N(within(field_mT, self._fields_mT)) - free_N
        rest = Remembered(field_mT, 0.0, self._free.relaxed(free_N), self._added.relaxed(added_N), 0.0, now_s)
        return self.followed(rest, curve, free_N, field_mT, now_s)

    def lag_at_mT(self, before: Remembered, field_mT: float) -> float:
        """How far the element's field is behind the gap's once that is `field_mT`, on a straight way from `before`; 0
        before anything is known."""
        if before.is_empty:
            return 0.0
        change_mT = field_mT - before.field_mT
        if change_mT == 0.0:
            return before.lag_mT
        side_mT = math.copysign(self._lag_mT, change_mT)
        return side_mT + (before.lag_mT - side_mT) * math.exp(-abs(change_mT) / self._turn_mT)

    def followed(
        self, before: Remembered, curve: ForceCurve, free_N: float, field_mT: float, now_s: float
    ) -> Remembered:
        """After `before`, at the field of a measured gap."""
        lag_mT = self.lag_at_mT(before, field_mT)
        if not self._relaxes:
            return Remembered(field_mT, lag_mT, before.free, before.added, 0.0, now_s)
        elapsed_s = max(now_s - before.time_s, 0.0)
        added_N = curve.force_N(within(field_mT - lag_mT, self._fields_mT)) - free_N
        step = self._free.discretise(elapsed_s)
        left_N, free = step.advance(before.free, free_N)
        left_of_added_N, added = step.of(self._added.fractions).advance(before.added, added_N)
        return Remembered(field_mT, lag_mT, free, added, free_N + added_N - left_N - left_of_added_N, now_s)
