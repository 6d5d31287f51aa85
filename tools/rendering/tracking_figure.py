"""The picture of `force_tracking.py`: the pulse on the three samples, the staircase, the random devices."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from pictures.stamp import stamp

COLOURS = {"sample_1": "#d1495b", "sample_2": "#2a6f97", "sample_3": "#6a994e"}
PREVIEW, LIVE = "#7b2d8b", "#e39b2d"
ASKED, QUIET = "#222222", "#8d99ae"
CLOSE_UP_S = (12.0, 16.0)
BAR_MN = 18.0


def picture(path: Path, pulses: dict[str, Any], stairs: dict[str, Any], figures: dict[str, Any]) -> None:
    """Writes a PNG of what was measured, stamped with its figures; a part that was not is left empty."""
    figure, axes = plt.subplots(2, 2, figsize=(12, 7.5), constrained_layout=True)
    figure.suptitle("Forces asked and truly rendered by simulated devices (synthetic)", fontsize=13)
    for row, (name, found) in enumerate(pulses.items()):
        inside = (found.time_s >= CLOSE_UP_S[0]) & (found.time_s < CLOSE_UP_S[1])
        if not row:
            axes[0, 0].plot(found.time_s[inside], found.asked_N[inside], color=ASKED, linewidth=2.4, label="asked")
        axes[0, 0].plot(found.time_s[inside], found.rendered_N[inside], color=COLOURS[name], label=name)
        error_mN = (found.rendered_N - found.asked_N)[inside] * 1e3
        axes[0, 1].plot(found.time_s[inside], error_mN, color=COLOURS[name], linewidth=1.0, label=name)
    _dress(axes[0, 0], "Measured human pulse, with preview, after 12 s of trim", "force at the roller, N", "time, s")
    _dress(axes[0, 1], "Its error", "rendered - asked, mN", "time, s")
    for row, (name, found) in enumerate(stairs.items()):
        if not row:
            axes[1, 0].plot(found.time_s, found.asked_N, color=ASKED, linewidth=2.0, label="asked")
        axes[1, 0].plot(found.time_s, found.rendered_N, color=COLOURS[name], linewidth=0.9, label=name)
    _dress(axes[1, 0], "Staircase of 0.1 N, coronary scene", "force at the roller, N", "time, s")
    draws = figures.get("draws", [])
    for found in draws:
        rms_mN = np.sort([1e3 * row["rms_N"] for row in found["rows"]])
        label, colour = ("with preview", PREVIEW) if found["preview"] else ("live", LIVE)
        axes[1, 1].plot(np.arange(1, len(rms_mN) + 1), rms_mN, "o", markersize=4, color=colour, label=label)
    if draws:
        axes[1, 1].axhline(BAR_MN, color=QUIET, linestyle=":", label=f"{BAR_MN:g} mN")
        axes[1, 1].set_ylim(bottom=0.0)
        title = f"{draws[0]['count']} random devices, after 10 s of trim"
        axes[1, 1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 0.9))
        _dress(axes[1, 1], title, "RMS error, mN", "draws, each row sorted")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=110, metadata=stamp(figures))
    plt.close(figure)


def _dress(axes: Axes, title: str, quantity: str, along: str) -> None:
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_ylabel(quantity)
    axes.set_xlabel(along)
    axes.spines[["top", "right"]].set_visible(False)
