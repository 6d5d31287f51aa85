"""Find a brake for a task (Eq. 39-42, table 3.2): outer radius, thickness and open gap, from several starts.

The thesis's cost (Eq. 39) adds the squared distances of the portrait's four corners from the task's. It mixes newtons
with newtons per second, and punishes a portrait larger than the task: its minima cover less. Ours is coverage of the
required region, then the least volume of elastomer, then the smallest open gap, which may cost `SLACK` of coverage. The
elastomer must bear the field of the closed gap (lambda1 >= 0.05).

The solver is scipy's differential evolution, with the start in its first generation, followed by COBYQA.
"""

import argparse
import math
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, differential_evolution, minimize

from tormag_lab.arrays import Array, Json
from tormag_lab.design.brake import CLOSED_MM, Brake
from tormag_lab.design.phase_portrait import PhasePortrait, Region
from tormag_lab.executors import add_options as add_executors, chosen, finished
from tormag_lab.main import GAP_SPEED, SEED, Found
from tormagd.config import Position
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, Geometry, max_radial_moment_Tm
from tormagd.ground.command_line import Within

Measure: TypeAlias = Literal["trapezoid", "true"]
"Boundary by which coverage counts."

SLACK = 1e-4
"Coverage that a smaller elastomer may cost."
_GAP_WEIGHT = 1e-4
"So small that the open gap decides only between nearly equal volumes."
_GENERATIONS = 50


class Design(msgspec.Struct, frozen=True):
    """Outer radius R_o, thickness t and open gap s_max."""

    outer_radius_mm: float
    thickness_mm: float
    open_mm: float


class Problem(msgspec.Struct, frozen=True):
    """A task's region, the measure of success, and all that is given; defaults are the thesis's (appendix B)."""

    region: Region
    measure: Measure
    gap_speed_mm_s: float
    lower: Design = Design(6.5, 0.5, 46.0)
    upper: Design = Design(45.0, 50.0, 200.0)
    elastomer: Elastomer = Elastomer(300e3, 3.8, 0.2)

    def geometry(self, design: Design) -> Geometry:
        """Return the device's own geometry with this outer radius and thickness."""
        return replace(TORMAG, outer_radius_m=1e-3 * design.outer_radius_mm, thickness_m=1e-3 * design.thickness_mm)

    def portrait(self, design: Design) -> PhasePortrait:
        brake = Brake(PowerFieldLaw(), self.elastomer, self.geometry(design), CLOSED_MM, design.open_mm)
        return PhasePortrait(brake, self.gap_speed_mm_s)

    def load_margin(self, design: Design) -> float:
        """Return 1 - the closed gap's field over the largest that the elastomer bears."""
        moment_Tm = PowerFieldLaw().radial_moment_Tm(CLOSED_MM)
        return 1.0 - moment_Tm / max_radial_moment_Tm(self.elastomer, self.geometry(design))

    def volume_mm3(self, design: Design) -> float:
        inner_radius_mm = 1e3 * TORMAG.inner_radius_m
        return math.pi * (design.outer_radius_mm**2 - inner_radius_mm**2) * design.thickness_mm


class Run(msgspec.Struct, frozen=True):
    """One start on one problem: all that its outcome depends on."""

    problem: Problem
    start: Design
    seed: int = 1


def coverage(problem: Problem, design: Design) -> float:
    portrait = problem.portrait(design)
    if problem.measure == "true":
        return portrait.true_coverage(problem.region)
    return portrait.trapezoid_coverage(problem.region)


def solve(run: Run) -> Json:
    """Return the best design, and its coverage by the measure of its problem."""
    began_s = time.thread_time()
    search = _Search(run.problem)
    design = search.design(search.smallest(search.minimum(search.miss, search.scaled(run.start), run.seed), run.seed))
    if run.problem.load_margin(design) < 0.0:
        raise DomainError(
            "shear_modulus_Pa", run.problem.elastomer.shear_modulus_Pa, "an elastomer that bears the closed gap"
        )
    return {
        "design": design,
        "coverage": coverage(run.problem, design),
        "volume_mm3": run.problem.volume_mm3(design),
        "seconds": time.thread_time() - began_s,  # of this thread's processor time
    }


class _Search:
    """A problem in coordinates from 0 to 1 between the bounds."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._low = np.array(msgspec.structs.astuple(problem.lower))
        self._span = np.array(msgspec.structs.astuple(problem.upper)) - self._low
        self._bounds = Bounds(np.zeros(3), np.ones(3), keep_feasible=True)
        self._margin = NonlinearConstraint(lambda x: problem.load_margin(self.design(x)), 0.0, np.inf)

    def scaled(self, design: Design) -> Array:
        return np.asarray((np.array(msgspec.structs.astuple(design)) - self._low) / self._span)

    def design(self, x: Array) -> Design:
        # a solver may step a rounding error outside its bounds
        return Design(*(float(value) for value in self._low + self._span * np.clip(x, 0.0, 1.0)))

    def miss(self, x: Array) -> float:
        design = self.design(x)
        # an elastomer that would not bear the field covers nothing
        return 1.0 - coverage(self.problem, design) if self.problem.load_margin(design) >= 0.0 else 1.0

    def size(self, x: Array) -> float:
        volume = self.problem.volume_mm3(self.design(x)) / self.problem.volume_mm3(self.problem.upper)
        return volume + _GAP_WEIGHT * float(x[2])

    def minimum(self, cost: Callable[[Array], float], start: Array, seed: int, *also: NonlinearConstraint) -> Array:
        """Return the point (3) of least `cost`, by differential evolution with `start` in it, then COBYQA."""
        limits = [*also, self._margin]
        result = differential_evolution(
            cost,
            self._bounds,
            constraints=limits,
            x0=start,
            rng=np.random.default_rng(seed),
            popsize=10,
            maxiter=_GENERATIONS,
            tol=1e-6,
            atol=1e-9,
            polish=False,
        )
        return self._refine(cost, np.asarray(result.x), limits)

    def smallest(self, best: Array, seed: int) -> Array:
        """Return the smallest design that covers as much as `best` less SLACK, or `best` itself."""
        allowed = self.miss(best) + SLACK
        found = self.minimum(self.size, best, seed, NonlinearConstraint(self.miss, -np.inf, allowed))
        return found if self.miss(found) <= allowed else best

    def _refine(self, cost: Callable[[Array], float], start: Array, limits: list[Any]) -> Array:
        options = {"initial_tr_radius": 0.05, "final_tr_radius": 1e-5, "maxfev": 100}
        result = minimize(cost, start, method="COBYQA", bounds=self._bounds, constraints=limits, options=options)
        is_kept = all(limit.lb <= limit.fun(result.x) <= limit.ub for limit in limits)
        return np.asarray(result.x) if is_kept and cost(result.x) < cost(start) else start


def sweep(runs: Iterable[Run], executor: Executor) -> dict[Run, Json]:
    wanted = list(dict.fromkeys(runs))
    outcomes = {run: future.result() for run, future in finished(executor, solve, wanted, "run")}
    return {run: outcomes[run] for run in wanted}


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--region",
        required=True,
        type=float,
        nargs=4,
        metavar=("MIN_N", "MIN_RATE", "MAX_N", "MAX_RATE"),
        help="required forces, N, and rates, N/s",
    )
    parser.add_argument("--measure", choices=("true", "trapezoid"), default="true")
    parser.add_argument(
        "--gap-speed",
        type=GAP_SPEED,
        default=Position().gap_speed_mm_s,
        help="mm/s (what the controller was measured at)",
    )
    parser.add_argument("--starts", type=Within(1, 10_000, is_whole=True).__call__, default=5, help="random ones")
    parser.add_argument("--seed", type=SEED, default=1)
    add_executors(parser, os.cpu_count() or 1, needed="tormag-lab")


def run(options: argparse.Namespace) -> Found:
    with chosen(options) as executor:
        outcomes = sweep(_runs(options), executor)
    rows = [msgspec.to_builtins(outcome) for outcome in outcomes.values()]
    rows.sort(key=lambda row: (-row["coverage"], row["volume_mm3"]))
    return Found({"outcomes": rows})


def _runs(options: argparse.Namespace) -> list[Run]:
    problem = Problem(Region(*options.region), options.measure, options.gap_speed)
    low, high = (np.array(msgspec.structs.astuple(bound)) for bound in (problem.lower, problem.upper))
    drawn = np.random.default_rng(options.seed).uniform(low, high, (options.starts, 3))
    return [Run(problem, Design(*start), options.seed) for start in drawn.tolist()]
