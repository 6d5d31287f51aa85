"""What `benchmark inverse` leaves behind: a page and its plot."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from pictures.stamp import stamp, tables

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "inverse_trade.md"
PLOT = ROOT / "docs" / "images" / "inverse_trade.png"

COLUMNS = (
    ("search", "{name}"),
    ("units", "{hidden}"),
    ("type", "{dtype}"),
    ("threads", "{threads}"),
    ("p50 us", "{p50_us:.1f}"),
    ("p99 us", "{p99_us:.1f}"),
    ("p99.9 us", "{p999_us:.1f}"),
    ("solves", "{solves}"),
    ("solver MAE mT", "{solver_mae_mT:.2g}"),
    ("solver max mT", "{solver_max_mT:.2g}"),
    ("plant MAE mT", "{plant_mae_mT:.3f}"),
    ("plant max mT", "{plant_max_mT:.2f}"),
    ("force MAE mN", "{force_mN:.2f}"),
    ("memory kB", "{memory_kB:.1f}"),
    ("Pareto", "{star}"),
)
LEAST_SHOWN_MT = 1e-6
"Newton comes to 1e-11 mT, which would squeeze what matters; the axis says so."
MARKERS = {
    "thesis-linear": "v",
    "linear-argmin": "^",
    "linear-argmin curve": ">",
    "vectorised-argmin": "s",
    "nearest": "o",
    "coarse-to-fine": "D",
    "newton": "*",
    "newton-rising": "d",
    "brent": "P",
    "k-d tree": "X",
    "direct": "h",
    "closed form": "p",
}


def write(result: dict[str, Any]) -> None:
    """Rewrites page and plot."""
    text = page(result)
    plot(result, PLOT, tables(text))
    PAGE.write_text(text)


def lines(result: dict[str, Any], separator: str = "  ") -> list[str]:
    """The table of variants, aligned, and the choice."""
    cells = [[title for title, _ in COLUMNS], *(_cells(row) for row in result["variants"])]
    widths = [max(len(row[column]) for row in cells) for column in range(len(COLUMNS))]
    table = [separator.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in cells]
    return [*table, "", *_choices(result), *_comparisons(result)]


def page(result: dict[str, Any]) -> str:
    """docs/inverse_trade.md."""
    titles = [title for title, _ in COLUMNS]
    table = ["| " + " | ".join(titles) + " |", "|" + " --- |" * len(titles)]
    table += ["| " + " | ".join(_cells(row)) + " |" for row in result["variants"]]
    found = ", ".join(f"{name} {value}" for name, value in result["environment"].items())
    refusals = [f"- {name}: {why}" for name, why in result["refused"].items()] or ["- none"]
    return "\n".join(
        (
            TEXT.format(environment=found, workload=result["workload"]),
            "",
            "## The choice",
            "",
            *(f"- {line}" for line in _choices(result)),
            "",
            "## Against the thesis's search, and precision",
            "",
            *(f"- {line}" for line in _comparisons(result)),
            "",
            "Networks that a search refused:",
            "",
            *refusals,
            "",
            "## Every variant",
            "",
            *table,
            "",
        )
    )


TEXT = """# Speed against accuracy of the inverse

Written by `python tools/evidence.py inverse` with [its figures](evidence/inverse.json); do not edit. Synthetic data
throughout: {workload}.
One process, one thread unless a row says otherwise, garbage collector frozen as in the daemon ({environment}).

A solve gets a state of the handle, a force and the last field, and answers with a field, its confidence and its reach.
The curve of force over field for that state is made in the time shown.
Two errors are kept apart. The *solver error* is the distance to the network's own nearest root, found by bisection that
shares no code with the searches. The *plant error* is the distance to the field at which the simulated element gives
the force; it holds the network's error too, and no search can be better than its network. *Force* is the plant's force
at the answer less the force asked. The noise of the force sensor is in the training data, not in the forces asked.

The plant of this page has pre-sliding and Stribeck friction, which the closed form does not know, and no hysteresis or
relaxation: those are errors of the model whatever the search, and are measured elsewhere.

![p50 against the solver error and against the plant error](images/inverse_trade.png)

- `thesis-linear`: row by row in torch, 1 mT, stops within the network's mean error of the force (the thesis's rule).
- `linear-argmin`: row by row in torch, every row; `linear-argmin curve`: the same with the force curve.
- `vectorised-argmin`: the whole network on the whole grid at once in torch.
- `nearest`: the curve over the grid in numpy, the k nearest, then interpolation. k decides only among touching points
  and plateaus, which this workload does not have.
- `coarse-to-fine`, `newton`, `brent`: a look at a grid of that step in numpy, then a finer grid, Newton's method kept
  in its bracket, or scipy's brentq, in the bracket nearest the last field.
- `newton-rising`: Newton's method from the last field, the whole range its bracket, where the force is known to rise.
  It is what the daemon runs as `newton`, because it refuses a model whose force falls.
- `k-d tree`: the mean of the k nearest of precomputed samples (scipy). `direct`: a second network that learned the
  inverse. `closed form`: the magnetoelastic law inverted, without the network.

Times of the rows are from several rounds over all variants, so that a disturbance of the machine meets all alike; their
p99 and p99.9 still hold whatever else ran (the load average counts this program as 1). The choice is
measured at length under the daemon's scheduling where the kernel grants it.

Pareto marks the one-thread variants that no faster one equals in plant error; differences under one encoder count of
the gap (about 0.02 mT) do not count. The daemon may run `nearest`, `coarse-to-fine` and `newton` (measured as
`newton-rising`), and runs `newton` where a scene names no other. The others are for the laboratory: they need scipy or
a training at start, do not use the learned model, or are baselines.

The plant errors of this page, 0.23 mT among them, belong to networks trained for it, on this workload's own device
without memory. How good the *shipped* model is over its box is measured by `tools/envelope.py`, and said in
[control.md](control.md#the-envelope)."""


def plot(result: dict[str, Any], path: Path, figures: list[str]) -> None:
    """Two panels over p50: the solver's error at one network, and the plant's error for every network."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    rows = [row for row in result["variants"] if row["threads"] == 1]
    usual = max({row["hidden"] for row in rows}, key=lambda size: sum(row["hidden"] == size for row in rows))
    _scatter(left, [row for row in rows if row["hidden"] == usual], "solver_mae_mT")
    colours = _scatter(right, rows, "plant_mae_mT")
    front = sorted((row for row in rows if row["pareto"]), key=lambda row: row["p50_us"])
    right.step(
        [row["p50_us"] for row in front],
        [row["plant_mae_mT"] for row in front],
        where="post",
        color="0.5",
        linewidth=1,
        zorder=0,
        label="Pareto",
    )
    left.set(title=f"against the network's own root, {usual} units", ylabel="mean field error, mT (1e-6: that or less)")
    right.set(title="against the plant; colour: hidden units")
    right.axhline(result["noise_bound_mae_mT"], color="0.7", linestyle=":", label="noise of one force reading")
    handles, labels = left.get_legend_handles_labels()
    extra = [handle for handle in right.get_legend_handles_labels()[0] if handle.get_label() not in labels]
    right.legend(handles=extra, loc="upper right", fontsize=8)
    right.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    right.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    right.yaxis.set_minor_formatter(NullFormatter())
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8)
    figure.colorbar(colours, ax=right, label="hidden units")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130, metadata=stamp(figures))


def _scatter(axes: Axes, rows: list[dict[str, Any]], error: str) -> Any:
    last = None
    sizes = [row["hidden"] for row in rows]
    for solver, marker in MARKERS.items():
        points = [row for row in rows if row["solver"] == solver]
        if points:
            last = axes.scatter(
                [row["p50_us"] for row in points],
                [max(row[error], LEAST_SHOWN_MT) for row in points],
                c=[row["hidden"] for row in points],
                vmin=min(sizes),
                vmax=max(sizes),
                marker=marker,
                s=40,
                edgecolors="black",
                linewidths=0.4,
                label=solver,
            )
    axes.set(xscale="log", yscale="log", xlabel="time of a solve, us (p50)")
    axes.grid(alpha=0.3)
    return last


def _cells(row: dict[str, Any]) -> list[str]:
    shown = row | {"force_mN": 1e3 * row["force_mae_N"], "star": "*" if row.get("pareto") else ""}
    return [form.format(**shown) for _, form in COLUMNS]


def _choices(result: dict[str, Any]) -> list[str]:
    beaten = "; ".join(result["beaten"]) or "nowhere"
    said = [
        "where `newton`, as the daemon runs it, is slower than another search of the daemon's by more than a tenth, or "
        f"less exact by more than 1 uN: {beaten}"
    ]
    alike: dict[str, list[str]] = {}
    for scene, row in result["chosen"].items():
        alike.setdefault(_choice(row), []).append(f"{scene} ({1e3 * row['tolerance_rms_N']:g} mN)")
    return [*said, *(f"{', '.join(scenes)}: {choice}" for choice, scenes in alike.items())]


def _choice(row: dict[str, Any]) -> str:
    others = ", ".join(
        f"{name} {errors['plant_mae_mT']:.1f} mT, {1e3 * errors['force_mae_N']:.0f} mN"
        for name, errors in row["mismatched"].items()
    )
    return (
        f"{row['name']}, {row['dtype']}. Over {row['solves']} solves ({'FIFO' if row['fifo'] else 'no FIFO'}) "
        f"p50 {row['p50_us']:.1f} us, p99 {row['p99_us']:.1f} us, p99.9 {row['p999_us']:.1f} us; plant error "
        f"{row['plant_mae_mT']:.2f} mT mean, {row['plant_max_mT']:.2f} mT max, {1e3 * row['force_mae_N']:.1f} mN. "
        f"On plants it was not trained on (no trim): {others}."
    )


def _comparisons(result: dict[str, Any]) -> list[str]:
    ratios = ", ".join(f"{name} {ratio:.1f}" for name, ratio in result["speedup"].items())
    return [
        f"times faster (p50) than, on the same network: {ratios}",
        *(
            f"float32 against float64, {name}: {found['max_mT']:.2g} mT at most, {found['mean_mT']:.2g} mT mean"
            for name, found in result["float32_against_float64"].items()
        ),
        f"one force reading's noise alone, 0.8 sigma / (dF/dB): {result['noise_bound_mae_mT']:.2f} mT mean",
    ]
