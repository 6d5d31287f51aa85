"""The pictures of docs/learned_inverse.md."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tormagd.lab.arrays import Array
from tormagd.lab.tactile.models import SCORED_SLOPE_N_MT, Trained
from tormagd.lab.tactile.pads import PadRecord

CLASSES = {25.0: "MRE-A, 25 %", 35.0: "MRE-B, 35 %", 45.0: "MRE-C, 45 %"}
SHOWN_FIELDS = (0, 3, 6, 10)
SHOWN_RATE_MM_S = 1.0


def pictures(trained: Trained, traces: dict[str, Array]) -> dict[str, Figure]:
    """Every picture by the name of its file: the data of table 4.1 with what the network says, and the pulse."""
    return {"tactile_fit": _fit(trained), "tactile_pulse": _pulse(traces)}


def _last_cycles(cycles: PadRecord, cip_percent: float) -> list[tuple[float, NDArray[np.int64]]]:
    """(field, rows) of the last cycle at 1 mm/s, at some of the fields."""
    features = cycles.features
    chosen = []
    for field_mT in np.unique(features[:, 2])[list(SHOWN_FIELDS)]:
        rows = np.flatnonzero(
            (features[:, 3] == cip_percent)
            & (features[:, 2] == field_mT)
            & np.isclose(np.abs(features[:, 1]), SHOWN_RATE_MM_S)
        )
        cycle = cycles.cycle[rows]
        chosen.append((float(field_mT), rows[cycle == cycle.max()]))
    return chosen


def _panels(title: str, width: float = 11.0) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, 3.8), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, label in zip(axes, CLASSES.values(), strict=True):
        axis.set(xlabel="displacement, mm", title=label)
    axes[0].set_ylabel("force, N")
    figure.suptitle(title)
    return figure, axes


def _fit(trained: Trained) -> Figure:
    figure, axes = _panels("Data and network at 1 mm/s (synthetic; like figures 4.3 and 4.4)")
    for axis, cip_percent in zip(axes, CLASSES, strict=True):
        for index, (field_mT, rows) in enumerate(_last_cycles(trained.cycles, cip_percent)):
            features = trained.cycles.features[rows]
            label = f"data, {field_mT:.0f} mT"
            axis.plot(features[:, 0], trained.cycles.force_N[rows], ".", ms=4, color=f"C{index}", label=label)
            axis.plot(features[:, 0], trained.model.predict(features), lw=1, color="black")
    axes[0].plot([], [], color="black", label="network")
    axes[0].legend()
    return figure


def _pulse(traces: dict[str, Array]) -> Figure:
    time_s = traces["time_s"]
    figure = Figure(figsize=(11, 9), layout="constrained")
    inputs, fields, errors = figure.subplots(3, 1, sharex=True)
    inputs.plot(time_s, traces["force_N"], color="C3", lw=1, label="force, N")
    inputs.set(ylabel="force, N", title="What the searches are given (like figure 4.6; synthetic)")
    beside = inputs.twinx()
    beside.plot(time_s, traces["displacement_mm"], color="C0", lw=1)
    beside.set_ylabel("displacement, mm", color="C0")
    inputs.yaxis.label.set_color("C3")
    ways = {"mlp": "network alone", "relaxation_aware": "network and relaxation"}
    fields.plot(time_s, traces["reference"], color="black", lw=1.5, label="reference")
    for index, (way, label) in enumerate(ways.items()):
        fields.plot(time_s, traces[way], lw=0.9, color=f"C{index}", label=label)
        errors.plot(time_s, traces[way] - traces["reference"], lw=0.9, color=f"C{index}", label=label)
    fields.set(ylabel="field, mT", title="Reference field and the fields found (like figure 4.7a)")
    fields.legend(loc="upper right")
    errors.set(
        xlabel="time, s", ylabel="field error, mT", ylim=(-40, 60), title="Error of the field (like figure 4.7b)"
    )
    unscored = traces["slope_N_mT"] < SCORED_SLOPE_N_MT
    errors.fill_between(time_s, -40, 60, where=unscored, color="grey", alpha=0.3, label="not scored: dF/dB too small")
    errors.legend(loc="upper right")
    errors.axhline(0, color="grey", lw=0.6)
    return figure
