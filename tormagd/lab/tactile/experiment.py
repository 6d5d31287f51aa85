"""Chapter 4 on a synthetic tactile pad: table 4.1, the pulse experiment of section 4.3, holds.

All data are synthetic: made by `tormagd.simulation.tactile_pad`. `--branches` measures instead what the neighbours of
the k-nearest search decide, on the shipped models.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from tormagd.lab.errors import LabError
from tormagd.lab.main import Found
from tormagd.lab.tactile import branches
from tormagd.lab.tactile.models import FULL, QUICK, Effort, Trained, table_4_1, train
from tormagd.lab.tactile.plots import Material
from tormagd.lab.tactile.pulse import hold, pulse
from tormagd.lab.tactile.report import write_report
from tormagd.lab.thesis.page import WAYS
from tormagd.lab.training.dataset import Array

NOISES_N = (0.05, 0.5)
TABLE_NOISE_N = 0.5


def contract(effort: Effort) -> tuple[dict[str, Any], Trained, dict[str, Array]]:
    """`table_4_1` and `pulse` of the contract, with keys added; what the table was made with; the pulse's traces.

    A quick effort takes fewer rows and epochs and holds for a minute: it shows that all runs, not how well.
    """
    torch.set_num_threads(1)
    trained = [train(noise_N, effort) for noise_N in tqdm(NOISES_N, desc="training", disable=None, leave=False)]
    tabled = trained[NOISES_N.index(TABLE_NOISE_N)]
    figures, traces = pulse(trained, effort)
    held = hold(trained[0], effort.hold_s)
    found = {
        "table_4_1": table_4_1(tabled, effort),
        "pulse": figures | {"hold": held, "hold_1h_force_error": held["with"]["force_error_1h"]},
    }
    return found, tabled, traces


def reproduced(effort: Effort) -> dict[str, Any]:
    """The contract's figures alone."""
    return contract(effort)[0]


def whole(effort: Effort) -> tuple[dict[str, Any], Material]:
    """Do everything; returns the figures and what the pictures are drawn from."""
    figures, tabled, traces = contract(effort)
    figures |= {
        "relaxation": {
            "fractions": tabled.grey.series.fractions,
            "field_fractions": tabled.grey.field_series.fractions,
            "times_s": tabled.grey.series.times_s,
        },
    }
    predicted_N = tabled.model.predict(tabled.cycles.features)
    return figures, Material(tabled.cycles, predicted_N, traces)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of `tormag-lab tactile-experiment`."""
    parser.add_argument("--quick", action="store_true", help="few rows and epochs: shows that it runs, not how well")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write learned_inverse.md and images/ there")
    parser.add_argument("--branches", action="store_true", help="what neighbours decide, on the shipped models")


def run(options: argparse.Namespace) -> Found:
    """The figures; with --out also the page. Raises LabError where that has no folder."""
    if options.branches:
        found = branches.measured()
        return Found(found, branches.lines(found))
    if options.out is not None and not options.out.is_dir():
        raise LabError(f"cannot write to {options.out}: not a directory")
    figures, material = whole(QUICK if options.quick else FULL)
    if options.out is not None:
        write_report(options.out, figures, material)
    return Found(figures, summary(figures))


def summary(figures: dict[str, Any]) -> Iterator[str]:
    """The figures for a person."""
    table, scores = figures["table_4_1"], figures["pulse"]
    yield "synthetic data"
    yield "random split: R2 {r2:.4f}, MAE {mae_N:.3f} N, noise alone {noise_mae_N:.3f} N".format(**table["random"])
    for name in ("leave_one_field_out", "leave_one_class_out", "leave_cycles_out"):
        yield f"{name}: R2 {table[name]['r2']:.4f}, MAE {table[name]['mae_N']:.3f} N"
    for noise, part in scores["by_noise"].items():
        for name in WAYS:
            yield f"pulse, noise {noise} N, {name}: {part[name]['mae_mT']:.2f} mT mean, {part[name]['max_mT']:.2f} max"
        yield f"pulse, noise {noise} N, the noise alone: {part['noise_bound_mae_mT']:.2f} mT mean"
    for name in ("without", "with"):
        held = scores["hold"][name]
        yield f"hold {name} relaxation: {held['force_error_10min']:.2%} in 10 min, {held['force_error_1h']:.2%} in all"
