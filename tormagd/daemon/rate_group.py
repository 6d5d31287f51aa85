"""How well one rate group keeps its time."""

import math
from collections import deque
from typing import Final, TypeAlias, final

from msgspec.structs import asdict

from tormagd_client.messages import ExecReport, LatenessReport, RateReport

WARNING_PERIODS: Final = 1.0
"A run that ends later has overrun: the next one was due already."
ERROR_PERIODS: Final = 10.0
"A run that ends later is a stall; at 1 kHz, a fifth of the time after which the firmware opens the gap."
HORIZON_NS: Final = 5_000_000_000
"Percentiles cover the last one to two of these."
SHARES: Final = (0.5, 0.99, 0.999)
_EXACT: Final = 64  # bins of 1 us; above, 32 bins for each doubling: 3 % resolution
_DOUBLINGS: Final = 20
_BINS: Final = _EXACT + 32 * _DOUBLINGS


@final
class Histogram:
    """Counts durations in bins, over one to two horizons."""

    def __init__(self) -> None:
        self._now = [0] * _BINS
        self._before = [0] * _BINS
        self._max_now = self._max_before = 0.0
        self._turned_s = -math.inf

    def add(self, now_s: float, value_us: float) -> None:
        """Count one duration that ended at `now_s`; negative ones, a clock's grain, and NaN count as 0."""
        if now_s - self._turned_s > HORIZON_NS * 1e-9:
            self._turned_s = now_s
            self._before, self._now = self._now, [0] * _BINS
            self._max_before, self._max_now = self._max_now, 0.0
        self._now[_bin(value_us)] += 1
        if value_us > self._max_now:
            self._max_now = value_us

    def report(self) -> ExecReport:
        """Return percentiles, each the upper edge of its bin."""
        most = round(max(self._max_now, self._max_before), 1)
        total, seen, used = sum(self._now) + sum(self._before), 0, 0
        edges = []
        for share in SHARES:
            while seen < share * total:
                seen += self._now[used] + self._before[used]
                used += 1
            edges.append(min(float(_upper_edge(used - 1)), most))
        return ExecReport(p50=edges[0], p99=edges[1], p999=edges[2], max=most)


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


_Mark: TypeAlias = tuple[int, int, int, int]
"Time, ns, and runs, overruns and stalls until then."


@final
class RateGroup:
    def __init__(self, name: str, period_ns: int) -> None:
        self.name = name
        self.period_ns = period_ns
        self.runs = 0
        self.merged = 0
        self.overruns = 0
        self.stalls = 0
        self.delay_ns = 0
        "From when the newest run, with the missed ones before it, was due until it ended."
        self.lateness_us = self.exec_us = 0.0
        self.lateness = Histogram()
        self.exec = Histogram()
        self._worst_us = 0.0
        # one for each horizon: rate and grade cover the time of the percentiles
        self._marks: deque[_Mark] = deque(maxlen=2)
        self._newest_ns = 0

    def record(self, due_ns: int, start_ns: int, end_ns: int, merged: int = 0) -> None:
        if not self._marks or start_ns - self._marks[-1][0] > HORIZON_NS:
            self._marks.append((start_ns, self.runs, self.overruns, self.stalls))
        self.lateness_us = (start_ns - due_ns) * 1e-3
        self.exec_us = (end_ns - start_ns) * 1e-3
        self.lateness.add(start_ns * 1e-9, self.lateness_us)
        self.exec.add(start_ns * 1e-9, self.exec_us)
        self._worst_us = max(self._worst_us, self.lateness_us)
        self._newest_ns = start_ns
        self.runs += 1
        self.merged += merged
        self.delay_ns = end_ns - due_ns + merged * self.period_ns
        if self.delay_ns > WARNING_PERIODS * self.period_ns:
            self.overruns += 1
            if self.delay_ns > ERROR_PERIODS * self.period_ns:
                self.stalls += 1

    def report(self) -> RateReport:
        """Return counts and worst lateness since the start; rate, grade and percentiles over one to two horizons."""
        since_ns, runs, overruns, stalls = self._marks[0] if self._marks else (0, 0, 0, 0)
        hz, grade = 0.0, "good"
        if self._newest_ns > since_ns:
            hz = (self.runs - 1 - runs) / ((self._newest_ns - since_ns) * 1e-9)
        if self.overruns > overruns:
            grade = "error" if self.stalls > stalls else "warning"
        return RateReport(
            grade=grade,
            hz=round(hz, 2),
            runs=self.runs,
            merged=self.merged,
            overruns=self.overruns,
            stalls=self.stalls,
            lateness_us=LatenessReport(**asdict(self.lateness.report()), worst=round(self._worst_us, 1)),
            exec_us=self.exec.report(),
        )
