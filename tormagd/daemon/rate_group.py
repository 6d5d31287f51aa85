"""How well one rate group keeps its time: rate, lateness, execution, overruns, merged ticks."""

import math
from typing import Final, NamedTuple, final

from msgspec.structs import asdict

from tormagd_client.messages import ExecReport, LatenessReport, RateReport

WARNING_PERIODS: Final = 1.0
"A run that is done later than this after it was due has overrun: the next one was due already."
ERROR_PERIODS: Final = 10.0
"This late it is a stall; at 1 kHz a fifth of the time after which the firmware opens the gap."
HORIZON_NS: Final = 5_000_000_000
"Percentiles cover the time since one to two of these ago."
SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
_EXACT: Final = 64  # bins of one microsecond each; beyond, 32 bins for each doubling: 3% resolution
_DOUBLINGS: Final = 20
_BINS: Final = _EXACT + 32 * _DOUBLINGS


@final
class Histogram:
    """Durations in microseconds, counted in bins. Adding costs a fraction of a microsecond, whatever has been added."""

    def __init__(self) -> None:
        self._now = [0] * _BINS
        self._before = [0] * _BINS
        self._most_now = self._most_before = 0.0
        self._turned_s = -math.inf

    def add(self, value_us: float) -> None:
        """Counts one duration; a negative one (a clock's grain) counts as 0."""
        self._now[_bin(value_us)] += 1
        if value_us > self._most_now:
            self._most_now = value_us

    def add_at(self, now_s: float, value_us: float) -> None:
        """Counts one duration, at `now_s`: what there is then is of the time since one to two horizons ago."""
        if now_s - self._turned_s > HORIZON_NS * 1e-9:
            self.turn()
            self._turned_s = now_s
        self.add(value_us)

    def turn(self) -> None:
        """Begins a new horizon and forgets the one before the last."""
        self._before, self._now = self._now, [0] * _BINS
        self._most_before, self._most_now = self._most_now, 0.0

    def summary(self) -> ExecReport:
        """p50, p99, p99.9 (upper edges of their bins) and the largest, us; all 0 while nothing was added."""
        most = max(self._most_now, self._most_before)
        used = _bin(most) + 1
        counts = [now + before for now, before in zip(self._now[:used], self._before[:used], strict=True)]
        total = sum(counts)
        found = dict.fromkeys(SHARES, 0.0)
        waiting = list(SHARES.items()) if total else []
        seen = 0
        for index, count in enumerate(counts):
            seen += count
            while waiting and seen >= waiting[0][1] * total:
                found[waiting.pop(0)[0]] = min(float(_upper_edge(index)), round(most, 1))
        return ExecReport(**found, max=round(most, 1))


def _bin(value_us: float) -> int:
    whole = int(value_us) if value_us > 0.0 else 0
    if whole < _EXACT:
        return whole
    shift = whole.bit_length() - 6
    return min(_EXACT + (shift - 1) * 32 + (whole >> shift) - 32, _BINS - 1)


def _upper_edge(index: int) -> int:
    if index < _EXACT:
        return index + 1
    shift, part = divmod(index - _EXACT, 32)
    return (part + 33) << (shift + 1)


class _Mark(NamedTuple):
    """The counters at a turn of the horizon."""

    time_ns: int
    runs: int
    overruns: int
    stalls: int


@final
class RateGroup:
    """Timing of one periodic activity. Recording is cheap; a report is built by `refresh`, and only read by others."""

    def __init__(self, name: str, period_ns: int) -> None:
        self.name = name
        self.period_ns = period_ns
        self.runs = 0
        self.merged = 0
        self.overruns = 0
        self.stalls = 0
        self.delay_ns = 0
        "From when the newest run, or the first one it stands for, was due until it was done."
        self.lateness_us = 0.0
        self.exec_us = 0.0
        self._lateness = Histogram()
        self._exec = Histogram()
        self._worst_us = 0.0
        # the last two turns of the horizon: rate and grade cover what the percentiles cover
        self._marks: tuple[_Mark, _Mark] | None = None
        self._newest_ns = 0
        self.report: RateReport
        self.refresh()

    def record(self, due_ns: int, start_ns: int, end_ns: int, merged: int = 0) -> None:
        """One run that was due, began and ended at these times, and stands for `merged` missed ones too."""
        if self._marks is None:
            self._marks = (_Mark(start_ns, 0, 0, 0), _Mark(start_ns, 0, 0, 0))
        elif start_ns - self._marks[1].time_ns > HORIZON_NS:
            self._marks = (self._marks[1], _Mark(start_ns, self.runs, self.overruns, self.stalls))
            self._lateness.turn()
            self._exec.turn()
        self.lateness_us = (start_ns - due_ns) * 1e-3
        self.exec_us = (end_ns - start_ns) * 1e-3
        self._lateness.add(self.lateness_us)
        self._exec.add(self.exec_us)
        self._worst_us = max(self._worst_us, self.lateness_us)
        self._newest_ns = start_ns
        self.runs += 1
        self.merged += merged
        self.delay_ns = end_ns - due_ns + merged * self.period_ns
        if self.delay_ns > WARNING_PERIODS * self.period_ns:
            self.overruns += 1
            if self.delay_ns > ERROR_PERIODS * self.period_ns:
                self.stalls += 1

    def rate_hz(self) -> float:
        """Mean rate over the horizon, Hz."""
        if self._marks is None or self._newest_ns <= self._marks[0].time_ns:
            return 0.0
        since = self._marks[0]
        return (self.runs - 1 - since.runs) / ((self._newest_ns - since.time_ns) * 1e-9)

    def grade(self) -> str:
        """How well time was kept over the horizon: error with a stall in it, warning with an overrun, else good."""
        if self._marks is None:
            return "good"
        since = self._marks[0]
        if self.stalls > since.stalls:
            return "error"
        return "warning" if self.overruns > since.overruns else "good"

    def refresh(self) -> None:
        """Builds `report`: counts since the start, percentiles over the horizon."""
        lateness = self._lateness.summary()
        self.report = RateReport(
            grade=self.grade(),
            hz=round(self.rate_hz(), 2),
            runs=self.runs,
            merged=self.merged,
            overruns=self.overruns,
            stalls=self.stalls,
            lateness_us=LatenessReport(**asdict(lateness), worst=round(self._worst_us, 1)),
            exec_us=self._exec.summary(),
        )
