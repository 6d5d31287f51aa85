"""`benchmark scenes`: the trade of error for processor time, of every scene and of every variant of its model.

Nothing is measured here: the errors on the simulated device, and the costs beside their own `measured_machine_us`, are
those that `required_terms.py --store` measured.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import msgspec
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tormagd.assembly.build import Core, build_core
from tormagd.config import Config
from tormagd.lab.arrays import Json
from tormagd.lab.pages import stamp
from tormagd.lab.thesis.values import PULSE_MAE_MT
from tormagd.scenes.measured import JUDGED, MeasuredScene, measured, on_first
from tormagd.scenes.scene import EVERY_TERM, TERMS, load_scene

THESIS_HZ, THESIS_SOLVE_MS, THESIS_ERROR_N = 83, 4.0, 1.26
"Its controller's rate, the time of its search, and its network's mean error of the force, on its tactile element."
N_PER_MT = 0.0078
"What a field's error is worth on the torque brake: docs/inverse_trade.md, one reading's noise."
COLUMNS = 3


class Variant(NamedTuple):
    """One model of a scene: processor time, us per s of control, and RMS error on sample 1 while it is learned, N."""

    name: str
    cost_us_s: float
    rms_N: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark scenes`."""
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="also draw error over cost")


def measure(options: argparse.Namespace) -> Json:
    """`{scenes: [...], measured_machine_us}`: each scene's figures, and its variants."""
    file = measured()
    if options.plot is not None:
        draw(file.scenes, options.plot)
    scenes = [figures(scene) | {"variants": [each._asdict() for each in variants(scene)]} for scene in file.scenes]
    return {"scenes": scenes, "measured_machine_us": file.machine_us}


def figures(scene: MeasuredScene) -> Json:
    """One scene's decision as numbers. `full` is every term at the usual rates."""
    on_sample_1 = on_first(scene.judged)
    return {
        "name": scene.name,
        "terms_in": [term for term in TERMS if term not in scene.left_out],
        "terms_out": list(scene.left_out),
        "control_hz": scene.control_hz,
        "inference_hz": scene.inference_hz,
        "solver": core_without(scene.name, scene.left_out).solver.solver,
        "rms_N": on_sample_1.chosen_N,
        "rms_full_N": on_sample_1.full_N,
        "tolerance_N": scene.tolerance_N,
        "cost_us_per_s": scene.cost_us_s,
        "cost_full_us_per_s": scene.cost_full_us_s,
    }


def core_without(name: str, left_out: tuple[str, ...]) -> Core:
    """The core of a shipped scene without these terms."""
    terms = EVERY_TERM.without(*left_out)
    return build_core(Config(scene=name), msgspec.structs.replace(load_scene(name), terms=terms))


def variants(scene: MeasuredScene) -> list[Variant]:
    """All terms at every rate, each term left out and every search at the chosen rates, and what was chosen last."""
    all_N = on_first(scene.at_chosen.judged).chosen_N
    return [
        *(
            Variant(
                f"all terms, {at.control_hz} / {at.inference_hz} Hz",
                at.cost.us_s(*at.hz),
                on_first(at.judged).chosen_N,
            )
            for at in scene.rates
        ),
        *(
            Variant(f"without {item.term}", scene.us_s(item.cost), all_N + item.learning_added_N)
            for item in scene.terms
        ),
        *(Variant(f"required terms, {item.search}", scene.us_s(item.cost), item.rms_N) for item in scene.searches),
        Variant("chosen", scene.cost_us_s, on_first(scene.judged).chosen_N),
    ]


def front(every: list[Variant]) -> list[Variant]:
    """The variants that no cheaper one equals in error, the cheapest first."""
    best: list[Variant] = []
    for each in sorted(every, key=lambda each: (each.cost_us_s, each.rms_N)):
        if not best or each.rms_N < best[-1].rms_N:
            best.append(each)
    return best


def draw(scenes: tuple[MeasuredScene, ...], path: Path) -> None:
    """Error over cost, a panel for each scene: variants, Pareto front, full and chosen model, tolerance, the thesis."""
    rows = -(-len(scenes) // COLUMNS)
    figure = Figure(figsize=(12.0, 3.1 * rows + 0.6), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
    for panel, scene in zip(panels.flat, scenes, strict=False):
        _panel(panel, scene)
    for panel in panels.flat[len(scenes) :]:
        panel.set_visible(False)
    figure.supxlabel("processor time of steps and plans, % of one core")
    figure.supylabel("RMS error of the true force on sample 1, mN")
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    figure.savefig(path, dpi=100, metadata=stamp(scenes))


def _panel(panel: Axes, scene: MeasuredScene) -> None:
    every, allowed_mN = variants(scene), 1e3 * JUDGED * scene.tolerance_N
    best = front(every)
    panel.set(xscale="log", yscale="log", xlim=(0.1, 100.0), ylim=(1.0, 3e3), title=scene.name)
    panel.axhspan(1.0, allowed_mN, color="#e5f2e5", label=f"within {JUDGED:g} of the tolerance")
    panel.step(*_axes(best), where="post", color="0.4", linewidth=1.0, label="Pareto front")
    panel.plot(*_axes(every), ".", color="0.55", label="term left out, other rate, other search")
    panel.plot(*_axes(every[:1]), "o", mfc="white", color="#0072b2", markersize=8, label="all terms, 1000 / 500 Hz")
    panel.plot(*_axes(every[-1:]), "o", color="#d55e00", markersize=8, label="chosen")
    share = 0.1 * THESIS_HZ * THESIS_SOLVE_MS
    panel.plot(share, 1e3 * THESIS_ERROR_N, "k*", label=f"thesis: {THESIS_HZ} Hz x {THESIS_SOLVE_MS:g} ms; 1.26 N")
    error_mN = 1e3 * N_PER_MT * PULSE_MAE_MT
    panel.plot(share, error_mN, "k+", label=f"thesis: {PULSE_MAE_MT:g} mT, {error_mN:.0f} mN of this brake")
    saved = scene.cost_full_us_s / scene.cost_us_s
    panel.text(0.03, 0.9, f"{saved:.1f} times cheaper" if scene.left_out else "not met", transform=panel.transAxes)


def _axes(every: list[Variant]) -> tuple[list[float], list[float]]:
    return [each.cost_us_s / 1e4 for each in every], [1e3 * each.rms_N for each in every]
