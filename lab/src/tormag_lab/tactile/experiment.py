"""Chapter 4 on a synthetic tactile pad: table 4.1, the pulse experiment of section 4.3, holds.

`--branches` measures instead what the neighbours of the k-nearest search decide, on the shipped models.
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from tormag_lab.arrays import Array
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.tactile import branches
from tormag_lab.tactile.models import FULL, QUICK, Effort, Trained, table_4_1, train
from tormag_lab.tactile.pulse import hold, pulse
from tormag_lab.tactile.report import sections, write_report

NOISES_N = (0.05, 0.5)
"Sensor noise of each training; table 4.1 uses the last."


def contract(effort: Effort) -> tuple[dict[str, Any], Trained, dict[str, Array]]:
    """Run the experiment, and return its figures, table 4.1's training, and the pulse's traces by name."""
    torch.set_num_threads(1)
    trained = [train(noise_N, effort) for noise_N in tqdm(NOISES_N, desc="training", disable=None, leave=False)]
    tabled = trained[-1]
    figures, traces = pulse(trained, effort)
    held = hold(trained[0], effort.hold_s)
    found = {
        "table_4_1": table_4_1(tabled, effort),
        "pulse": figures | {"hold": held, "hold_1h_force_error": held["with"]["force_error_1h"]},
        "relaxation": {
            "fractions": tabled.grey.series.fractions,
            "field_fractions": tabled.grey.field_series.fractions,
            "times_s": tabled.grey.series.times_s,
        },
    }
    return found, tabled, traces


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="few rows and epochs: shows that it runs, not how well")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write learned_inverse.md and images/ there")
    parser.add_argument("--branches", action="store_true", help="what neighbours decide, on the shipped models")


def run(options: argparse.Namespace) -> Found:
    if options.branches:
        return Found(branches.measured())
    if options.out is not None and not options.out.is_dir():
        raise LabError(f"cannot write to {options.out}: not a directory")
    figures, trained, traces = contract(QUICK if options.quick else FULL)
    if options.out is not None:
        write_report(options.out, figures, trained, traces)
    return Found(figures, sections(figures))
