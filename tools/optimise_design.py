"""Finds the brake's geometry for a task: outer radius, thickness and open gap (Eq. 40-42), from several starts.

Runs on this machine's cores or, with --dask, on a cluster. With --state a stopped sweep goes on where it was.
"""

import argparse
import json
import os
import sys
from pathlib import Path

import msgspec
import numpy as np
from machines import executors
from thesis.values import USE_CASES
from tqdm import tqdm

from tormagd.config import Position
from tormagd.design.optimisation import Design, Outcome, Problem, Run, coverage_as_made
from tormagd.design.phase_portrait import Region
from tormagd.design.recorded_task import read_task
from tormagd.design.sweep import sweep
from tormagd.force_file import ForceFileError
from tormagd.physics.errors import DomainError


def main() -> int:
    """Prints the optima, best first; returns 0, or 2 for input that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--use-case", type=int, choices=USE_CASES, help="one of the thesis's, with its five starts")
    names = ("LEAST_N", "LEAST_RATE", "MOST_N", "MOST_RATE")
    task.add_argument("--region", type=float, nargs=4, metavar=names, help="required forces, N, and rates, N/s")
    parser.add_argument("--measure", choices=("true", "trapezoid", "corners"), default="true")
    parser.add_argument("--solver", choices=("global", "local"), default="global")
    parser.add_argument(
        "--gap-speed", type=float, default=Position().gap_speed_mm_s, help="mm/s (what the controller was measured at)"
    )
    parser.add_argument("--off", type=float, default=1.0, help="how far off a dimension may be made, percent (1)")
    parser.add_argument("--starts", type=int, default=5, help="random starts of a region")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--points", type=Path, help="CSV t_s,force_N: how much of this task the best design renders")
    parser.add_argument("--cutoff", type=float, help="low-pass of the CSV, Hz, before its rate is taken")
    parser.add_argument("--state", type=Path, help="JSON file that keeps finished runs")
    executors.add_options(parser, os.cpu_count() or 1, needed="tormagd")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        recorded = None if options.points is None else read_task(options.points, options.cutoff)
        runs = _runs(options)
        bar = tqdm(total=len(runs), unit="run", disable=not sys.stderr.isatty())
        with executors.chosen(options) as executor, bar:
            outcomes = sweep(runs, executor, options.state, lambda done, total: bar.update(done - bar.n))
    except (DomainError, ForceFileError, OSError) as error:
        print(f"optimise_design: {error}", file=sys.stderr)
        return 2
    ranked = sorted(outcomes.items(), key=lambda item: _merit(options.measure, item[1]))
    made = [coverage_as_made(run.problem, outcome.design, 0.01 * options.off) for run, outcome in ranked]
    outcomes_made = zip(ranked, made, strict=True)
    result: dict[str, object] = {
        "outcomes": [msgspec.to_builtins(each) | {"coverage_as_made": least} for (_, each), least in outcomes_made]
    }
    if recorded is not None:
        run, outcome = ranked[0]
        cloud = run.problem.portrait(outcome.design).true_cloud(recorded.force_N, recorded.rate_N_s)
        failing = np.flatnonzero(~cloud.covered)
        result["points"] = {
            "share": cloud.share,
            "failing": [[float(column[index]) for column in recorded] for index in failing],
        }
    if options.json:
        print(json.dumps(result))
        return 0
    print(f"  R_o mm    t mm  s_max mm  coverage  +-{options.off:g}%  elastomer cm3  corner cost")
    for (_, outcome), least in zip(ranked, made, strict=True):
        design = outcome.design
        print(
            f"{design.outer_radius_mm:8.2f}{design.thickness_mm:8.2f}{design.open_mm:10.1f}{outcome.coverage:10.2%}"
            f"{least:8.2%}"
            f"{1e-3 * outcome.volume_mm3:15.2f}{outcome.corner_cost:13.4g}"
        )
    if recorded is not None:
        print(
            f"recorded task: {cloud.share:.2%} of {len(cloud.covered)} points; {len(failing)} fail (--json lists them)"
        )
    return 0


def _runs(options: argparse.Namespace) -> list[Run]:
    region = Region(*options.region) if options.region else USE_CASES[options.use_case].region
    problem = Problem(region, options.measure, options.gap_speed)
    if options.region:
        low, high = (np.array(msgspec.structs.astuple(bound)) for bound in (problem.lower, problem.upper))
        drawn = np.random.default_rng(options.seed).uniform(low, high, (options.starts, 3))
        starts = [Design(*(float(value) for value in row)) for row in drawn]
    else:
        starts = [line.start for line in USE_CASES[options.use_case].starts]
    return [Run(problem, start, options.solver, options.seed) for start in starts]


def _merit(measure: str, outcome: Outcome) -> tuple[float, float]:
    return (outcome.corner_cost if measure == "corners" else -outcome.coverage), outcome.volume_mm3


if __name__ == "__main__":
    sys.exit(main())
