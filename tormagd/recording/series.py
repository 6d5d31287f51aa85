"""The quantities of a recording over time, and the stretches in which its codes were there.

Quantities are taken from the control ticks where they are recorded there, else from telemetry. Their names are those of
`Telemetry`; where a tick spells them otherwise, `SPELLINGS` says how.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tormagd.recording.following import AWAY, Following
from tormagd.recording.overview import BREAK_S, Floats
from tormagd.recording.reader import Recording

SPELLINGS: dict[str, tuple[tuple[str, ...], ...]] = {
    "gap_mm": (("gap_mm",), ("left_mm", "right_mm")),
    "gap_setpoint_mm": (("gap_setpoint_mm",), ("reference_gap_mm",)),
    "left_duty": (("left_duty",), ("duty.0",)),
    "right_duty": (("right_duty",), ("duty.1",)),
    "lateness_us": (("lateness_us",), ("tick.lateness_us",)),
}
"The columns whose sum is the quantity, in the order they are looked for."


@dataclass(frozen=True, slots=True)
class Series:
    """One quantity over time since the recording's start; shapes (n,) both."""

    t_s: Floats
    values: Floats


@dataclass(frozen=True, slots=True)
class Band:
    """A code (a limit, a fault, an operating state) and the stretches of time it was there, seconds from the start."""

    name: str
    spans_s: tuple[tuple[float, float], ...]


def start_ns(recording: Recording) -> int:
    """The first message's time. Raises ValueError for a recording without messages."""
    times = [int(columns.t_ns.min()) for columns in (recording.ticks, recording.telemetry) if columns.t_ns.size]
    if not times:
        raise ValueError("the recording has no messages: was the daemon running?")
    return min(times)


def end_ns(recording: Recording) -> int:
    """The last message's time, of a recording with messages."""
    return max(int(columns.t_ns.max()) for columns in (recording.ticks, recording.telemetry) if columns.t_ns.size)


def series(recording: Recording, name: str, begin_ns: int | None = None) -> Series | None:
    """The quantity `name`, from the ticks or else from telemetry, since `begin_ns` or the first message; None where
    neither has a known value of it."""
    begin = start_ns(recording) if begin_ns is None else begin_ns
    for columns in (recording.ticks, recording.telemetry):
        for spelling in SPELLINGS.get(name, ((name,),)):
            if not all(part in columns.numbers for part in spelling):
                continue
            values = np.sum([columns.numbers[part] for part in spelling], axis=0)
            if np.isfinite(values).any():
                return Series((columns.t_ns - begin) / 1e9, values)
    return None


def bands(recording: Recording, name: str, begin_ns: int | None = None) -> tuple[Band, ...]:
    """The codes in the words `name`, in the order of their first appearance, each with its stretches of time since
    `begin_ns` or the first message."""
    begin = start_ns(recording) if begin_ns is None else begin_ns
    for columns in (recording.ticks, recording.telemetry):
        words = columns.words.get(name)
        if words is not None and any(words):
            return _bands((columns.t_ns - begin) / 1e9, words)
    return ()


def _bands(t_s: Floats, words: list[tuple[str, ...]]) -> tuple[Band, ...]:
    period = float(np.median(np.diff(t_s))) if t_s.size > 1 else 0.0
    ends = np.minimum(np.append(t_s[1:], t_s[-1] + period), t_s + max(BREAK_S, period))
    spans: dict[str, list[tuple[float, float]]] = {}
    for start, end, codes in zip(t_s.tolist(), ends.tolist(), words, strict=True):
        for code in codes:
            known = spans.setdefault(code, [])
            if known and start <= known[-1][1]:
                known[-1] = (known[-1][0], end)
            else:
                known.append((start, end))
    return tuple(Band(code, tuple(known)) for code, known in spans.items())


def tracking_rms_N(recording: Recording) -> float | None:
    """RMS of measured minus asked force while following; None where nothing was followed, or not both were recorded."""
    asked, measured = series(recording, "setpoint_cf"), series(recording, "measured_cf")
    if asked is None or measured is None:
        return None
    wanted = np.interp(measured.t_s, asked.t_s, asked.values)
    enabled = is_enabled(recording, measured.t_s)
    for name in AWAY:
        for band in bands(recording, "limits"):
            for start, end in band.spans_s if band.name == name else ():
                enabled &= (measured.t_s < start) | (measured.t_s >= end)
    following = Following()
    for t_s, asked_N, measured_N, is_on in zip(measured.t_s, wanted, measured.values, enabled, strict=True):
        is_known = bool(is_on) and np.isfinite(asked_N) and np.isfinite(measured_N)
        following.add(round(t_s * 1e9), asked_N if is_known else None, measured_N, {})
    report = following.made()
    return None if report is None else report.rms_N


def is_enabled(recording: Recording, t_s: Floats) -> NDArray[np.bool_]:
    """Whether the device was ENABLED at each of these times; at all of them where no state is recorded."""
    states = {band.name: band.spans_s for band in bands(recording, "operating_state")}
    enabled = np.full(t_s.shape, not states)
    for start, end in states.get("ENABLED", ()):
        enabled |= (t_s >= start) & (t_s < end)
    return enabled
