"""The pictures of docs/reproduction.md."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from tormag_lab.arrays import Json
from tormag_lab.design.optimisation import Design, Problem
from tormag_lab.design.phase_portrait import Region
from tormag_lab.pages import subplots
from tormag_lab.thesis.page import best_start
from tormag_lab.thesis.step_test import StepTest
from tormag_lab.thesis.values import USE_CASES
from tormagd.view.drawing import Axes, Figure

MEASURED, THESIS, OURS, FREE, QUIET = "#222222", "#8d99ae", "#d1495b", "#2a7f9e", "#e9ecf2"


def pictures(result: Json, tests: list[StepTest]) -> dict[str, Figure]:
    drawn: dict[str, tuple[str, Callable[[Json], Figure]]] = {
        "figure_2_5": ("figure_2_5", _figure_2_5),
        "figure_2_7": ("figure_2_7", partial(_figure_2_7, tests=tests)),
        "figure_3_4": ("table_3_2", _figure_3_4),
    }
    return {name: draw(result[part]) for name, (part, draw) in drawn.items() if part in result}


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


def _figure_3_4(table: Json) -> Figure:
    """Draw our best and the thesis's best portrait for each use case and gap speed."""
    figure, axes = subplots((9.5, 7.6), 2, 2)
    for row, (number, case) in zip(axes, USE_CASES.items(), strict=True):
        for axis, objective in zip(row, ("true_thesis_speed", "true"), strict=True):
            speed = table["gap_speed_mm_s"][objective]
            best = best_start(table["starts"], number, objective)
            thesis = max(case.starts, key=lambda line: line.thesis_percent).thesis
            _region(axis, case.region)
            problem = Problem(case.region, "true", speed)
            _portrait(axis, problem, Design(*best["design"].values()), OURS, f"ours, {best['coverage']:.1%}")
            reached = problem.portrait(thesis).true_coverage(case.region)
            _portrait(axis, problem, thesis, THESIS, f"thesis's best, {reached:.1%}")
            _frame(axis, case.region, f"Use case {number}, gap speed {speed:.3g} mm/s")
    return figure


def _region(axis: Axes, region: Region) -> None:
    forces = [region.least_N, region.most_N, region.most_N, region.least_N, region.least_N]
    rates = [region.least_rate_N_s, region.most_rate_N_s, -region.most_rate_N_s, -region.least_rate_N_s]
    axis.fill(forces, [*rates, region.least_rate_N_s], color=QUIET, label="required")


def _portrait(axis: Axes, problem: Problem, design: Design, colour: str, label: str) -> None:
    portrait = problem.portrait(design)
    force, rate = portrait.outline()
    axis.plot([*force, *force[::-1], force[0]], [*rate, *-rate[::-1], rate[0]], color=colour, label=label)
    ends = portrait.trapezoid()
    corners = [ends.least_N, ends.most_N], [ends.least_rate_N_s, ends.most_rate_N_s]
    for sign in (1.0, -1.0):
        axis.plot(corners[0], sign * np.array(corners[1]), color=colour, linestyle=":", linewidth=1.0)


def _frame(axis: Axes, region: Region, title: str) -> None:
    axis.set_title(title, fontsize=10)
    axis.set(xlabel="force, N", ylabel="force rate, N/s", xlim=(-0.1, 1.35 * region.most_N))
    axis.set_ylim(-2.0 * region.most_rate_N_s, 2.0 * region.most_rate_N_s)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, fontsize=8, frameon=False)
