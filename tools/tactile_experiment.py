"""Chapter 4 on a synthetic tactile pad: table 4.1, forward models compared, the pulse experiment of section 4.3, holds.

python tools/tactile_experiment.py [--quick] [--json] [--out docs]

All data are synthetic: made by `tormagd.simulation.pad`. `reproduced` gives the contract's figures to other tools.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tactile.models import FULL, PAD_IN_USE, QUICK, SPLIT_SEED, Effort, Trained, comparison, table_4_1, train
from tactile.plots import Material
from tactile.pulse import HELD_S, RATE_HZ, course, hold, pulse, pulse_shape
from tactile.report import write_report
from tactile.timing import solve_times
from tqdm import tqdm

from tormagd.simulation.pad import PADS
from tormagd.training.splits import random_split

NOISES_N = (0.05, 0.5)
TABLE_NOISE_N = 0.5


def trainings(effort: Effort) -> list[Trained]:
    """Both models at each sensor noise."""
    torch.set_num_threads(1)
    return [train(noise_N, effort) for noise_N in tqdm(NOISES_N, desc="training", disable=None, leave=False)]


def reproduced(effort: Effort) -> dict[str, Any]:
    """`table_4_1` and `pulse` of the contract, with keys added.

    A quick effort takes fewer rows and epochs and holds for a minute: it shows that all runs, not how well.
    """
    trained = trainings(effort)
    figures, _ = pulse(trained, effort)
    held, _ = hold(trained[0], effort.hold_s)
    return {
        "table_4_1": table_4_1(trained[NOISES_N.index(TABLE_NOISE_N)], effort),
        "pulse": figures | {"hold": held, "hold_1h_force_error": held["with"]["force_error_1h"]},
    }


def run(effort: Effort) -> tuple[dict[str, Any], Material]:
    """Do everything; returns the figures and what the pictures are drawn from."""
    trained = trainings(effort)
    tabled = trained[NOISES_N.index(TABLE_NOISE_N)]
    figures, traces = pulse(trained, effort)
    held, hold_traces = hold(trained[0], effort.hold_s)
    along = course(PADS[PAD_IN_USE], pulse_shape(HELD_S, RATE_HZ)[0], effort.pulse_every)
    everything = {
        "table_4_1": table_4_1(tabled, effort),
        "pulse": figures | {"hold": held, "hold_1h_force_error": held["with"]["force_error_1h"]},
        "comparison": comparison(tabled.cycles, effort, TABLE_NOISE_N),
        "solve_times": solve_times(trained[0], along, effort.solves),
        "relaxation": {
            "fractions": tabled.grey.series.fractions,
            "field_fractions": tabled.grey.field_series.fractions,
            "times_s": tabled.grey.series.times_s,
        },
    }
    predicted_N = tabled.model.predict(tabled.cycles.features)
    held_out = random_split(len(predicted_N), SPLIT_SEED)
    return everything, Material(tabled.cycles, predicted_N, held_out, tabled.network, traces, hold_traces)


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the figures; returns 0, or 2 on a wrong command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few rows and epochs: shows that it runs, not how well")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write learned_inverse.md and images/ there")
    options = parser.parse_args(arguments)
    if options.out is not None and not options.out.is_dir():
        print(f"tactile_experiment: cannot write to {options.out}: not a directory", file=sys.stderr)
        return 2
    figures, material = run(QUICK if options.quick else FULL)
    if options.out is not None:
        write_report(options.out, figures, material)
    if options.json:
        print(json.dumps(figures))
    else:
        print_summary(figures)
    return 0


def print_summary(figures: dict[str, Any]) -> None:
    """The figures for a person."""
    table, scores, times = figures["table_4_1"], figures["pulse"], figures["solve_times"]
    print("synthetic data")
    print("random split: R2 {r2:.4f}, MAE {mae_N:.3f} N, noise alone {noise_mae_N:.3f} N".format(**table["random"]))
    for name in ("leave_one_field_out", "leave_one_class_out", "leave_cycles_out"):
        print(f"{name}: R2 {table[name]['r2']:.4f}, MAE {table[name]['mae_N']:.3f} N")
    for noise, part in scores["by_noise"].items():
        for name in ("mlp", "mlp_thesis_search", "relaxation_aware", "relaxation_aware_noisy"):
            print(f"pulse, noise {noise} N, {name}: {part[name]['mae_mT']:.2f} mT mean, {part[name]['max_mT']:.2f} max")
        print(f"pulse, noise {noise} N, the noise alone: {part['noise_bound_mae_mT']:.2f} mT mean")
    for name in ("without", "with"):
        held = scores["hold"][name]
        print(f"hold {name} relaxation: {held['force_error_10min']:.2%} in 10 min, {held['force_error_1h']:.2%} in all")
    for row in times["searches"]:
        print("{name}: p50 {p50_us:.1f}, p99.9 {p999_us:.1f} us, plant {plant_mae_mT:.2f} mT".format(**row))


if __name__ == "__main__":
    sys.exit(main())
