"""What `tormagctl top` shows: a pure function of what is known and of the terminal's size."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean
from typing import NamedTuple

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from tormagd.ctl.status import believed, played, refused, torque
from tormagd.record.force_following import in_words
from tormagd_client.messages import Explained, Status, Telemetry
from tormagd_client.printable import printable

COLUMN_NS = 100_000_000
"One character of a sparkline."
STANDARD_ROWS = 24
"With these rows sparklines are one row high; they share any further rows."
LABEL, VALUE, ENDS = 10, 10, 12
"Characters of a row's name, of its newest value, and of the ends of its scale."
NARROW = 60
"Narrower terminals show no ends of the scales."
SILENT_S = 0.5
EIGHTHS = " ▁▂▃▄▅▆▇█"
STATE_STYLES = {"ENABLED": "black on green", "PAUSED": "black on yellow", "FAULT": "bold white on red"}
GRADE_STYLES = {"warning": "yellow", "error": "red"}


class Seen(NamedTuple):
    """What is known: telemetry from the oldest on, the newest status, explanations by code, the silence."""

    telemetry: Sequence[Telemetry]
    status: Status
    explained: Mapping[str, Explained]
    silent_s: float = 0.0


class Curve(NamedTuple):
    """A row with a sparkline. Curves with the same `scale` share one, at least `least` wide."""

    label: str
    unit: str
    digits: int
    style: str
    scale: str
    least: float
    value: Callable[[Telemetry], float | None]
    of_column: Callable[[list[float]], float] = fmean


CURVES = (
    Curve("asked", "N", 3, "bright_white", "force", 0.05, lambda it: it.setpoint_cf),
    Curve("governed", "N", 3, "dodger_blue1", "force", 0.05, lambda it: it.governed_cf),
    Curve("measured", "N", 3, "orange1", "force", 0.05, lambda it: it.measured_cf),
    Curve("gap", "mm", 2, "cyan", "gap", 0.5, lambda it: it.gap_mm),
    Curve("field", "mT", 1, "green", "field", 1.0, lambda it: it.field_mT),
    Curve("late", "us", 0, "magenta", "late", 100.0, lambda it: it.tick.lateness_us, max),
)


def screen(seen: Seen, width: int, height: int) -> RenderableType:
    more = max(height - STANDARD_ROWS, 0) // len(CURVES)
    wide = width - 2
    head, curves = _head(seen, wide), _curves(seen, wide, max(more, 1), is_apart=more > 0)
    timing, codes = _timing(seen.status, wide), _codes(seen, wide)
    whole = _below_each_other(head, curves, timing, codes)
    is_cut = len(Console(width=width).render_lines(whole)) > height
    return _below_each_other(head, curves, codes, timing) if is_cut else whole


def _below_each_other(*parts: RenderableType) -> RenderableType:
    return Padding(Group(*[line for part in parts for line in (Text(), part)][1:]), (0, 1))


def _head(seen: Seen, width: int) -> Text:
    newest, status = seen.telemetry[-1] if seen.telemetry else seen.status, seen.status
    state, is_silent = printable(newest.operating_state), seen.silent_s > SILENT_S
    flags = ["homed" if newest.is_homed else "not homed", *(["busy"] if newest.is_busy else [])]
    shaft = torque(newest.measured_cf, status.roller_radius_mm).strip(" ()")
    head = Text.assemble(
        (f" {state} ", "reverse" if is_silent else STATE_STYLES.get(state, "reverse")),
        *([(f"  nothing heard for {seen.silent_s:.0f} s", "bold red")] if is_silent else []),
        (f"  {', '.join(flags)}", "" if newest.is_homed else "yellow"),
        f"  {shaft} at the handle" if shaft else "",
        no_wrap=True,
        overflow="ellipsis",
    )
    minutes = status.uptime_s / 60.0
    up = (
        f"{minutes / 60.0:.1f} h"
        if minutes >= 60.0
        else f"{minutes:.0f} min"
        if minutes >= 1.0
        else f"{60.0 * minutes:.0f} s"
    )
    about = f"{status.scene} · up {up} · tormagd {status.version} · q ends"
    head.append(f"  {about}".rjust(width - head.cell_len), "dim")
    return head


def _curves(seen: Seen, width: int, rows: int, *, is_apart: bool) -> Table:
    """Return a row for each of CURVES."""
    ends_wide = ENDS if width >= NARROW else 0
    count = max(width - LABEL - VALUE - ends_wide - 3, 8)
    table = _grid(LABEL, VALUE, count, *([ends_wide] if ends_wide else []))
    times_ns = [each.t_ns for each in seen.telemetry]
    courses = [
        columns(times_ns, [curve.value(it) for it in seen.telemetry], count, COLUMN_NS, curve.of_column)
        for curve in CURVES
    ]
    scales: dict[str, list[float | None]] = {}
    for curve, course in zip(CURVES, courses, strict=True):
        scales.setdefault(curve.scale, []).extend(course)
    for curve, course in zip(CURVES, courses, strict=True):
        low, high = span(scales[curve.scale], curve.least)
        newest = curve.value(seen.telemetry[-1]) if seen.telemetry else None
        shown = "-" if newest is None else f"{newest:.{curve.digits}f}"
        digits = min(curve.digits, 2)
        ends = [f"{high:.{digits}f}", *[""] * (rows - 2), f"{low:.{digits}f}"]
        cells = (
            Text(curve.label, "bold"),
            Text(f"{shown:>7} {curve.unit}"),
            Text("\n".join(sparkline(course, low, high, rows)), curve.style),
            Text("\n".join(ends) if rows > 1 else "..".join(reversed(ends)), "dim"),
        )
        table.add_row(*cells[: len(table.columns)])
        if is_apart and curve is not CURVES[-1]:
            table.add_row()
    return table


def _grid(*widths: int, is_cut: bool = True) -> Table:
    table = Table.grid(padding=(0, 1, 0, 0))
    for width in widths:
        table.add_column(width=width, no_wrap=is_cut, overflow="ellipsis")
    return table


def _timing(status: Status, width: int) -> Table:
    table = _grid(LABEL, width - LABEL - 1)
    for name in ("control", "inference", "search"):
        group = status.rates.get(name)
        if group is not None:
            late = group.lateness_us
            said = f", {group.hz:.0f} Hz, late {late.p50:.0f} us (p50) {late.p99:.0f} us (p99), stalls {group.stalls}"
            if name == "search":
                said = f", {group.hz:.0f} Hz, field of {status.search_age_ms:.0f} ms ago"
            table.add_row(
                Text(name, "bold"), Text.assemble((group.grade, GRADE_STYLES.get(group.grade, "green")), said)
            )
    link, setpoints, trip_us = status.link, status.setpoints, status.link.round_trip_us
    trip = "" if trip_us is None else f", round trip {trip_us.p50 * 1e-3:.2f} ms (p50)"
    state = (link.state, "green" if link.state == "RUNNING" else "red")
    table.add_row(
        Text("link", "bold"), Text.assemble(state, f", losses {link.losses}{trip}, {link.backend} {link.port}")
    )
    heard = f"from {setpoints.newest_source!r}" if setpoints.accepted else "none yet"
    table.add_row(Text("setpoints", "bold"), f"{heard}, {setpoints.accepted} accepted, {setpoints.refused} refused")
    if playout := played(setpoints.playout):
        table.add_row(Text("playout", "bold"), playout)
    if status.not_granted:
        lacking = f"did not grant {', '.join(map(printable, refused(status.not_granted)))}; next: tormagctl doctor"
        table.add_row(Text("kernel", "bold"), Text(lacking, "yellow"))
    if how := in_words(status.following):
        table.add_row(Text("followed", "bold"), how)
    table.add_row(
        Text("believed", "bold"), Text(printable(believed(status.belief)).replace("±", "+-") or "nothing that acts")
    )
    return table


def _codes(seen: Seen, width: int) -> Table:
    """Return rows of the newest faults, then of recent limits, the longest first."""
    newest = seen.telemetry[-1] if seen.telemetry else seen.status
    times = Counter(code for each in seen.telemetry for code in each.limits)
    table = _grid(LABEL, width - LABEL - 1, is_cut=False)
    for code in newest.faults:
        table.add_row(Text("FAULT", "bold red"), _code(code, "", "bold red", seen.explained))
    for code, count in times.most_common():
        share = count / len(seen.telemetry)
        how_long = f" {'under 1%' if share < 0.01 else f'{share:.0%}'} of the time"
        style = "yellow" if code in newest.limits else "dim yellow"
        table.add_row(Text("held by", style), _code(code, how_long, style, seen.explained))
    if not table.row_count:
        table.add_row(Text("held by", "bold"), Text("nothing, and there is no fault", "green"))
    return table


def _code(code: str, how_long: str, style: str, explained: Mapping[str, Explained]) -> Text:
    known = explained.get(code)
    why = "" if known is None else Text.assemble(f": {known.cause}", (f"\nnext: {known.remedy}", "italic"))
    return Text.assemble((printable(code), style), how_long, why)


def columns(
    times_ns: Sequence[int],
    values: Sequence[float | None],
    count: int,
    period_ns: int,
    of_column: Callable[[list[float]], float],
) -> list[float | None]:
    """Return `of_column` of the values in each of the newest `count` periods, the oldest first."""
    if not times_ns:
        return [None] * count
    first = times_ns[-1] // period_ns - count + 1
    gathered: list[list[float]] = [[] for _ in range(count)]
    for t_ns, value in zip(times_ns, values, strict=True):
        column = t_ns // period_ns - first
        if 0 <= column < count and value is not None and math.isfinite(value):
            gathered[column].append(value)
    return [of_column(known) if known else None for known in gathered]


def span(values: Sequence[float | None], least: float) -> tuple[float, float]:
    """Return the range of known values, at least `least` wide, so that noise does not look like a signal."""
    known = [value for value in values if value is not None]
    if not known:
        return 0.0, least
    low, high = min(known), max(known)
    wider = max(least - (high - low), 0.0) / 2.0
    return (0.0, least) if low >= 0.0 > low - wider else (low - wider, high + wider)


def sparkline(values: Sequence[float | None], low: float, high: float, rows: int) -> list[str]:
    """Return `rows` lines of bars, the top line first, with a character for each value."""
    steps = len(EIGHTHS) - 1
    full = rows * steps
    eighths = [
        0 if value is None else 1 + round((full - 1) * min(max((value - low) / (high - low), 0.0), 1.0))
        for value in values
    ]
    return [
        "".join(EIGHTHS[min(max(height - row * steps, 0), steps)] for height in eighths)
        for row in reversed(range(rows))
    ]
