"""Histograms of durations as the benchmarks show them: both axes logarithmic, for it is the tail that matters."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

LEAST_US = 1.0
"A shorter duration is shown as this one."
BINS = 120


def plot_histograms(path: Path, title: str, durations_us: Mapping[str, Array]) -> None:
    """One outline for each set, us, as the share of its values in each bin; the labels have p50, p99 and p99.9."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    largest = max(float(values.max()) for values in durations_us.values())
    edges = np.geomspace(LEAST_US, 1.1 * max(largest, LEAST_US), BINS + 1)
    for name, values in durations_us.items():
        shares, _ = np.histogram(np.maximum(values, LEAST_US), edges)
        p50, p99, p999 = np.percentile(values, [50.0, 99.0, 99.9])
        axes.stairs(shares / values.size, edges, label=f"{name}: p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f} us")
    axes.set(xscale="log", yscale="log", xlabel="us", ylabel="share of all", title=title)
    axes.grid(which="both", alpha=0.2)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    figure.savefig(path, dpi=120)
