"""The pictures of tools/tactile_experiment.py."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pictures.stamp import stamp

from tactile.models import SCORED_SLOPE_N_MT
from tormagd.simulation.pad import PadRecord
from tormagd.training.dataset import Array
from tormagd.training.forward import NetworkForward
from tormagd.training.splits import Mask

CLASSES = {25.0: "MRE-A, 25 %", 35.0: "MRE-B, 35 %", 45.0: "MRE-C, 45 %"}
SHOWN_FIELDS = (0, 3, 6, 10)
SHOWN_RATE_MM_S = 1.0
DPI = 80
LABEL_SIDES: tuple[dict[str, Any], ...] = ({"xytext": (7, 4)}, {"xytext": (-7, -4), "ha": "right", "va": "top"})


class Material(NamedTuple):
    """What the pictures are drawn from: the data of table 4.1 with what the network says, and the traces."""

    cycles: PadRecord
    predicted_N: Array
    held_out: Mask
    network: NetworkForward
    pulses: dict[str, Array]
    hold: dict[str, Array]


def draw_all(images: Path, material: Material, comparison: list[dict[str, Any]], figures: list[str]) -> None:
    """Writes all pictures as PNG into `images`, stamped with the page's figures."""
    for name, figure in {
        "tactile_fit": _fit(material),
        "tactile_training": _training(material),
        "tactile_pulse": _pulse(material.pulses),
        "tactile_hold": _hold(material.hold),
        "tactile_models": _models(comparison),
    }.items():
        figure.savefig(images / f"{name}.png", dpi=DPI, metadata=stamp(figures))


def _last_cycles(material: Material, cip_percent: float) -> list[tuple[float, NDArray[np.int64]]]:
    """(field, rows) of the last cycle at 1 mm/s, at some of the fields."""
    features = material.cycles.features
    chosen = []
    for field_mT in np.unique(features[:, 2])[list(SHOWN_FIELDS)]:
        rows = np.flatnonzero(
            (features[:, 3] == cip_percent)
            & (features[:, 2] == field_mT)
            & np.isclose(np.abs(features[:, 1]), SHOWN_RATE_MM_S)
        )
        cycle = material.cycles.cycle[rows]
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


def _fit(material: Material) -> Figure:
    figure, axes = _panels("Data and network at 1 mm/s (synthetic; like figures 4.3 and 4.4)")
    for axis, cip_percent in zip(axes, CLASSES, strict=True):
        for index, (field_mT, rows) in enumerate(_last_cycles(material, cip_percent)):
            displacement_mm = material.cycles.features[rows, 0]
            label = f"data, {field_mT:.0f} mT"
            axis.plot(displacement_mm, material.cycles.force_N[rows], ".", ms=4, color=f"C{index}", label=label)
            axis.plot(displacement_mm, material.predicted_N[rows], lw=1, color="black")
    axes[0].plot([], [], color="black", label="network")
    axes[0].legend()
    return figure


def _training(material: Material) -> Figure:
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    training = material.network.training
    assert training is not None
    epochs = [epoch.epoch for epoch in training.history]
    left.semilogy(epochs, [epoch.train_rmse_N for epoch in training.history], label="training")
    left.semilogy(epochs, [epoch.validation_rmse_N for epoch in training.history], "--", label="validation")
    left.set(xlabel="epoch", ylabel="force error, N rms", title="Levenberg-Marquardt (figure 4.5a)")
    left.legend()
    held = np.flatnonzero(material.held_out)[::7]
    measured, predicted = material.cycles.force_N[held], material.predicted_N[held]
    middle.plot(measured, predicted, ".", ms=2, alpha=0.4)
    middle.plot([0, measured.max()], [0, measured.max()], color="black", lw=0.8)
    middle.set(xlabel="force of the test rows, N", ylabel="predicted, N", title="Test rows (figure 4.5b)")
    right.hist((predicted - measured), bins=80, density=True, label="network - data")
    noise = (material.cycles.true_force_N - material.cycles.force_N)[held]
    right.hist(noise, bins=80, density=True, histtype="step", color="black", label="the sensor's noise")
    right.set(xlabel="force error of the test rows, N", title="Against the noise floor")
    right.margins(y=0.3)
    right.legend(loc="upper left")
    figure.suptitle("Training of the 4-50-1 network (synthetic data)")
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


def _hold(traces: dict[str, Array]) -> Figure:
    minutes = traces["time_s"] / 60
    figure = Figure(figsize=(11, 6), layout="constrained")
    forces, errors = figure.subplots(2, 1, sharex=True)
    labels = {"without": "network alone", "with": "network and relaxation"}
    for index, (name, label) in enumerate(labels.items()):
        error = 100 * (traces[name] - traces["asked"]) / traces["asked"]
        forces.plot(minutes, traces[name], lw=0.3, color=f"C{index}", label=label)
        errors.plot(minutes, error, lw=0.5, color=f"C{index}", label=label)
    forces.set(ylabel="force rendered, N", title="Pulses on a held pad, feed-forward only (synthetic)")
    errors.axhspan(-3, 3, color="grey", alpha=0.15, label="3 %")
    errors.set(xlabel="time held, min (virtual)", ylabel="force error, %")
    errors.legend(loc="center right")
    return figure


def _models(comparison: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axis = figure.subplots()
    # neighbours' labels stand on either side of their points
    for number, row in enumerate(sorted(comparison, key=lambda row: row["predict_us_per_row"])):
        place = row["predict_us_per_row"], row["random_mae_N"]
        axis.loglog(*place, "o" if row["pareto"] else "x", color="C3" if row["pareto"] else "C7")
        axis.annotate(row["model"], place, textcoords="offset points", fontsize=9, **LABEL_SIDES[number % 2])
    for scale in (axis.xaxis, axis.yaxis):
        scale.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.set(
        xlabel="prediction, µs a row",
        ylabel="MAE on the random split, N",
        title="Forward models: none is both faster and better than the dots (synthetic)",
    )
    axis.margins(x=0.25, y=0.15)
    return figure
