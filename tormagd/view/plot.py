"""One picture of a recording: what was asked, what was rendered, and what held the force back."""

import io
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path
from textwrap import fill

import numpy as np

from tormagd.ground.files import in_place_of
from tormagd.record.force_following import in_words
from tormagd.record.overview import BREAK_S, Overview, Series
from tormagd.view.drawing import Axes, Figure, rcParams

FORMATS = (".png", ".svg", ".pdf")

# Okabe and Ito's palette, for colour-blind eyes; red is kept for faults
BLACK, BLUE, ORANGE, SKY, GREEN, PINK = "#222222", "#0072b2", "#e69f00", "#56b4e9", "#009e73", "#cc79a7"
RED, GREY = "#d32f2f", "#9e9e9e"
STATE_COLOURS = {"DISABLED": "#d0d0d0", "ENABLED": GREEN, "PAUSED": SKY, "FAULT": RED}
LIMIT_COLOURS = (ORANGE, PINK, BLUE, "#8d6e63", "#7e57c2", "#f0c419")
LINES = {
    # measured lies below wanted: it is the noisy one
    "force": (
        ("measured_cf", "measured", ORANGE, "-", 1.3),
        ("governed_cf", "governed (what the device can do)", BLUE, "-", 1.5),
        ("setpoint_cf", "asked", BLACK, "--", 1.3),
    ),
    # both carriages do nearly the same: the upper line is thin, so that the lower one shows
    "gap": (("gap_mm", "measured", SKY, "-", 2.6), ("gap_setpoint_mm", "wanted", BLACK, "-", 0.7)),
    "duty": (("left_duty", "left", SKY, "-", 2.6), ("right_duty", "right", BLACK, "-", 0.7)),
}
"Of each panel, the lowest first: quantity, name, colour, style and width."


rcParams["text.parse_math"] = False
"A name with a dollar in it is no formula."

WIDE_IN = 12.0

Spans = dict[str, list[tuple[float, float]]]
"By code, from and to in seconds since the start."


def figure(overview: Overview, title: str, notes: Sequence[str] = ()) -> Figure:
    """Draw a recording as four panels over one time axis: force, gap, duty, and lanes for codes."""
    overview.require_messages()
    states, limits, faults = (overview.spans_s(kind) for kind in ("operating_state", "limits", "faults"))
    lanes = bool(states) + len(limits) + max(1, len(faults))
    fig = Figure(figsize=(WIDE_IN, 7.6 + 0.25 * lanes), layout="constrained")
    force, gap, duty, lane = fig.subplots(4, 1, sharex=True, height_ratios=(4.2, 2.2, 1.6, 0.3 + 0.3 * lanes))

    for axes, quantity, label in (
        (force, "force", "force (N)"),
        (gap, "gap", "gap (mm)"),
        (duty, "duty", "drive duty"),
    ):
        for name, text, colour, style, width in LINES[quantity]:
            _line(axes, overview.series(name), text, colour, style, width)
        _dress(axes, label, quantity)
    duty.axhline(0.0, color=GREY, linewidth=0.6, zorder=0)
    duty.set_ylim(-1.08, 1.08)
    _lanes(lane, overview, states, limits, faults)
    for axes in (force, gap, duty):
        held = [(start, end - start) for spans in faults.values() for start, end in spans]
        across = axes.get_xaxis_transform()
        axes.broken_barh(held, (0.0, 1.0), transform=across, color=RED, alpha=0.12, linewidth=0, zorder=0)
    for mark in overview.marks:
        at_s = (mark.t_ns - overview.start_ns) * 1e-9
        force.axvline(at_s, color=BLACK, linewidth=0.8, linestyle=":")
        force.annotate(
            mark.text[:40], (at_s, 1.0), xycoords=("data", "axes fraction"), fontsize=8, va="top", rotation=90
        )

    when = datetime.fromtimestamp(overview.start_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    lane.set_xlabel(f"seconds since {when}")
    fig.suptitle(_headline(overview, title, notes), x=0.01, ha="left", fontsize=13, fontweight="bold")
    lane.set_xlim(0.0, max(overview.duration_s, 1e-3))
    return fig


def picture(drawn: Figure, form: str) -> bytes:
    made = io.BytesIO()
    drawn.savefig(made, format=form, dpi=110)
    return made.getvalue()


def save_plot(drawn: Figure, path: Path, *sources: Path) -> None:
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path.name}: allowed are names ending in {', '.join(FORMATS)}")
    data = picture(drawn, path.suffix[1:].lower())
    # on a full disk the old picture stays
    with in_place_of(path, *sources) as unfinished:
        unfinished.write_bytes(data)


def _headline(overview: Overview, title: str, notes: Sequence[str]) -> str:
    names = ", ".join(overview.spans_s("faults"))
    how = in_words(overview.following)
    followed = [f"followed {how} (sensor noise included)"] if how else []
    return "\n".join(
        [f"{title}  ·  {f'faults: {names}' if names else 'no fault'}", *followed, *(fill(note, 100) for note in notes)]
    )


def _line(axes: Axes, data: Series | None, label: str, colour: str, style: str, width: float) -> None:
    if data is None:
        return
    # from the least to the greatest of each stretch, and on to the next
    t_s, values = np.repeat(data.t_s, 2), np.column_stack((data.low, data.high)).ravel()
    step_s = float(np.median(np.diff(data.t_s))) if data.t_s.size > 1 else 0.0
    cuts = np.flatnonzero(np.diff(t_s) > max(BREAK_S, 2.0 * step_s)) + 1
    axes.plot(
        np.insert(t_s, cuts, t_s[cuts]),
        np.insert(values, cuts, np.nan),
        style,
        label=label,
        color=colour,
        linewidth=width,
    )


def _dress(axes: Axes, label: str, quantity: str) -> None:
    axes.set_ylabel(label)
    axes.grid(axis="both", color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.lines:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1, fontsize=9)
    else:
        axes.text(0.5, 0.5, f"no {quantity} recorded", transform=axes.transAxes, ha="center", va="center", color=GREY)


def _lanes(axes: Axes, overview: Overview, states: Spans, limits: Spans, faults: Spans) -> None:
    """Draw one lane for the operating state and one for each limit and fault."""
    held_s = {name: codes.held_ns * 1e-9 for name, codes in overview.codes["limits"].items()}
    shares = {name: 100.0 * held_s[name] / max(overview.duration_s, 1e-3) for name in limits}
    rows: list[tuple[str, list[tuple[str, Spans, str]]]] = [
        *([("state", [(name, states, STATE_COLOURS.get(name, GREY)) for name in states])] if states else []),
        *(
            (f"limit {name} {shares[name]:.1f}%", [(name, limits, colour)])
            for name, colour in zip(limits, cycle(LIMIT_COLOURS), strict=False)
        ),
        *([(f"FAULT {name}", [(name, faults, RED)]) for name in faults] or [("no faults", [])]),
    ]
    for row, (_, parts) in enumerate(rows):
        for name, of, colour in parts:
            spans = of[name]
            axes.broken_barh([(a, b - a) for a, b in spans], (row - 0.38, 0.76), color=colour, linewidth=0.5)
            if row == 0 and states:
                _name_spans(axes, name, spans, row)
    axes.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=9)
    for label, (name, _) in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_color(RED if name.startswith("FAULT") else BLACK)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="x", color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _name_spans(axes: Axes, name: str, spans: list[tuple[float, float]], row: int) -> None:
    start, end = max(spans, key=lambda span: span[1] - span[0])
    axes.annotate(
        name,
        ((start + end) / 2, row),
        ha="center",
        va="center",
        fontsize=8,
        color="white" if name in ("ENABLED", "FAULT") else BLACK,
        clip_on=True,
    )
