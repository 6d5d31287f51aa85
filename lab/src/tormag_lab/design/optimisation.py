"""Structural optimisation (Eq. 39-42, table 3.2): outer radius, thickness and open gap for the portrait of a task.

The thesis's cost (Eq. 39) adds the squared distances of the portrait's four corners from the task's. It mixes newtons
with newtons per second, and punishes a portrait larger than the task. Ours is coverage of the required region, then the
least volume of elastomer, then the smallest open gap, which may cost `SLACK` of coverage. The elastomer must bear the
field of the closed gap (lambda1 >= 0.05).

Both solvers are scipy's. "local" is SLSQP, like the thesis's fmincon, and ends in the minimum that the start leads to.
"global" is differential evolution, with the start in its first generation, followed by COBYQA.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, OptimizeResult, differential_evolution, minimize

from tormag_lab.arrays import Array
from tormag_lab.design.brake import Brake
from tormag_lab.design.phase_portrait import PhasePortrait, Region
from tormag_lab.executors import finished
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import Elastomer, Geometry, max_radial_moment_Tm

Measure: TypeAlias = Literal["trapezoid", "true", "corners"]
"Coverage by the trapezoid or the true boundary, or the thesis's cost."
Solver: TypeAlias = Literal["local", "global"]

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
    inner_radius_mm: float = 4.0
    roller_radius_mm: float = 20.0
    closed_mm: float = 45.0
    shear_modulus_Pa: float = 300e3
    relative_permeability: float = 3.8
    friction_coefficient: float = 0.2

    def geometry(self, design: Design) -> Geometry:
        return Geometry(
            inner_radius_m=1e-3 * self.inner_radius_mm,
            outer_radius_m=1e-3 * design.outer_radius_mm,
            thickness_m=1e-3 * design.thickness_mm,
            roller_radius_m=1e-3 * self.roller_radius_mm,
        )

    @property
    def elastomer(self) -> Elastomer:
        return Elastomer(self.shear_modulus_Pa, self.relative_permeability, self.friction_coefficient)

    def portrait(self, design: Design) -> PhasePortrait:
        brake = Brake(PowerFieldLaw(), self.elastomer, self.geometry(design), self.closed_mm, design.open_mm)
        return PhasePortrait(brake, self.gap_speed_mm_s)

    def load_margin(self, design: Design) -> float:
        """Return 1 - the closed gap's field over the largest that the elastomer bears."""
        moment_Tm = PowerFieldLaw().radial_moment_Tm(self.closed_mm)
        return 1.0 - moment_Tm / max_radial_moment_Tm(self.elastomer, self.geometry(design))

    def volume_mm3(self, design: Design) -> float:
        return math.pi * (design.outer_radius_mm**2 - self.inner_radius_mm**2) * design.thickness_mm


class Outcome(msgspec.Struct, frozen=True):
    """A design that a solver found. `coverage` is by the true boundary where that was the measure, else by the
    trapezoid."""

    design: Design
    coverage: float
    corner_cost: float
    volume_mm3: float
    evaluations: int
    seconds: float
    """Processor time of the solving thread."""


class Run(msgspec.Struct, frozen=True):
    """One start of one solver on one problem: all that its outcome depends on."""

    problem: Problem
    start: Design
    solver: Solver
    seed: int = 1


def coverage(problem: Problem, design: Design) -> float:
    portrait = problem.portrait(design)
    if problem.measure == "true":
        return portrait.true_coverage(problem.region)
    return portrait.trapezoid_coverage(problem.region)


def coverage_as_made(problem: Problem, design: Design, share: float) -> float:
    """Return the least coverage where each dimension may be off by `share` of it."""
    factors = itertools.product((1.0 - share, 1.0, 1.0 + share), repeat=len(Design.__struct_fields__))
    made = [
        Design(*(value * factor for value, factor in zip(msgspec.structs.astuple(design), each, strict=True)))
        for each in factors
    ]
    return min(coverage(problem, each) if problem.load_margin(each) >= 0.0 else 0.0 for each in made)


def corner_cost(problem: Problem, design: Design) -> float:
    """Return Eq. 39: the sum of squared distances of the trapezoid's corners from the region's."""
    offered, wanted = problem.portrait(design).trapezoid(), problem.region
    # the lower corners mirror the upper ones
    return 2.0 * (
        (offered.least_N - wanted.least_N) ** 2
        + (offered.least_rate_N_s - wanted.least_rate_N_s) ** 2
        + (offered.most_N - wanted.most_N) ** 2
        + (offered.most_rate_N_s - wanted.most_rate_N_s) ** 2
    )


def solve(run: Run) -> Outcome:
    began_s = time.thread_time()
    search = _Search(run.problem)
    cost = search.corner_cost if run.problem.measure == "corners" else search.miss
    first = search.scaled(run.start)
    best = search.global_minimum(cost, first, run.seed) if run.solver == "global" else search.local_minimum(cost, first)
    if run.problem.measure != "corners" and run.solver == "global":
        best = search.smallest(best, run.seed)
    design = search.design(best)
    if run.problem.load_margin(design) < 0.0:
        raise DomainError("shear_modulus_Pa", run.problem.shear_modulus_Pa, "an elastomer that bears the closed gap")
    return Outcome(
        design=design,
        coverage=coverage(run.problem, design),
        corner_cost=corner_cost(run.problem, design),
        volume_mm3=run.problem.volume_mm3(design),
        evaluations=search.evaluations,
        seconds=time.thread_time() - began_s,
    )


class _Search:
    """A problem in coordinates from 0 to 1 between the bounds; counts its evaluations."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.evaluations = 0
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
        return 1.0 - self._at(coverage, x, 0.0)

    def corner_cost(self, x: Array) -> float:
        return self._at(corner_cost, x, math.inf)

    def size(self, x: Array) -> float:
        volume = self.problem.volume_mm3(self.design(x)) / self.problem.volume_mm3(self.problem.upper)
        return volume + _GAP_WEIGHT * float(x[2])

    def global_minimum(
        self, cost: Callable[[Array], float], start: Array, seed: int, *also: NonlinearConstraint
    ) -> Array:
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

    def local_minimum(self, cost: Callable[[Array], float], start: Array) -> Array:
        """Return the minimum that SLSQP reaches from `start`, or `start` where that is as good."""
        margin = {"type": "ineq", "fun": self._margin.fun}
        result = minimize(cost, start, method="SLSQP", bounds=self._bounds, constraints=[margin])
        return _better(cost, start, result)

    def smallest(self, best: Array, seed: int) -> Array:
        """Return the smallest design that covers as much as `best` less SLACK, or `best` itself."""
        allowed = self.miss(best) + SLACK
        found = self.global_minimum(self.size, best, seed, NonlinearConstraint(self.miss, -np.inf, allowed))
        return found if self.miss(found) <= allowed else best

    def _refine(self, cost: Callable[[Array], float], start: Array, limits: list[Any]) -> Array:
        options = {"initial_tr_radius": 0.05, "final_tr_radius": 1e-5, "maxfev": 100}
        result = minimize(cost, start, method="COBYQA", bounds=self._bounds, constraints=limits, options=options)
        is_kept = all(limit.lb <= limit.fun(result.x) <= limit.ub for limit in limits)
        return _better(cost, start, result) if is_kept else start

    def _at(self, function: Callable[[Problem, Design], float], x: Array, impossible: float) -> float:
        """Return a function of the design, or `impossible` where the elastomer would not bear the field."""
        self.evaluations += 1
        design = self.design(x)
        return function(self.problem, design) if self.problem.load_margin(design) >= 0.0 else impossible


def _better(cost: Callable[[Array], float], start: Array, result: OptimizeResult) -> Array:
    return np.asarray(result.x) if cost(result.x) < cost(start) else start


def sweep(runs: Iterable[Run], executor: Executor) -> dict[Run, Outcome]:
    wanted = list(dict.fromkeys(runs))
    outcomes = {run: future.result() for run, future in finished(executor, solve, wanted, "run")}
    return {run: outcomes[run] for run in wanted}
