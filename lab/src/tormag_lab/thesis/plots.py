"""The pictures of docs/reproduction.md."""

from typing import Any

import numpy as np

from tormag_lab.arrays import Json
from tormag_lab.pages import subplots
from tormag_lab.thesis.step_test import StepTest
from tormagd.view.drawing import Axes, Figure

MEASURED, THESIS, OURS, FREE = "#222222", "#8d99ae", "#d1495b", "#2a7f9e"


def pictures(result: Json, tests: list[StepTest]) -> dict[str, Figure]:
    drawn = {"figure_2_5": _figure_2_5(result["figure_2_5"])}
    if "figure_2_7" in result:
        drawn["figure_2_7"] = _figure_2_7(result["figure_2_7"], tests)
    return drawn


def _figure_2_5(data: Json) -> Figure:
    """Draw the least and greatest force by Eq. 7 over shear modulus and permeability."""
    figure = Figure(figsize=(7.5, 5.4), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    moduli, permeabilities = np.meshgrid(data["shear_modulus_kPa"], data["relative_permeability"])
    for key, colour in (("most_N", OURS), ("least_N", FREE)):
        axes.plot_surface(moduli, permeabilities, np.array(data["eq_7"][key]), color=colour, alpha=0.75)
    least, most = data["thesis_working_point_N"]
    axes.scatter([277.0] * 2, [4.0] * 2, [least, most], color=MEASURED, s=30, depthshade=False)
    axes.text(150.0, 4.0, most + 3.6, "dots: thesis, working point")
    axes.set(xlabel="shear modulus, kPa", ylabel="relative permeability", zlabel="force, N")
    axes.set_title("most (45 mm, red) and least (95 mm, blue) force", fontsize=10)
    axes.set_box_aspect(None, zoom=0.86)
    return figure


def _figure_2_7(data: Json, tests: list[StepTest]) -> Figure:
    """Draw the step tests beside the force law, and the force ranges of all inserts."""
    figure, (axes, ranges) = subplots((12.0, 4.2), 1, 2)
    for test, row, colour in zip(tests, data["rows"], (OURS, FREE, THESIS), strict=True):
        axes.plot(test.time_s, test.force_N, color=colour, linewidth=0.9, label=f"{test.insert}, simulated device")
        for index, force in enumerate(row["analytic_N"]):
            hold = test.time_s[-1] / len(row["analytic_N"])
            axes.plot([index * hold, (index + 1) * hold], [force] * 2, color=MEASURED, linewidth=1.0, linestyle="--")
    axes.plot([], [], color=MEASURED, linestyle="--", linewidth=1.0, label="force law at the settled gap")
    axes.set(
        xlabel="time, s (virtual)", ylabel="force at the roller, N", xlim=(0.0, tests[0].time_s[-1]), ylim=(0, None)
    )
    axes.legend(frameon=False, loc="upper left")
    _force_ranges(ranges, data["ranges"])
    return figure


def _force_ranges(axes: Axes, rows: list[Json]) -> None:
    for place, (matrix, colour) in enumerate(
        zip(dict.fromkeys(row["matrix"] for row in rows), (OURS, FREE, THESIS), strict=True)
    ):
        own = [row for row in rows if row["matrix"] == matrix]
        at = [row["cip_percent"] + 2.4 * (place - 1) for row in own]
        least_N, most_N, measured_N = ([row[key] for row in own] for key in ("least_N", "most_N", "measured_range_N"))
        axes.bar(at, np.subtract(most_N, least_N), 2.2, least_N, color=colour, label=f"{matrix}, force law")
        axes.plot(at, np.add(least_N, measured_N), "_", color=MEASURED, markersize=11)
    axes.plot([], [], "_", color=MEASURED, label="range measured in the thesis")
    axes.set(xlabel="iron, % by volume", ylabel="least to greatest force, N", ylim=(0, None))
    axes.legend(frameon=False, loc="upper left")
