"""Histograms of durations as the benchmarks show them: both axes logarithmic, for it is the tail that matters."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7")
LEAST_US = 1.0
"A shorter duration is shown as this one."
BINS = 120


def plot_histograms(path: Path, title: str, durations_us: Mapping[str, Array]) -> None:
    """One outline for each set, us, as the share of its values in each bin, with its p50, p99 and p99.9 marked."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    shown = {name: np.maximum(values, LEAST_US) for name, values in durations_us.items()}
    largest = max(float(values.max()) for values in shown.values())
    smallest = min(float(values.min()) for values in shown.values())
    edges = np.geomspace(0.9 * smallest, 1.1 * largest, BINS + 1)
    for (name, values), colour in zip(shown.items(), COLOURS, strict=False):
        shares, _ = np.histogram(values, edges)
        p50, p99, p999 = np.percentile(values, [50.0, 99.0, 99.9])
        label = f"{name}: p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f} us"
        axes.stairs(shares / values.size, edges, color=colour, label=label)
        for value, style in ((p50, "-"), (p99, "--"), (p999, ":")):
            axes.axvline(value, color=colour, linestyle=style, linewidth=0.8, alpha=0.7)
    axes.set(xscale="log", yscale="log", xlabel="us", ylabel="share of all", title=title, xlim=(edges[0], edges[-1]))
    axes.grid(which="both", alpha=0.2)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    figure.savefig(path, dpi=120)
