"""How well one rate group keeps its time: period, lateness, execution, overruns, merged ticks."""

from typing import Any

import numpy as np
import numpy.typing as npt

WINDOW = 4_096
"Statistics cover this many of the newest runs: four seconds at 1 kHz."


class RateGroup:
    """Timing of one periodic activity. Recording is cheap; percentiles are made only when somebody asks."""

    def __init__(self, name: str, period_ns: int) -> None:
        self.name = name
        self.period_ns = period_ns
        self.runs = 0
        self.merged = 0
        self.overruns = 0
        self.late_worst_us = 0.0
        self.lateness_us = 0.0
        self.exec_us = 0.0
        self._lateness = np.zeros(WINDOW)
        self._exec = np.zeros(WINDOW)
        self._started_ns = 0
        self._window_ns = np.zeros(WINDOW, dtype=np.int64)

    def record(self, due_ns: int, start_ns: int, end_ns: int, merged: int = 0) -> None:
        """One run that was due, began and ended at these times, and stands for `merged` missed ones too."""
        slot = self.runs % WINDOW
        self.lateness_us = (start_ns - due_ns) * 1e-3
        self.exec_us = (end_ns - start_ns) * 1e-3
        self._lateness[slot] = self.lateness_us
        self._exec[slot] = self.exec_us
        self._window_ns[slot] = start_ns
        self.late_worst_us = max(self.late_worst_us, self.lateness_us)
        self.runs += 1
        self.merged += merged
        if end_ns - due_ns > self.period_ns:
            self.overruns += 1

    def rate_hz(self) -> float:
        """Mean rate over the window, Hz."""
        count = min(self.runs, WINDOW)
        if count < 2:
            return 0.0
        newest = int(self._window_ns[(self.runs - 1) % WINDOW])
        oldest = int(self._window_ns[self.runs % WINDOW] if self.runs > WINDOW else self._window_ns[0])
        return (count - 1) / max((newest - oldest) * 1e-9, 1e-9)

    def report(self) -> dict[str, Any]:
        """Counts since the start, percentiles over the window."""
        count = min(self.runs, WINDOW)
        return {
            "hz": round(self.rate_hz(), 2),
            "runs": self.runs,
            "merged": self.merged,
            "overruns": self.overruns,
            "lateness_us": _percentiles(self._lateness[:count]) | {"worst": round(self.late_worst_us, 1)},
            "exec_us": _percentiles(self._exec[:count]),
        }


def _percentiles(values: npt.NDArray[np.float64]) -> dict[str, float]:
    if values.size == 0:
        return {"p50": 0.0, "p99": 0.0, "max": 0.0}
    p50, p99, most = np.percentile(values, (50, 99, 100))
    return {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "max": round(float(most), 1)}
