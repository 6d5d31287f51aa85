"""What the page shows at one moment, live or recorded: the last seconds, and what holds the force back."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import msgspec

from tormagd.record.overview import LATE_US

SHOWN_S = 20.0
DRIVEN = ("ENABLED", "PAUSED")
"The planned field exists in these states; in others the gap opens or is open."


class Held(msgspec.Struct, frozen=True):
    """A limit: its share of the seconds shown, and whether it holds at their end."""

    code: str
    share: float
    is_now: bool


class Frame(msgspec.Struct, frozen=True, kw_only=True):
    """One update: curves of equal length, the oldest first. `t_s` is since 1970; None is not known."""

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
    believed: Mapping[str, str]
    late_counts: Sequence[int]


def late_counts(lateness_us: Iterable[float]) -> list[int]:
    """Count latenesses by bar of the histogram that LATE_US bounds."""
    counts = Counter(bisect_right(LATE_US, late_us) for late_us in lateness_us)
    return [counts[bar] for bar in range(len(LATE_US) + 1)]
