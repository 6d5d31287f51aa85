"""Find the brake's geometry for a task: outer radius, thickness and open gap (Eq. 40-42), from several starts.

Runs on this machine's cores or, with --dask, on a cluster.
"""

import argparse
import os

import msgspec
import numpy as np

from tormag_lab import executors
from tormag_lab.design.optimisation import Design, Problem, Run, coverage_as_made, sweep
from tormag_lab.design.phase_portrait import Region
from tormag_lab.main import GAP_SPEED, SEED, Found, whole, within
from tormagd.config import Position


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--region",
        required=True,
        type=float,
        nargs=4,
        metavar=("MIN_N", "MIN_RATE", "MAX_N", "MAX_RATE"),
        help="required forces, N, and rates, N/s",
    )
    parser.add_argument("--measure", choices=("true", "trapezoid", "corners"), default="true")
    parser.add_argument("--solver", choices=("global", "local"), default="global")
    parser.add_argument(
        "--gap-speed",
        type=GAP_SPEED,
        default=Position().gap_speed_mm_s,
        help="mm/s (what the controller was measured at)",
    )
    parser.add_argument(
        "--off",
        type=within(0.0, 50.0, "percent"),
        default=1.0,
        help="how far off a dimension may be made, percent (1)",
    )
    parser.add_argument("--starts", type=whole(1, 10_000), default=5, help="random ones")
    parser.add_argument("--seed", type=SEED, default=1)
    executors.add_options(parser, os.cpu_count() or 1, needed="tormagd[lab]")


def run(options: argparse.Namespace) -> Found:
    with executors.chosen(options) as executor:
        outcomes = sweep(_runs(options), executor)
    by_cost = options.measure == "corners"
    rows = [
        msgspec.to_builtins(each) | {"coverage_as_made": coverage_as_made(run.problem, each.design, 0.01 * options.off)}
        for run, each in outcomes.items()
    ]
    rows.sort(key=lambda row: (row["corner_cost"] if by_cost else -row["coverage"], row["volume_mm3"]))
    return Found({"outcomes": rows})


def _runs(options: argparse.Namespace) -> list[Run]:
    problem = Problem(Region(*options.region), options.measure, options.gap_speed)
    low, high = (np.array(msgspec.structs.astuple(bound)) for bound in (problem.lower, problem.upper))
    drawn = np.random.default_rng(options.seed).uniform(low, high, (options.starts, 3))
    return [Run(problem, Design(*start), options.solver, options.seed) for start in drawn.tolist()]
