"""A recording, at any moment of it, in the form in which the daemon is shown live."""

import math
import re
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tormagd.dashboard.frame import DRIVEN, SHOWN_S, Frame, Held, late_counts
from tormagd.recording.overview import BREAK_NS, BREAK_S
from tormagd.recording.reader import Columns, Recording, RecordingFile
from tormagd.recording.series import Band, Series, bands, series
from tormagd.safety.codes import FAULTS, LIMITS
from tormagd_client.messages import BeliefReport, Explained, PortraitReport

STEP_S = 0.02
"Between two points of a curve, as live."
FIELDS = (
    "setpoint_cf", "governed_cf", "measured_cf", "gap_mm", "left_mm", "right_mm", "gap_setpoint_mm", "reference_gap_mm",
    "field_mT", "operating_state", "limits", "faults", "lateness_us", "tick", "belief",
)  # fmt: skip
"Of a message, what a frame is made from."
AHEAD_NS = 10_000_000_000
"So much more is read than one frame shows: the next is near."
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

    def __init__(self, file: RecordingFile) -> None:
        """Raises ValueError where there is no message in it."""
        overview = file.overview
        if not overview.ticks and not overview.snapshots:
            raise ValueError("the recording has no messages: was the daemon running?")
        self._file, self._overview, self._start_ns = file, overview, overview.start_ns
        self.duration_s = overview.duration_s
        self._read: tuple[int, int, Recording] | None = None

    @property
    def about(self) -> dict[str, Any]:
        """What the page begins with: what is recorded, the whole of it at a glance, and what its codes mean."""
        file, following = self._file, self._overview.following
        return {
            "kind": "recording",
            "name": file.path.name,
            "start_s": self._start_ns * 1e-9,
            "duration_s": self.duration_s,
            "is_complete": file.is_complete,
            "following": msgspec.to_builtins(following),
            "version": file.metadata.get("version", ""),
            "thinned": file.metadata.get("thinned", ""),
            "scene": (file.described("scene", dict[str, Any]) or {}).get("name", ""),
            "portrait": file.described("portrait", PortraitReport),
            "overview": self._glance(),
            # a fault and a limit of one name are two things
            "explained": {
                kind: {code: Explained(code, known.cause, known.remedy) for code, known in of.items()}
                for kind, of in (("limits", LIMITS), ("faults", FAULTS))
            },
        }

    def frame(self, at_s: float) -> Frame:
        """The seconds before `at_s`, which is taken to lie within the recording. Raises RecordingError."""
        at_s = min(max(at_s, 0.0), self.duration_s)
        from_s = max(at_s - SHOWN_S, 0.0)
        at_ns = self._start_ns + round(at_s * 1e9)
        # what was there at a moment stands in the message before it, and ends with the one after
        shown = self._between(at_ns - round((SHOWN_S + BREAK_S) * 1e9), at_ns + BREAK_NS)
        times_s = np.append(np.arange(from_s, at_s, STEP_S), at_s)
        curves = {ours: self._sampled(shown, theirs, times_s) for ours, theirs in CURVES.items()}
        states, faults = self._bands(shown, "operating_state"), self._bands(shown, "faults")
        driven = [any(_is_at(band, t_s) for band in states if band.name in DRIVEN) for t_s in times_s]
        if states:
            curves["field_mT"] = [
                known if is_driven else None for known, is_driven in zip(curves["field_mT"], driven, strict=True)
            ]
        late = self._series(shown, "lateness_us")
        late_us = [] if late is None else late.values[_within(late, from_s, at_s)].tolist()
        limits = [
            Held(band.name, share, _is_at(band, at_s))
            for band in self._bands(shown, "limits")
            if (share := _share(band, from_s, at_s)) > 0.0
        ]
        return Frame(
            t_s=(self._start_ns * 1e-9 + times_s).tolist(),
            **curves,
            operating_state=next((band.name for band in states if _is_at(band, at_s)), ""),
            held=sorted(limits, key=lambda held: -held.share),
            faults=[band.name for band in faults if _is_at(band, at_s)],
            belief=believed(shown.telemetry, at_ns),
            late_counts=late_counts(value for value in late_us if math.isfinite(value)),
        )

    def _between(self, from_ns: int, to_ns: int) -> Recording:
        """What was recorded in this time, and somewhat more."""
        if self._read is None or not self._read[0] <= from_ns < to_ns <= self._read[1]:
            span = from_ns - AHEAD_NS, to_ns + AHEAD_NS
            self._read = (*span, self._file.between(*span, FIELDS))
        return self._read[2]

    def _bands(self, shown: Recording, name: str) -> tuple[Band, ...]:
        return bands(shown, name, self._start_ns)

    def _series(self, shown: Recording, name: str) -> Series | None:
        return series(shown, name, self._start_ns)

    def _sampled(self, shown: Recording, name: str, times_s: np.ndarray) -> list[float | None]:
        return _sampled(self._series(shown, name), times_s)

    def _glance(self) -> dict[str, Any]:
        """The least and greatest measured force of each stretch, and where faults and limits were."""
        known = self._overview.series("measured_cf") or self._overview.series("setpoint_cf")
        spans = {
            name: [span for of in self._overview.spans_s(name).values() for span in of] for name in ("limits", "faults")
        }
        if known is None:
            return {"t_s": [], "low_N": [], "high_N": [], **spans}
        low, high = (
            [value if math.isfinite(value) else None for value in side.tolist()] for side in (known.low, known.high)
        )
        return {"t_s": known.t_s.tolist(), "low_N": low, "high_N": high, **spans}


def believed(telemetry: Columns, at_ns: int) -> dict[str, BeliefReport]:
    """What the newest snapshot before `at_ns` said; nothing where that is too old to be true, or said nothing."""
    numbers, words = telemetry.numbers, telemetry.words
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
