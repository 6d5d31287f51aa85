"""One recording, or several side by side, as one HTML page."""

import base64
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np

from tormagd.control.safety.codes import FAULTS, LIMITS, Explanation
from tormagd.record.force_following import in_words
from tormagd.record.overview import LATE_US, Codes
from tormagd.record.reader import RecordingFile
from tormagd.view.believed import as_said
from tormagd.view.html import page, table
from tormagd.view.plot import figure, picture
from tormagd.view.recorded import BELIEVED_S, believed, moments

MAX_TOLD = 20
"Moments of one fault that are listed."


def report(of: Sequence[RecordingFile]) -> str:
    """Return one HTML page on these recordings, with its pictures within."""
    names = [each.name for each in of]
    parts = [
        f"<h1>{escape(' and '.join(names))}</h1>",
        *(_notes(each) for each in of if each.notes),
        table(["figure", *names], _figures(of)),
        *(_picture(each) for each in of),
        "<h2>What held the force back</h2>",
        _codes(of, "limits", LIMITS, _held),
        "<h2>Faults</h2>",
        _codes(of, "faults", FAULTS, _moments),
        "<h2>Marks</h2>",
        table(["at", *names], _marks(of)),
        "<h2>What was believed of the device at the end</h2>",
        table(["quantity", *names], _belief(of)),
        "<h2>The machine: how late control ticks began</h2>",
        table(["µs", *names], _lateness(of)),
    ]
    return page(f"tormagd: {', '.join(names)}", parts)


def _notes(of: RecordingFile) -> str:
    kind = ' class="bad"' if of.damage else ""
    return f"<p{kind}>{escape('. '.join([f'{of.name}: {of.notes[0]}', *of.notes[1:]]))}.</p>"


def _figures(of: Sequence[RecordingFile]) -> list[list[str]]:
    """Return a table's rows: a name, and a text for each recording."""

    def known(each: RecordingFile) -> dict[str, str]:
        overview = each.overview
        scene = each.described("scene", dict[str, Any]) or {}
        began = datetime.fromtimestamp(overview.start_ns * 1e-9, UTC)
        states = overview.codes["operating_state"]
        return {
            "began": f"{began:%Y-%m-%d %H:%M:%S} UTC",
            "lasts": f"{overview.duration_s:.1f} s",
            "enabled": f"{states['ENABLED'].held_ns * 1e-9:.1f} s" if "ENABLED" in states else "never",
            "followed for": f"{overview.followed_s:.1f} s",
            "how well": in_words(overview.following) or "nothing was followed",
            "asked": _range(each, "setpoint_cf"),
            "felt": _range(each, "measured_cf"),
            "ticks, snapshots": f"{overview.ticks:,}, {overview.snapshots:,}",
            "scene": str(scene.get("name", "")),
            "device": each.metadata.get("serial_number", ""),
            "tormagd": f"{each.metadata.get('version', '')} {each.metadata.get('build', '')}",
        }

    return _rows([known(each) for each in of])


def _range(of: RecordingFile, name: str) -> str:
    known = of.overview.series(name)
    if known is None:
        return "not recorded"
    return f"{np.nanmin(known.low):.3f} to {np.nanmax(known.high):.3f} N"


def _picture(of: RecordingFile) -> str:
    name = of.name.removesuffix(".mcap")
    png = base64.b64encode(picture(figure(of.overview, name, of.notes), "png")).decode()
    alt = f"force, gap, duty, limits and faults of {escape(name)}"
    return f'<p class="wide" tabindex="0"><img alt="{alt}" src="data:image/png;base64,{png}"></p>'


def _codes(
    of: Sequence[RecordingFile], kind: str, explained: Mapping[Any, Explanation], told: Callable[[Codes, float], str]
) -> str:
    """Return an HTML table of the limits or faults that any of the recordings has."""
    names = dict.fromkeys(code for each in of for code in each.overview.codes[kind])
    texts = {str(code): known for code, known in explained.items()}
    rows = []
    for code in names:
        known = [(each.overview.codes[kind].get(code), each.overview.duration_s) for each in of]
        why = texts.get(code)
        when = ["" if codes is None else told(codes, lasts_s) for codes, lasts_s in known]
        rows.append([code, *when, why.cause if why else "", why.remedy if why else ""])
    return table(["code", *(each.name for each in of), "why", "what to do"], rows)


def _held(codes: Codes, lasts_s: float) -> str:
    held_s = codes.held_ns * 1e-9
    return f"{held_s:.2f} s, {100.0 * held_s / max(lasts_s, 1e-3):.1f}%"


def _moments(codes: Codes, _lasts_s: float) -> str:
    more = f" and {len(codes.spans_ns) - MAX_TOLD} more" if len(codes.spans_ns) > MAX_TOLD else ""
    return "at " + ", ".join(f"{begin * 1e-9:.2f}" for begin, _ in codes.spans_ns[:MAX_TOLD]) + f" s{more}"


def _marks(of: Sequence[RecordingFile]) -> list[list[str]]:
    return [
        [f"{(mark.t_ns - each.overview.start_ns) * 1e-9:.2f} s", *(mark.text if it is each else "" for it in of)]
        for each in of
        for mark in each.overview.marks
    ]


def _belief(of: Sequence[RecordingFile]) -> list[list[str]]:
    found = []
    for each in of:
        end_ns = each.overview.end_ns
        _, snapshots = moments(each, end_ns - round(BELIEVED_S * 1e9), end_ns)
        found.append(as_said(believed(snapshots, each.overview.duration_s)))
    return _rows(found)


def _lateness(of: Sequence[RecordingFile]) -> list[list[str]]:
    bars = [f"under {LATE_US[0]:g}", *(f"{a:g} to {b:g}" for a, b in pairwise(LATE_US))]
    counts = [each.overview.late_counts for each in of]
    return [[bar, *(f"{of_one[i]:,}" for of_one in counts)] for i, bar in enumerate([*bars, f"over {LATE_US[-1]:g}"])]


def _rows(columns: Sequence[Mapping[str, str]]) -> list[list[str]]:
    return [[key, *(column.get(key, "") for column in columns)] for key in dict.fromkeys(k for c in columns for k in c)]
