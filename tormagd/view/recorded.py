"""A recording as the page shows it: its whole length once, and a frame for any moment."""

import contextlib
import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from tormagd.control.safety.codes import FAULTS, LIMITS
from tormagd.record.force_following import in_words
from tormagd.record.overview import BREAK_NS, BREAK_S, QUANTITIES, Floats, codes_in, glance, quantities
from tormagd.record.reader import RecordingFile, Shown
from tormagd.view.believed import as_said
from tormagd.view.frame import DRIVEN, SHOWN_S, Frame, Held, late_counts
from tormagd_client.messages import BeliefReport, Explained, PortraitReport

BELIEVED_S = 1.1
"A black box has a snapshot a second."
STEP_S = 0.02
"As in a live page."
AHEAD_NS = 10_000_000_000
"This much more is read than one frame shows, because the next frame is near."
CURVES = {
    "asked_N": "setpoint_cf",
    "governed_N": "governed_cf",
    "measured_N": "measured_cf",
    "gap_mm": "gap_mm",
    "gap_wanted_mm": "gap_setpoint_mm",
    "field_mT": "field_mT",
}
"The recorded quantity of each curve."


Moment = glance(belief=dict[str, dict[str, Any]])


class Moments:
    """Ticks or snapshots of a recording: times since its start (n), and of ticks the quantities (n, 8)."""

    def __init__(self, seen: Sequence[Shown], start_ns: int) -> None:
        self.messages = [each.message for each in seen]
        self.t_s = np.array([each.t_ns - start_ns for each in seen]) * 1e-9
        # the last row is of no message
        self._values = np.array([quantities(each) for each in (*self.messages, {})], float)

    def newest(self, times_s: Floats, most_s: float = BREAK_S) -> list[int]:
        """Return for each time the index of the newest message; -1 where it is over `most_s` old."""
        at = np.searchsorted(self.t_s, times_s, side="right") - 1
        ages_s = times_s - np.append(self.t_s, -math.inf)[at]
        found: list[int] = np.where(ages_s <= most_s, at, -1).tolist()
        return found

    def curve(self, name: str, times_s: Floats) -> list[float | None]:
        """Return the newest value of `name` at each time, None where too old."""
        found = self._values[self.newest(times_s), QUANTITIES.index(name)]
        return [value if math.isfinite(value) else None for value in found.tolist()]

    def within(self, from_s: float, to_s: float) -> range:
        first, last = np.searchsorted(self.t_s, (from_s, to_s))
        return range(int(first), int(last))


class Recorded:
    """A recording for the page; its times are seconds since the first message."""

    def __init__(self, file: RecordingFile) -> None:
        overview = file.overview
        overview.require_messages()
        self._file, self._overview, self._start_ns = file, overview, overview.start_ns
        self.duration_s = overview.duration_s
        self._read: tuple[int, int, Moments, Moments] | None = None

    @property
    def about(self) -> dict[str, Any]:
        file = self._file
        return {
            "kind": "recording",
            "name": file.name,
            "start_s": self._start_ns * 1e-9,
            "duration_s": self.duration_s,
            "notes": file.notes,
            "followed": in_words(self._overview.following),
            "scene": (file.described("scene", dict[str, Any]) or {}).get("name", ""),
            "portrait": file.described("portrait", PortraitReport),
            "overview": self._glance(),
            # a fault and a limit may have the same name
            "explained": {
                kind: {code: Explained(code, known.cause, known.remedy) for code, known in of.items()}
                for kind, of in (("limits", LIMITS), ("faults", FAULTS))
            },
        }

    def frame(self, at_s: float) -> Frame:
        """Return the frame of the SHOWN_S that end at `at_s`, which is limited to the recording."""
        at_s = min(max(at_s, 0.0), self.duration_s)
        from_s = max(at_s - SHOWN_S, 0.0)
        at_ns = self._start_ns + round(at_s * 1e9)
        # what held at a moment is in the message before it, and ends with the one after
        ticks, snapshots = self._between(at_ns - round((SHOWN_S + BREAK_S) * 1e9), at_ns + BREAK_NS)
        times_s = np.append(np.arange(from_s, at_s, STEP_S), at_s)
        curves = {ours: ticks.curve(theirs, times_s) for ours, theirs in CURVES.items()}
        told = [ticks.messages[place] if place >= 0 else {} for place in ticks.newest(times_s)]
        curves["field_mT"] = [
            field_mT if tick.get("operating_state") in (None, *DRIVEN) else None
            for field_mT, tick in zip(curves["field_mT"], told, strict=True)
        ]
        now, late_us = told[-1], [ticks.messages[place].get("lateness_us") for place in ticks.within(from_s, at_s)]
        return Frame(
            t_s=(self._start_ns * 1e-9 + times_s).tolist(),
            **curves,
            operating_state=now.get("operating_state") or "",
            held=_held(ticks, from_s, at_s, codes_in(now.get("limits"))),
            faults=list(codes_in(now.get("faults"))),
            believed=as_said(believed(snapshots, at_s)),
            late_counts=late_counts(each for each in late_us if each is not None),
        )

    def _between(self, from_ns: int, to_ns: int) -> tuple[Moments, Moments]:
        """Return ticks and snapshots of at least this time, and often of more."""
        if self._read is None or not self._read[0] <= from_ns < to_ns <= self._read[1]:
            span = from_ns - AHEAD_NS, to_ns + AHEAD_NS
            self._read = (*span, *moments(self._file, *span))
        return self._read[2:]

    def _glance(self) -> dict[str, Any]:
        """Return the measured force over the whole length (else the asked one), and what came meanwhile."""
        overview = self._overview
        known = overview.series("measured_cf") or overview.series("setpoint_cf")
        spans: dict[str, Any] = {
            name: [span for of in overview.spans_s(name).values() for span in of] for name in ("limits", "faults")
        }
        spans["marks"] = [((mark.t_ns - overview.start_ns) * 1e-9, mark.text) for mark in overview.marks]
        if known is None:
            return {"t_s": [], "low_N": [], "high_N": [], **spans}
        low, high = (
            [value if math.isfinite(value) else None for value in side.tolist()] for side in (known.low, known.high)
        )
        return {"t_s": known.t_s.tolist(), "low_N": low, "high_N": high, **spans}


def moments(file: RecordingFile, from_ns: int, to_ns: int) -> tuple[Moments, Moments]:
    """Read the ticks and the snapshots from `from_ns` to `to_ns`."""
    seen, start_ns = file.between(from_ns, to_ns, Moment), file.overview.start_ns
    ticks, snapshots = ([each for each in seen if each.is_tick is kind] for kind in (True, False))
    return Moments(ticks, start_ns), Moments(snapshots, start_ns)


def believed(snapshots: Moments, at_s: float) -> dict[str, BeliefReport]:
    """Return the belief in the newest snapshot up to `at_s`, by quantity, without what was not known."""
    (place,) = snapshots.newest(np.array([at_s]), BELIEVED_S)
    found = {}
    for name, told in snapshots.messages[place].get("belief", {}).items() if place >= 0 else ():
        with contextlib.suppress(msgspec.ValidationError):
            found[name] = msgspec.convert({"sd": None, **told}, BeliefReport)
    return found


def _held(ticks: Moments, from_s: float, at_s: float, now: Sequence[str]) -> list[Held]:
    held_s: defaultdict[str, float] = defaultdict(float)
    steps_s = np.minimum(np.diff(ticks.t_s, append=at_s), BREAK_S)
    for place in ticks.within(from_s, at_s):
        for code in codes_in(ticks.messages[place].get("limits")):
            held_s[code] += float(steps_s[place])
    found = [Held(code, each_s / max(at_s - from_s, STEP_S), code in now) for code, each_s in held_s.items()]
    return sorted(found, key=lambda held: -held.share)
