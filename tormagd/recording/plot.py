"""One picture of a recording: what was asked, what was rendered, and what held it back."""

import io
from collections.abc import Iterable
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tormagd.bounded_file import in_place_of
from tormagd.recording.reader import Recording
from tormagd.recording.series import BREAK_S, Band, Series, bands, end_ns, series, start_ns, tracking_rms_N

FORMATS = (".png", ".svg", ".pdf")

# Okabe and Ito's palette, which stays apart for colour-blind eyes; red is kept for faults
BLACK, BLUE, ORANGE, SKY, GREEN, PINK = "#222222", "#0072b2", "#e69f00", "#56b4e9", "#009e73", "#cc79a7"
RED, GREY = "#d32f2f", "#9e9e9e"
STATE_COLOURS = {"DISABLED": "#d0d0d0", "ENABLED": GREEN, "PAUSED": SKY, "FAULT": RED}
LIMIT_COLOURS = (ORANGE, PINK, BLUE, "#8d6e63", "#7e57c2", "#f0c419")
LINES = {
    # measured lies under what was wanted: it is the noisy one, and the eye compares the two edges
    "force": (
        ("measured_cf", "measured", ORANGE, "-", 1.3),
        ("governed_cf", "governed (what the device can do)", BLUE, "-", 1.5),
        ("setpoint_cf", "asked", BLACK, "--", 1.3),
    ),
    # both carriages do nearly the same, as do wish and measurement: the upper line is thin, so that the lower one shows
    "gap": (("gap_mm", "measured", SKY, "-", 2.6), ("gap_setpoint_mm", "wanted", BLACK, "-", 0.7)),
    "duty": (("left_duty", "left", SKY, "-", 2.6), ("right_duty", "right", BLACK, "-", 0.7)),
}
"Of each panel, the lowest first: quantity, name, colour, style and width."


def figure(recording: Recording, title: str) -> Figure:
    """Four panels over one time axis: force, gap, duty, and lanes naming the state, limits and faults at each moment.

    Raises ValueError for a recording without messages.
    """
    begin = start_ns(recording)
    faults, limits = bands(recording, "faults"), bands(recording, "limits")
    states = bands(recording, "operating_state")
    lanes = bool(states) + len(limits) + max(1, len(faults))
    fig = Figure(figsize=(12.0, 7.6 + 0.25 * lanes), layout="constrained")
    heights = (4.2, 2.2, 1.6, 0.3 + 0.3 * lanes)
    force, gap, duty, lane = fig.subplots(4, 1, sharex=True, height_ratios=heights)

    for axes, quantity, label in (
        (force, "force", "force (N)"),
        (gap, "gap", "gap (mm)"),
        (duty, "duty", "drive duty"),
    ):
        for name, text, colour, style, width in LINES[quantity]:
            _line(axes, series(recording, name), text, colour, style, width)
        _dress(axes, label, quantity)
    duty.axhline(0.0, color=GREY, linewidth=0.6, zorder=0)
    duty.set_ylim(-1.08, 1.08)
    _lanes(lane, states, limits, faults)
    for axes in (force, gap, duty):
        for start, end in (span for band in faults for span in band.spans_s):
            axes.axvspan(start, end, color=RED, alpha=0.12, linewidth=0, zorder=0)

    when = datetime.fromtimestamp(begin / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    lane.set_xlabel(f"seconds since {when}")
    fig.suptitle(_headline(recording, title, faults), x=0.01, ha="left", fontsize=13, fontweight="bold")
    lane.set_xlim(0.0, max((end_ns(recording) - begin) / 1e9, 1e-3))
    return fig


def save_plot(recording: Recording, path: Path, title: str) -> None:
    """Draw `figure` into `path`. Raises ValueError for a suffix other than FORMATS, or without messages; OSError."""
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path.name}: allowed are names ending in {', '.join(FORMATS)}")
    picture = io.BytesIO()
    figure(recording, title).savefig(picture, format=path.suffix[1:].lower(), dpi=110)
    # a full disk leaves neither half a picture nor takes the one that was there
    with in_place_of(path) as unfinished:
        unfinished.write_bytes(picture.getvalue())


def _headline(recording: Recording, title: str, faults: Iterable[Band]) -> str:
    error_N = tracking_rms_N(recording)
    names = ", ".join(band.name for band in faults)
    parts = [
        title,
        *(
            []
            if error_N is None
            else [f"measured minus asked {error_N * 1e3:.0f} mN rms (sensor noise and approach included)"]
        ),
        f"faults: {names}" if names else "no fault",
        *([] if recording.is_complete else ["recording cut short"]),
    ]
    return "  ·  ".join(parts)


def _line(axes: Axes, data: Series | None, label: str, colour: str, style: str, width: float) -> None:
    if data is None:
        return
    cuts = np.flatnonzero(np.diff(data.t_s) > BREAK_S) + 1
    t_s, values = np.insert(data.t_s, cuts, data.t_s[cuts]), np.insert(data.values, cuts, np.nan)
    axes.plot(t_s, values, style, label=label, color=colour, linewidth=width)


def _dress(axes: Axes, label: str, quantity: str) -> None:
    axes.set_ylabel(label)
    axes.grid(axis="both", color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.lines:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1, fontsize=9)
    else:
        axes.text(0.5, 0.5, f"no {quantity} recorded", transform=axes.transAxes, ha="center", va="center", color=GREY)


def _lanes(axes: Axes, states: tuple[Band, ...], limits: tuple[Band, ...], faults: tuple[Band, ...]) -> None:
    """One lane for the operating state, one for every limit and fault that occurred, each with its name and share."""
    rows: list[tuple[str, list[tuple[Band, str]]]] = [
        *([("state", [(band, STATE_COLOURS.get(band.name, GREY)) for band in states])] if states else []),
        *((f"limit {band.name}", [(band, colour)]) for band, colour in zip(limits, cycle(LIMIT_COLOURS), strict=False)),
        *([(f"FAULT {band.name}", [(band, RED)]) for band in faults] or [("no faults", [])]),
    ]
    for row, (_, parts) in enumerate(rows):
        for band, colour in parts:
            axes.broken_barh([(a, b - a) for a, b in band.spans_s], (row - 0.38, 0.76), facecolors=colour, linewidth=0)
            if row == 0 and states:
                _name_spans(axes, band, row)
    axes.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=9)
    for label, (name, _) in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_color(RED if name.startswith("FAULT") else BLACK)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="x", color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _name_spans(axes: Axes, band: Band, row: int) -> None:
    """The state's name inside its longest stretch; the clip keeps it from running over its neighbours' ends."""
    start, end = max(band.spans_s, key=lambda span: span[1] - span[0])
    axes.annotate(
        band.name,
        ((start + end) / 2, row),
        ha="center",
        va="center",
        fontsize=8,
        color="white" if band.name in ("ENABLED", "FAULT") else BLACK,
        clip_on=True,
    )
