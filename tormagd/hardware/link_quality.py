"""How well the wire has carried messages in the last second: figures that warn before a slow loop swings.

Every measurement carries a `LinkQuality`: so a step decides on its inputs alone, and a replay decides the same.
"""

from collections import deque
from typing import ClassVar, Final, final

from firmware_protocol.value import Value

LOOKED_S: Final = 0.1
LOOKS: Final = 10
SETTLING_LOOKS: Final = 3
"The first looks of a conversation do not count: the answers to the last Drives are still on their way."
LOSES: Final = 0.02
"A wire that loses or damages a greater share is lossy: a sound serial cable or CAN bus loses none."


@final
class LinkQuality(Value):
    def __init__(
        self,
        unanswered: float = 0.0,
        damaged: float = 0.0,
        unsent: float = 0.0,
        round_trip_s: float = 0.0,
        clock_drift: float = 0.0,
    ) -> None:
        self.unanswered: Final = unanswered
        self.damaged: Final = damaged
        self.unsent: Final = unsent
        self.round_trip_s: Final = round_trip_s
        self.clock_drift: Final = clock_drift

    @property
    def lost(self) -> float:
        return max(self.unanswered, self.unsent)

    @property
    def is_lossy(self) -> bool:
        return self.lost > LOSES or self.damaged > LOSES

    def __str__(self) -> str:
        return (
            f"{self.unanswered:.1%} of the Drives were not answered, {self.damaged:.1%} of the frames came damaged, "
            f"{self.unsent:.1%} were not taken by the wire, the round trip is {self.round_trip_s * 1e3:.1f} ms"
        )


UNKNOWN_QUALITY: Final = LinkQuality()


@final
class Counts(Value):
    def __init__(self, drives: int = 0, states: int = 0, frames: int = 0, damaged: int = 0, unsent: int = 0) -> None:
        self.drives: Final = drives
        self.states: Final = states
        self.frames: Final = frames
        self.damaged: Final = damaged
        self.unsent: Final = unsent


@final
class LinkWatch:
    __match_args__: ClassVar = ("_counts", "_due_s", "_round_trip_s")

    def __init__(self, now_s: float) -> None:
        self._due_s = now_s + SETTLING_LOOKS * LOOKED_S
        self._counts: deque[Counts] = deque(maxlen=LOOKS + 1)
        self._round_trip_s = 0.0

    def is_due(self, now_s: float) -> bool:
        return now_s >= self._due_s

    def look(self, now_s: float, counts: Counts, round_trip_s: float, clock_drift: float) -> LinkQuality:
        """Return the quality over the last LOOKS looks, and set when the next is due."""
        self._due_s = now_s + LOOKED_S
        self._counts.append(counts)
        before = self._counts[0]
        # at 4 kHz one pause fills the window of the usual round trip; by the next look it has left
        least_s, self._round_trip_s = min(self._round_trip_s, round_trip_s), round_trip_s
        return LinkQuality(
            1.0 - _share(counts.states - before.states, counts.drives - before.drives, of_none=1.0),
            _share(
                counts.damaged - before.damaged,
                counts.frames + counts.damaged - before.frames - before.damaged,
            ),
            _share(counts.unsent - before.unsent, counts.drives - before.drives),
            least_s,
            clock_drift,
        )


def _share(part: int, whole: int, of_none: float = 0.0) -> float:
    return min(part / whole, 1.0) if whole > 0 else of_none
