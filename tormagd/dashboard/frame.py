"""What the page shows of one moment, live or recorded: the seconds before it, and what holds the force back."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import msgspec

from tormagd.recording.overview import LATE_US
from tormagd_client.messages import BeliefReport

SHOWN_S = 20.0
DRIVEN = ("ENABLED", "PAUSED")
"In other states the gap opens or is open, and the planned field stands nowhere."


class Held(msgspec.Struct, frozen=True):
    """A limit: in which share of the seconds shown it was there, and whether it is there at their end."""

    code: str
    share: float
    is_now: bool


class Frame(msgspec.Struct, frozen=True, kw_only=True):
    """Curves of the same length, the oldest first, `t_s` since 1970; what is not known is null.

    Live ones hold what is new, and the codes and `late_counts` (control ticks by lateness, between LATE_US) of all the
    seconds shown. `belief` is that of their end.
    """

    t_s: Sequence[float]
    asked_N: Sequence[float | None]
    governed_N: Sequence[float | None]
    measured_N: Sequence[float | None]
    gap_mm: Sequence[float | None]
    gap_wanted_mm: Sequence[float | None]
    field_mT: Sequence[float | None]
    operating_state: str
    held: Sequence[Held]
    faults: Sequence[str]
    belief: Mapping[str, BeliefReport]
    late_counts: Sequence[int]


def late_counts(lateness_us: Iterable[float]) -> list[int]:
    """How many of these are in each bar of the histogram."""
    counts = Counter(bisect_right(LATE_US, late_us) for late_us in lateness_us)
    return [counts[bar] for bar in range(len(LATE_US) + 1)]
