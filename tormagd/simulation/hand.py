"""The hand at the device: where the roller's surface is at a time, or how deep a finger is in the pad."""

import bisect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, final

from firmware_protocol.value import Value
from tormagd.force_file import TIME, ForceFileError, read_table

ROLLER_RADIUS_MM: Final = 20.0
DEFAULT_RPM: Final = 20.0
DEFAULT_PERIOD_S: Final = 4.0
REVERSING_TRAVEL_MM: Final = 30.0
DEFAULT_DEPTH_MM: Final = 2.0
PRESSES_AT_S: Final = 10.0
PRESSING_MM_S: Final = 1.0
RECORDED = {"t_s": TIME, "position_mm": (-1e6, 1e6, "mm")}
KNOWN = "steady[=RPM], reversing[=PERIOD_S], pressing[=DEPTH_MM], or a FILE.csv with the columns t_s,position_mm"


class HandError(ValueError):
    """A hand specification or recording that cannot be used."""


class Hand(Protocol):
    """A motion of the roller's surface, or of a finger."""

    def position_mm(self, time_s: float) -> float:
        """Travel of the roller surface since time 0, or the depth in the pad, mm."""


@final
class SteadyHand(Value):
    """Turns at a constant speed, 42 mm/s at the 20 rpm of the thesis's measurements."""

    def __init__(self, rpm: float = DEFAULT_RPM) -> None:
        self.rpm: Final = rpm

    def position_mm(self, time_s: float) -> float:
        return time_s * self.rpm / 60.0 * math.tau * ROLLER_RADIUS_MM


@final
class ReversingHand(Value):
    """Forth, rest, back, rest: smooth strokes of 30 mm (0.35 of the period each) with full stops (0.15 each)."""

    def __init__(self, period_s: float = DEFAULT_PERIOD_S) -> None:
        self.period_s: Final = period_s

    def position_mm(self, time_s: float) -> float:
        phase = math.fmod(time_s, self.period_s) / self.period_s
        half, back = (phase, False) if phase < 0.5 else (phase - 0.5, True)
        share = min(half / 0.35, 1.0)
        stroke = REVERSING_TRAVEL_MM * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        return REVERSING_TRAVEL_MM - stroke if back else stroke


@final
class PressingHand(Value):
    """The dummy finger of the thesis's pulse experiment: it touches the pad after 10 s, when the device is homed,
    presses in at 1 mm/s, and stays."""

    def __init__(self, depth_mm: float = DEFAULT_DEPTH_MM) -> None:
        self.depth_mm: Final = depth_mm

    def position_mm(self, time_s: float) -> float:
        return min(max(PRESSING_MM_S * (time_s - PRESSES_AT_S), 0.0), self.depth_mm)


@final
class RecordedHand(Value):
    """A recording, linear between its points and standing before the first and after the last."""

    def __init__(self, times_s: tuple[float, ...], positions_mm: tuple[float, ...]) -> None:
        self.times_s: Final = times_s
        self.positions_mm: Final = positions_mm

    def position_mm(self, time_s: float) -> float:
        after = bisect.bisect_right(self.times_s, time_s)
        if after == 0:
            return self.positions_mm[0]
        if after == len(self.times_s):
            return self.positions_mm[-1]
        start_s, end_s = self.times_s[after - 1], self.times_s[after]
        start_mm, end_mm = self.positions_mm[after - 1], self.positions_mm[after]
        return start_mm + (end_mm - start_mm) * (time_s - start_s) / (end_s - start_s)


_SIZED: dict[str, tuple[Callable[..., Hand], float, float]] = {
    "steady": (SteadyHand, -300.0, 300.0),
    "reversing": (ReversingHand, 0.1, 1000.0),
    "pressing": (PressingHand, 0.1, 6.0),
}
"By its name, a hand that has a size, and what that may be."


def parse_hand(spec: str) -> Hand:
    """The hand that a command-line word stands for. Raises HandError naming what is allowed."""
    name, _, value = spec.partition("=")
    if name in _SIZED:
        hand, low, high = _SIZED[name]
        return hand(_number(spec, value, low, high)) if value else hand()
    if spec.endswith(".csv"):
        return read_recording(Path(spec))
    raise HandError(f"hand {spec!r}: allowed are {KNOWN}")


def _number(spec: str, text: str, low: float, high: float) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise HandError(f"hand {spec!r}: allowed are numbers from {low:g} to {high:g}")
    return number


def read_recording(path: Path) -> RecordedHand:
    """Read a CSV with the columns t_s and position_mm. Raises HandError naming file and row."""
    try:
        table = read_table(path, RECORDED)
    except ForceFileError as error:
        raise HandError(str(error)) from error
    return RecordedHand(tuple(table["t_s"]), tuple(table["position_mm"]))
