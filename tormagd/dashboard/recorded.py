"""A recording, at any moment of it, in the form in which the daemon is shown live."""

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tormagd.dashboard.frame import SHOWN_S, Frame, Held, late_counts
from tormagd.recording.reader import Recording
from tormagd.recording.series import BREAK_S, Band, Series, bands, series, start_ns, tracking_rms_N
from tormagd.safety.codes import FAULTS, LIMITS
from tormagd_client.messages import BeliefReport, Explained, PortraitReport

STEP_S = 0.02
"Between two points of a curve, as live."
OVERVIEW = 600
"Stretches that the whole recording is shown in, each by its least and greatest force."
CURVES = {
    "asked_N": "setpoint_cf",
    "governed_N": "governed_cf",
    "measured_N": "measured_cf",
    "gap_mm": "gap_mm",
    "gap_wanted_mm": "gap_setpoint_mm",
    "field_mT": "field_mT",
}
"What the page calls a quantity, and what a recording does."
_BELIEVED = re.compile(r"belief\.[^.]+\.value")


class Recorded:
    """A recording with messages. Times are seconds since its first one."""

    def __init__(self, recording: Recording, name: str) -> None:
        """Raises ValueError where there is no message in it."""
        self._recording, self._name = recording, name
        self._start_ns = start_ns(recording)
        self._curves = {ours: series(recording, theirs) for ours, theirs in CURVES.items()}
        self._late = series(recording, "lateness_us")
        self._states = bands(recording, "operating_state")
        self._limits, self._faults = bands(recording, "limits"), bands(recording, "faults")
        # the curves are the ticks' where there are any, and end with them
        shown = recording.ticks if recording.ticks.t_ns.size else recording.telemetry
        self.duration_s = (int(shown.t_ns.max()) - self._start_ns) * 1e-9

    @property
    def about(self) -> dict[str, Any]:
        """What the page begins with: what is recorded, the whole of it at a glance, and what its codes mean."""
        metadata = self._recording.metadata
        return {
            "kind": "recording",
            "name": self._name,
            "start_s": self._start_ns * 1e-9,
            "duration_s": self.duration_s,
            "is_complete": self._recording.is_complete,
            "tracking_rms_N": tracking_rms_N(self._recording),
            "version": metadata.get("version", ""),
            "scene": (self._recording.described("scene", dict[str, Any]) or {}).get("name", ""),
            "portrait": self._recording.described("portrait", PortraitReport),
            "overview": self._overview(),
            "explained": {
                code: Explained(code, known.cause, known.remedy) for code, known in (LIMITS | FAULTS).items()
            },
        }

    def frame(self, at_s: float) -> Frame:
        """The seconds before `at_s`, which is taken to lie within the recording."""
        at_s = min(max(at_s, 0.0), self.duration_s)
        from_s = max(at_s - SHOWN_S, 0.0)
        times_s = np.append(np.arange(from_s, at_s, STEP_S), at_s)
        late = None if self._late is None else self._late.values[_within(self._late, from_s, at_s)]
        limits = [
            Held(band.name, share, _is_at(band, at_s))
            for band in self._limits
            if (share := _share(band, from_s, at_s)) > 0.0
        ]
        return Frame(
            t_s=(self._start_ns * 1e-9 + times_s).tolist(),
            **{ours: _sampled(known, times_s) for ours, known in self._curves.items()},
            operating_state=next((band.name for band in self._states if _is_at(band, at_s)), ""),
            held=sorted(limits, key=lambda held: -held.share),
            faults=[band.name for band in self._faults if _is_at(band, at_s)],
            belief=self._belief(at_s),
            late_counts=late_counts([] if late is None else late[np.isfinite(late)].tolist()),
        )

    def _belief(self, at_s: float) -> dict[str, BeliefReport]:
        """What the newest snapshot said; nothing where that is too old to be true, or said nothing."""
        telemetry = self._recording.telemetry
        numbers, words, at_ns = telemetry.numbers, telemetry.words, self._start_ns + round(at_s * 1e9)
        row = int(np.searchsorted(telemetry.t_ns, at_ns, side="right")) - 1
        if row < 0 or (at_ns - telemetry.t_ns[row]) * 1e-9 > BREAK_S:
            return {}
        told = {}
        for name in (path.split(".")[1] for path in numbers if _BELIEVED.fullmatch(path)):
            value, sd, acts = (_number(numbers, f"belief.{name}.{part}", row) for part in ("value", "sd", "acts"))
            if value is not None:
                unit = "".join(words[f"belief.{name}.unit"][row]) if f"belief.{name}.unit" in words else ""
                told[name] = BeliefReport(value=value, sd=sd, unit=unit, acts=bool(acts))
        return told

    def _overview(self) -> dict[str, Any]:
        """Ends of the stretches, the least and greatest measured force in each, and where faults and limits were."""
        edges_s = np.linspace(0.0, self.duration_s, OVERVIEW + 1)
        low: list[float | None] = [None] * OVERVIEW
        high = low.copy()
        measured = self._curves["measured_N"] or self._curves["asked_N"]
        if measured is not None:
            ends = np.searchsorted(measured.t_s, edges_s)
            for stretch in range(OVERVIEW):
                values = measured.values[ends[stretch] : ends[stretch + 1]]
                values = values[np.isfinite(values)]
                if values.size:
                    low[stretch], high[stretch] = float(values.min()), float(values.max())
        codes = {"limits": self._limits, "faults": self._faults}
        spans = {name: [span for band in found for span in band.spans_s] for name, found in codes.items()}
        return {"t_s": edges_s[1:].tolist(), "low_N": low, "high_N": high, **spans}


def _number(numbers: dict[str, NDArray[np.float64]], name: str, row: int) -> float | None:
    value = float(numbers[name][row]) if name in numbers else math.nan
    return value if math.isfinite(value) else None


def _sampled(known: Series | None, times_s: np.ndarray) -> list[float | None]:
    """The newest value at each time; None where the newest is too old to be true, or none is known."""
    if known is None:
        return [None] * len(times_s)
    at = np.searchsorted(known.t_s, times_s, side="right") - 1
    values = np.where((at >= 0) & (times_s - known.t_s[at] <= BREAK_S), known.values[at], np.nan)
    return [value if np.isfinite(value) else None for value in values.tolist()]


def _within(known: Series, from_s: float, to_s: float) -> slice:
    first, last = np.searchsorted(known.t_s, (from_s, to_s))
    return slice(int(first), int(last) + 1)


def _is_at(band: Band, at_s: float) -> bool:
    return any(start <= at_s < end for start, end in band.spans_s)


def _share(band: Band, from_s: float, to_s: float) -> float:
    inside_s = sum(max(min(end, to_s) - max(start, from_s), 0.0) for start, end in band.spans_s)
    return inside_s / max(to_s - from_s, STEP_S)
