"""The pictures of docs/learned_inverse.md."""

import numpy as np
from matplotlib.figure import Figure

from tormagd.lab.arrays import Array
from tormagd.lab.pages import subplots
from tormagd.lab.tactile.models import SCORED_SLOPE_N_MT, Trained
from tormagd.lab.training.dataset import Dataset
from tormagd.model.features import FIELD

CLASSES = {25.0: "MRE-A, 25 %", 35.0: "MRE-B, 35 %", 45.0: "MRE-C, 45 %"}
SHOWN_FIELDS = (0, 3, 6, 10)
SHOWN_RATE_MM_S = 1.0


def pictures(trained: Trained, traces: dict[str, Array]) -> dict[str, Figure]:
    """Draw the pictures of the page by file name: the data of table 4.1 with the network's force, and the pulse."""
    return {"tactile_fit": _fit(trained), "tactile_pulse": _pulse(traces)}


def _last_cycle(cycles: Dataset, cip_percent: float, field_mT: float) -> Dataset:
    """Return the rows of the last cycle at 1 mm/s, both ways, of the class with this iron and of this field.

    Both have to be values of the data, exactly. Raises LabError where under two rows are of them.
    """
    _, rate_mm_s, fields_mT, classes = cycles.features.T
    is_slow = np.isclose(np.abs(rate_mm_s), SHOWN_RATE_MM_S)
    rows = cycles.subset((classes == cip_percent) & (fields_mT == field_mT) & is_slow)
    assert rows.cycle is not None  # the pads' records have them
    return rows.subset(rows.cycle == rows.cycle.max())


def _fit(trained: Trained) -> Figure:
    """Draw forces over displacement, data as dots and the network as a line: an axis for each class, at four of the
    fields."""
    figure, axes = subplots((11.0, 3.8), 1, 3)
    axes[0].set_ylabel("force, N")
    figure.suptitle("Data and network at 1 mm/s (synthetic; like figures 4.3 and 4.4)")
    cycles = trained.cycles.data
    shown_mT = np.unique(cycles.features[:, FIELD])[list(SHOWN_FIELDS)]
    for axis, (cip_percent, title) in zip(axes, CLASSES.items(), strict=True):
        axis.set(xlabel="displacement, mm", title=title)
        for index, field_mT in enumerate(shown_mT):
            rows = _last_cycle(cycles, cip_percent, field_mT)
            displacement_mm = rows.features[:, 0]
            label = f"data, {field_mT:.0f} mT"
            axis.plot(displacement_mm, rows.force_N, ".", ms=4, color=f"C{index}", label=label)
            axis.plot(displacement_mm, trained.model.predict(rows.features), lw=1, color="black")
    axes[0].plot([], [], color="black", label="network")
    axes[0].legend()
    return figure


def _pulse(traces: dict[str, Array]) -> Figure:
    """Draw the pulse experiment over time in three axes: force and displacement, the fields found, and their errors.

    `traces` are those of `pulse.pulse_on`. Where errors are not scored the third axis is grey.
    """
    time_s = traces["time_s"]
    figure, (inputs, fields, errors) = subplots((11.0, 9.0), 3, 1, sharex=True)
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
