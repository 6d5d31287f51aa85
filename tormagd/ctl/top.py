"""`tormagctl top`: the last 20 s of force, gap, field and lateness as curves, above the status, live in a terminal."""

import contextlib
import math
import os
import select
import signal
import sys
import termios
import time
import tty
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean
from typing import NamedTuple

import msgspec
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tormagd.ctl.outcome import Colour, Outcome, is_terminal, usage_error, wrapped
from tormagd.ctl.status import status_text
from tormagd.ground.terminal import interrupted_by
from tormagd_client.blocking import Client
from tormagd_client.errors import UnreachableError, not_understood
from tormagd_client.messages import Explained, MessageError, Status, Telemetry
from tormagd_client.printable import printable

REDRAW_S = 0.2
ASK_S = 1.0
"The status is asked for sooner if a code appears that is not explained yet."
KEPT = 1_000
"Snapshots of 20 s: shorter limits would come and go too fast to be read."
SILENT_S = 0.5
COLUMN_NS = 100_000_000
"One character of a sparkline."
LABEL, VALUE, ENDS = 10, 10, 14
"Characters of a curve's name, of its newest value, and of the ends of its scale."
NARROW = 60
"Narrower terminals show no ends of the scales."
EIGHTHS = " ▁▂▃▄▅▆▇█"


class Seen(NamedTuple):
    """What is known: telemetry from the oldest on, the newest status, explanations by code, the silence."""

    telemetry: Sequence[Telemetry]
    status: Status
    explained: Mapping[str, Explained]
    silent_s: float = 0.0


class Curve(NamedTuple):
    """A row with a sparkline. Curves of one unit share a scale, at least `least` wide."""

    label: str
    unit: str
    digits: int
    style: str
    least: float
    value: Callable[[Telemetry], float | None]
    of_column: Callable[[list[float]], float] = fmean


CURVES = (
    Curve("asked", "N", 3, "bright_white", 0.05, lambda it: it.setpoint_cf),
    Curve("governed", "N", 3, "dodger_blue1", 0.05, lambda it: it.governed_cf),
    Curve("measured", "N", 3, "orange1", 0.05, lambda it: it.measured_cf),
    Curve("gap", "mm", 2, "cyan", 0.5, lambda it: it.gap_mm),
    Curve("field", "mT", 1, "green", 1.0, lambda it: it.field_mT),
    Curve("late", "us", 0, "magenta", 100.0, lambda it: it.tick.lateness_us, max),
)


def top(client: Client) -> Outcome:
    """Draw the daemon's state until `q`, Ctrl-C or SIGTERM."""
    console = Console(highlight=False)
    if not (is_terminal(sys.stdin) and console.is_terminal) or console.is_dumb_terminal:
        raise usage_error("top needs a terminal that can be drawn on", "tormagctl status, with --json for a script")
    watcher = Watcher(client)
    start_s = time.monotonic()
    with (
        interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted,
        contextlib.ExitStack() as terminal,
        Live(console=console, screen=True, auto_refresh=False) as live,
    ):
        terminal.callback(termios.tcsetattr, sys.stdin, termios.TCSADRAIN, termios.tcgetattr(sys.stdin))
        tty.setcbreak(sys.stdin)  # keys are read when pressed, without echo
        while not is_interrupted():
            live.update(screen(watcher.look(), *console.size), refresh=True)
            if select.select([sys.stdin], [], [], REDRAW_S)[0]:
                # all that came: what Python read ahead would wait for the next key
                keys = os.read(sys.stdin.fileno(), 1_024)
                if b"q" in keys or not keys:
                    break
    seconds = time.monotonic() - start_s
    return Outcome({"seconds": round(seconds, 1)}, f"watched for {seconds:.0f} s; the daemon goes on")


class Watcher:
    """Gathers telemetry and status for the screen."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._telemetry: deque[Telemetry] = deque(maxlen=KEPT)
        self._status = client.status()
        self._explained: dict[str, Explained] = {}
        self._ask_s = self._heard_s = time.monotonic()

    def look(self) -> Seen:
        """Return what has arrived by now, and ask for the status from time to time."""
        now_s = time.monotonic()
        try:
            arrived = self._client.telemetry()
        except MessageError as error:
            raise not_understood("telemetry", error) from error
        if arrived:
            self._heard_s = now_s
            self._telemetry += arrived
            newest = arrived[-1]
            is_news = newest.operating_state != self._status.operating_state
            if is_news or now_s >= self._ask_s or not self._explained.keys() >= {*newest.faults, *newest.limits}:
                self._ask_s = now_s + ASK_S
                with contextlib.suppress(UnreachableError):  # the screen says that nothing is heard
                    self._status = self._client.status(ASK_S)
        self._explained |= {each.code: each for each in (*self._status.limit_details, *self._status.fault_details)}
        return Seen(self._telemetry, self._status, self._explained, now_s - self._heard_s)


def screen(seen: Seen, width: int, height: int) -> Group:
    """Return the curves, higher on a high terminal, and below them as much of the status as there is room for."""
    silence = f"nothing heard for {seen.silent_s:.0f} s  " if seen.silent_s > SILENT_S else ""
    head = Text.assemble((silence, "bold red"), ("tormagctl top; q ends", "dim"), no_wrap=True, overflow="ellipsis")
    said = wrapped(status_text(over_the_time_shown(seen), Colour(sys.stdout)), width)
    rows = max((height - len(said) - 1) // len(CURVES) - 1, 1)
    room = max(height - 1 - len(CURVES) * (1 if rows == 1 else rows + 1), 0)
    return Group(head, _curves(seen.telemetry, width, rows), Text.from_ansi("\n".join(said[:room])))


def over_the_time_shown(seen: Seen) -> Status:
    """Return the status with all limits of the telemetry that is shown, the longest first, each with its share."""
    times = Counter(code for each in seen.telemetry for code in each.limits)
    limits = []
    for code, count in times.most_common():
        known, share = seen.explained.get(code, Explained(code, "", "")), count / len(seen.telemetry)
        how_long = "under 1%" if share < 0.01 else f"{share:.0%}"
        limits.append(Explained(f"{printable(code)} {how_long} of the time", known.cause, known.remedy))
    return msgspec.structs.replace(seen.status, limits=tuple(each.code for each in limits), limit_details=tuple(limits))


def _curves(telemetry: Sequence[Telemetry], width: int, rows: int) -> Table:
    """Return a table with `rows` lines for each of CURVES, apart where they are higher than one."""
    ends_wide = ENDS if width >= NARROW else 0
    count = max(width - LABEL - VALUE - ends_wide - 3, 8)
    table = Table.grid(padding=(0, 1, 0, 0))
    for column in (LABEL, VALUE, count, *([ends_wide] if ends_wide else [])):
        table.add_column(width=column, no_wrap=True, overflow="ellipsis")
    times_ns = [each.t_ns for each in telemetry]
    courses = [
        columns(times_ns, [curve.value(it) for it in telemetry], count, COLUMN_NS, curve.of_column) for curve in CURVES
    ]
    scales: dict[str, list[float | None]] = {}
    for curve, course in zip(CURVES, courses, strict=True):
        scales.setdefault(curve.unit, []).extend(course)
    for curve, course in zip(CURVES, courses, strict=True):
        low, high = span(scales[curve.unit], curve.least)
        newest = curve.value(telemetry[-1]) if telemetry else None
        shown = "-" if newest is None else f"{newest:.{curve.digits}f}"
        digits = min(curve.digits, 2)
        cells = (
            Text(curve.label, "bold"),
            Text(f"{shown:>7} {curve.unit}"),
            Text("\n".join(sparkline(course, low, high, rows)), curve.style),
            Text(f"{low:.{digits}f}..{high:.{digits}f}", "dim"),
        )
        table.add_row(*cells[: len(table.columns)])
        if rows > 1:
            table.add_row()
    return table


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
