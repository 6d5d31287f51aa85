"""The page and the plot that `benchmark inverse --write` leaves behind."""

from pathlib import Path
from typing import Any

from tormagd.lab.pages import figures_of, stamp, subplots, table
from tormagd.view.drawing import Axes

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "inverse_trade.md"
PLOT = ROOT / "docs" / "images" / "inverse_trade.png"

USUAL_HIDDEN = 50
COLUMNS = {
    "search": "{name}",
    "p50 us": "{p50_us:.1f}",
    "p99 us": "{p99_us:.1f}",
    "solver MAE mT": "{solver_mae_mT:.2g}",
    "plant MAE mT": "{plant_mae_mT:.3f}",
    "force MAE N": "{force_mae_N:.4f}",
    "Pareto": "{pareto}",
}
MIN_SHOWN_MT = 1e-6
"Newton comes to 1e-11 mT, which would squeeze what matters; the page says so."
MARKERS = {
    "thesis-linear": "v",
    "linear-argmin": "^",
    "vectorised-argmin": "s",
    "nearest": "o",
    "torch": "D",
    "newton": "*",
}
TEXT = """# Speed against accuracy of the inverse

Written by `python tools/evidence.py inverse` with [all its figures](evidence/inverse.json); do not edit. All data are
synthetic: {workload}. One process, one thread, garbage collector frozen ({environment}).

The *solver error* is the distance to the network's own nearest root, the *plant error* to the field at which the
simulated element gives the force. *Force* is the plant's force at the answer minus the force asked.

![p50 against the solver error and against the plant error](images/inverse_trade.png)

- `thesis-linear`, the daemon's `thesis`, goes row by row in torch at 1 mT by the thesis's rule. `linear-argmin`
  looks at every row, `vectorised-argmin` at the whole grid at once.
- `torch` is the network over the grid in torch, the k nearest, then interpolation. `nearest` is the same in NumPy.
- `newton` is Newton's method from the last field, on the same network {speedup_vs_thesis_linear:.0f} times as fast
  as the thesis's search.

*Pareto* marks variants that no faster one equals in plant error, to an encoder count of the gap (about 0.02 mT).
[The shipped networks](guides/insert.md#the-shipped-models) are others.

## All searches on {usual} units, and the Pareto variants of every size

{table}"""


def write(result: dict[str, Any]) -> None:
    text = page(result)
    plot(result, figures_of(text))
    PAGE.write_text(text, encoding="utf-8")


def page(result: dict[str, Any]) -> str:
    shown = [row for row in result["variants"] if row["pareto"] or row["hidden"] == USUAL_HIDDEN]
    stars = [
        row
        | {"pareto": "*" if row["pareto"] else ""}
        | {"name": row["name"] + (f", {row['hidden']} units" if row["hidden"] != USUAL_HIDDEN else "")}
        for row in shown
    ]
    texts = {
        "environment": ", ".join(f"{name} {value}" for name, value in result["environment"].items()),
        "usual": USUAL_HIDDEN,
        "table": table(COLUMNS, [[form.format(**row) for form in COLUMNS.values()] for row in stars]),
    }
    return TEXT.format(**(result | texts))


def plot(result: dict[str, Any], figures: list[str]) -> None:
    """Draw two panels over p50: the solver's error at one network, and the plant's for every network."""
    figure, (left, right) = subplots((11, 5), 1, 2)
    rows = result["variants"]
    _scatter(left, [row for row in rows if row["hidden"] == USUAL_HIDDEN], "solver_mae_mT")
    _scatter(right, rows, "plant_mae_mT")
    front = sorted((row["p50_us"], row["plant_mae_mT"]) for row in rows if row["pareto"])
    right.step(*zip(*front, strict=True), where="post", color="0.5", linewidth=1, zorder=0)
    left.set(title=f"against the network's own root, {USUAL_HIDDEN} units", ylabel="mean field error, mT")
    right.set(title="against the plant, all sizes")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)
    figure.savefig(PLOT, dpi=130, metadata=stamp(figures))


def _scatter(axes: Axes, rows: list[dict[str, Any]], error: str) -> None:
    for solver, marker in MARKERS.items():
        found = [row for row in rows if row["solver"] == solver]
        errors_mT = [max(row[error], MIN_SHOWN_MT) for row in found]
        axes.scatter([row["p50_us"] for row in found], errors_mT, marker=marker, s=40, alpha=0.8, label=solver)
    axes.set(xscale="log", yscale="log", xlabel="time of a solve, us (p50)")
    axes.grid(alpha=0.3)
