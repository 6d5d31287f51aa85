"""`benchmark inverse`: every search for the field on one workload: time, memory, errors.

It runs in one thread with the garbage collector frozen, as in the daemon. The plant is the simulator's torque element
without memory: its force law, field law, pre-sliding and Stribeck friction. Hysteresis and relaxation are left out,
because no search could undo them and they would hide the searches.
"""

import argparse
import datetime
import gc
import itertools
import os
import platform
import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import brentq
from tqdm import tqdm

from tormag_lab.arrays import Array
from tormag_lab.training.dataset import Dataset
from tormag_lab.training.fitting import fit_model
from tormagd.control.nominal import FieldOfGap
from tormagd.daemon.realtime import freeze_garbage
from tormagd.element.inverse import ordered
from tormagd.element.inverse.choice import build, mean_error_N, named
from tormagd.element.inverse.nearest import field_grid
from tormagd.element.inverse.solution import FieldSolution, FieldSolver, Reach, answer
from tormagd.element.model.features import Element
from tormagd.element.model.force_curve import ForceCurve
from tormagd.element.model.model_file import ForceModel, falling_at
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import TORMAG, brake_force_N
from tormagd.element.physics.inserts import insert
from tormagd.scenes.scene import AUTO, load_scene, shipped_scenes
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.static_laws import radial_moment_Tm

INSERT = insert("MRE-50-40")
CIP_PERCENT = 100.0 * INSERT.cip_fraction
GAPS_MM = (45.0, 95.0)
NOMINAL = FieldOfGap(PowerFieldLaw(), INSERT.elastomer.relative_permeability, TORMAG.inner_radius_m)
FIELDS_MT = (NOMINAL.field_mT(GAPS_MM[1]), NOMINAL.field_mT(GAPS_MM[0]))
"What the controller calls field: the nominal law's, over the device's stroke."

DISPLACEMENTS_MM = (1.4, 2.1)
RATES_MM_S = (2.0, 55.0)
"Near full mobilisation and in motion: before break-away the hand chooses the force, and the inverse is ill-posed."

COVERED = (0.04, 0.96)
ROOT_STEP_MT = 0.5


class Course(NamedTuple):
    displacement_mm: Array
    rate_mm_s: Array
    field_mT: Array
    force_N: Array

    def rows(self) -> list[tuple[float, float, float]]:
        return list(zip(self.displacement_mm.tolist(), self.rate_mm_s.tolist(), self.force_N.tolist(), strict=True))


def plant_force_N(plant: PlantParameters, displacement_mm: Array, rate_mm_s: Array, field_mT: Array) -> Array:
    """Return the plant's force so far after a reversal at a steady rate, at the gap with nominal field `field_mT`."""
    gaps = np.array([min(max(NOMINAL.gap_mm(field), GAPS_MM[0]), GAPS_MM[1]) for field in field_mT.tolist()])
    kinetic_N = brake_force_N(radial_moment_Tm(gaps, plant), plant.elastomer.law, TORMAG)
    friction = plant.friction.law
    # a reversal leaves the bristles bent the other way, which is the largest deflection there is
    columns = zip(displacement_mm.tolist(), rate_mm_s.tolist(), kinetic_N.tolist(), strict=True)
    return np.array([friction.advance(-1e3, rate, level, travel / rate)[0] for travel, rate, level in columns])


def course(plant: PlantParameters, solves: int) -> Course:
    """Return a smooth course through the plant's range: slow and fast swings of field, speed and travel."""
    phase = 2 * np.pi * np.arange(solves) / solves
    middle, swing = sum(COVERED) / 2, (COVERED[1] - COVERED[0]) / 2
    share = middle + swing * (0.8 * np.sin(3 * phase) + 0.2 * np.sin(17 * phase))
    field = FIELDS_MT[0] + share * (FIELDS_MT[1] - FIELDS_MT[0])
    rate = 25.0 + 20.0 * np.sin(5 * phase)
    displacement = 1.75 + 0.25 * np.sin(7 * phase)
    return Course(displacement, rate, field, plant_force_N(plant, displacement, rate, field))


def training_data(plant: PlantParameters, rows: int, seed: int) -> Dataset:
    draw = np.random.default_rng(seed)
    displacement, rate = draw.uniform(*DISPLACEMENTS_MM, rows), draw.uniform(*RATES_MM_S, rows)
    field = draw.uniform(*FIELDS_MT, rows)
    force = plant_force_N(plant, displacement, rate, field)
    force = force + draw.normal(0.0, 1e-3 * plant.force_sensor.noise_mN, rows)
    return Dataset(np.column_stack((displacement, rate, field, np.full(rows, CIP_PERCENT))), force)


def network_roots_mT(model: ForceModel, along: Course) -> list[Array]:
    """Return for each solve every field in range at which the network gives the force."""
    grid = np.linspace(*FIELDS_MT, int((FIELDS_MT[1] - FIELDS_MT[0]) / ROOT_STEP_MT) + 2)
    found: list[Array] = []
    for displacement, rate, force in along.rows():
        features = np.column_stack(np.broadcast_arrays(displacement, rate, grid, CIP_PERCENT))
        is_over = model.predict(features) >= force
        begins = np.flatnonzero(is_over[1:] != is_over[:-1]).tolist()
        of_solve = model, displacement, rate, force
        roots = [brentq(_excess_N, grid[place], grid[place + 1], args=of_solve, xtol=1e-10) for place in begins]
        found.append(np.array(roots))
    return found


def _excess_N(field_mT: float, model: ForceModel, displacement_mm: float, rate_mm_s: float, force_N: float) -> float:
    return model.predict_one(displacement_mm, rate_mm_s, field_mT, CIP_PERCENT) - force_N


USUAL_HIDDEN = 50
PLANT = "sample_1"
QUANTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9}
NEWTON = "newton"
BASELINES = ("thesis-linear", "linear-argmin", "vectorised-argmin")
BASELINE_STEP_MT = 1.0
STEPS_MT = {"torch": (1.0, 2.0, 5.0), "nearest": (1.0, 2.0, 5.0, 10.0, 20.0)}
ENDS_MT = {"torch": (1.0,), "nearest": (2.0, 20.0)}
ENCODER_FIELD_MT = 0.02
"About one encoder count (1/560 mm, 5 to 22 mT/mm): smaller differences of error decide nothing."


class Effort(NamedTuple):
    """How much is measured: `solves` in each of `rounds`."""

    hidden: tuple[int, ...]
    training_rows: int
    epochs: int
    course: int
    rounds: int
    solves: int
    slow_solves: int


FULL = Effort((10, 25, 50, 100, 200), 6000, 40, 2000, 4, 3000, 50)
QUICK = Effort((10, 50), 1500, 12, 200, 1, 200, 10)


class Case(NamedTuple):
    """One search with its settings; 0 stands for a setting that it lacks."""

    solver: str
    hidden: int = USUAL_HIDDEN
    step_mT: float = 0.0
    neighbours: int = 0

    @property
    def name(self) -> str:
        step = f" {self.step_mT:g} mT" if self.step_mT and self.solver not in BASELINES else ""
        return self.solver + step + (f" k={self.neighbours}" if self.neighbours else "")


def cases(hidden: tuple[int, ...]) -> Iterator[Case]:
    for size in hidden:
        for solver in BASELINES:
            yield Case(solver, size, BASELINE_STEP_MT)
        for solver, steps_mT in (STEPS_MT if size == USUAL_HIDDEN else ENDS_MT).items():
            for step_mT in steps_mT:
                yield Case(solver, size, step_mT, named(solver).neighbours)
        yield Case(NEWTON, size)
    yield from (of_scene(name) for name in shipped_scenes())


def of_scene(name: str) -> Case:
    solver = load_scene(name).solver
    choice = named(NEWTON if solver.name == AUTO else solver.name, solver.step_mT or None, solver.neighbours or None)
    return Case(choice.solver, step_mT=choice.step_mT, neighbours=choice.neighbours)


def make(case: Case, model: ForceModel) -> FieldSolver:
    if case.solver not in BASELINES:
        return build(named(case.solver, case.step_mT or None, case.neighbours or None), FIELDS_MT, model, rises=True)
    fields_mT = field_grid(FIELDS_MT, case.step_mT)
    if case.solver == "vectorised-argmin":
        return Argmin(model, fields_mT)
    epsilon_N = mean_error_N(model) if case.solver == "thesis-linear" else 0.0
    return ordered.RowByRow(fields_mT, epsilon_N, ordered.row(model))


class Argmin:
    def __init__(self, model: ForceModel, fields_mT: Array) -> None:
        self._fields_mT, self._forces_N = fields_mT, ordered.batch(model, fields_mT)

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """See `FieldSolver.solve`; the workload has no force out of reach."""
        field_mT = float(self._fields_mT[np.abs(self._forces_N(curve) - force_N).argmin()])
        return answer(curve, field_mT, force_N, curve.force_N(field_mT), 1, Reach.INSIDE)


class Bench:
    """The workload with the true answers for each network, which it trains."""

    def __init__(self, effort: Effort) -> None:
        self.effort = effort
        self.plant = load_plant(PLANT)
        self.course = course(self.plant, effort.course)
        data = training_data(self.plant, effort.training_rows, seed=1)
        hidden = tqdm(effort.hidden, desc="networks", disable=None)
        self.models = {
            size: fit_model(
                *data.split(0.3, 0),
                element=Element.TORQUE,
                inserts=(INSERT.name,),
                data_sha256=data.sha256(),
                created=datetime.date(2024, 1, 1),
                hidden=size,
                epochs=effort.epochs,
            )[0]
            for size in hidden
        }
        self.roots = {size: network_roots_mT(model, self.course) for size, model in self.models.items()}

    def sweep(self) -> tuple[list[dict[str, Any]], list[str]]:
        wanted = list(dict.fromkeys(cases(self.effort.hidden)))
        refused = [case for case in wanted if case.solver == NEWTON and self._falls(case.hidden)]
        runs = [Run(self, case) for case in wanted if case not in refused]
        freeze_garbage()
        for _ in tqdm(range(self.effort.rounds), desc="rounds", disable=None):
            for run in runs:
                run.advance()
        gc.unfreeze()
        return [run.row() for run in runs], [f"{case.name}, {case.hidden} units" for case in refused]

    def _falls(self, hidden: int) -> bool:
        model = self.models[hidden]
        return falling_at(model, FIELDS_MT, model.feature_ranges[0][1]) is not None


class Run:
    """One search on its network: the first round's fields, and the time of every solve."""

    def __init__(self, bench: Bench, case: Case) -> None:
        self.case, self._bench, self._model = case, bench, bench.models[case.hidden]
        self._solver = make(case, self._model)
        effort, is_slow = bench.effort, "linear" in case.solver
        # a search of milliseconds takes every so many points; it does not use the last field
        every = max(effort.course // effort.slow_solves, 1) if is_slow else 1
        self._course = Course(*(column[::every] for column in bench.course))
        self._roots = bench.roots[case.hidden][::every]
        self._solves = max(effort.slow_solves if is_slow else effort.solves, len(self._course.field_mT))
        self._times_us: list[Array] = []

    def advance(self) -> None:
        self._fields_mT, times_us = follow(self._solver, self._model, self._course, self._solves)
        self._times_us.append(times_us)

    def row(self) -> dict[str, Any]:
        times_us = np.concatenate(self._times_us)
        return (
            {"name": self.case.name, "dtype": "float64"}
            | self.case._asdict()
            | {"solves": len(times_us)}
            | {f"{name}_us": float(np.percentile(times_us, share)) for name, share in QUANTILES.items()}
            | self._errors()
            | {"memory_kB": held_bytes(self._solver) / 1024}
        )

    def _errors(self) -> dict[str, float]:
        """Return the solver's error (against the network's own nearest root) and the plant's."""
        along = self._course
        fields = self._fields_mT[: len(along.field_mT)]
        rooted = np.array([found.size > 0 for found in self._roots])
        to_root = [abs(found - field).min() for found, field in zip(self._roots, fields, strict=True) if found.size]
        features = np.column_stack((along.displacement_mm, along.rate_mm_s, fields, np.full(len(fields), CIP_PERCENT)))
        error_N = np.abs(self._model.predict(features) - along.force_N)
        rendered_N = plant_force_N(self._bench.plant, along.displacement_mm, along.rate_mm_s, fields)
        error_mT = np.abs(fields - along.field_mT)
        return {
            "solver_mae_mT": float(np.mean(to_root)),
            "solver_max_mT": float(np.max(to_root)),
            "solver_force_max_N": float(error_N[rooted].max()),
            "plant_mae_mT": float(error_mT.mean()),
            "plant_max_mT": float(error_mT.max()),
            "force_mae_N": float(np.abs(rendered_N - along.force_N).mean()),
        }


def follow(solver: FieldSolver, model: ForceModel, along: Course, solves: int) -> tuple[Array, Array]:
    """Return fields and times (us) of that many solves along the course; each gets the last field."""
    rows = along.rows()
    fields, times_ns = np.empty(solves), np.empty(solves)
    last: float | None = None
    for index, (displacement, rate, force) in enumerate(itertools.islice(itertools.cycle(rows), solves)):
        start_ns = time.perf_counter_ns()
        last = solver.solve(model.curve(displacement, rate, CIP_PERCENT), force, last).field_mT
        times_ns[index] = time.perf_counter_ns() - start_ns
        fields[index] = last
    return fields, times_ns * 1e-3


def held_bytes(owner: object) -> int:
    """Return the bytes of the arrays, tensors and lists that a search owns, without the shared network."""
    total = 0
    for value in getattr(owner, "__dict__", {}).values():
        if isinstance(value, np.ndarray):
            total += value.nbytes
        elif isinstance(value, torch.Tensor):
            total += value.untyped_storage().nbytes()
        elif isinstance(value, list):
            total += sys.getsizeof(value) + sum(map(sys.getsizeof, value))
    return total


def mark_pareto(rows: list[dict[str, Any]]) -> None:
    """Set `pareto` on the rows that no faster one equals in plant error, to an encoder count."""
    for row in rows:
        row["pareto"] = not any(
            other["p50_us"] < row["p50_us"] and other["plant_mae_mT"] < row["plant_mae_mT"] + ENCODER_FIELD_MT
            for other in rows
        )


OPTIONS = {
    "--quick": {"action": "store_true", "help": "two small networks and few solves, for a test"},
}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    effort = QUICK if options.quick else FULL
    torch.set_num_threads(1)
    rows, refused = Bench(effort).sweep()
    mark_pareto(rows)
    usual = {row["name"]: row for row in rows if row["hidden"] == USUAL_HIDDEN}
    # where a small network refuses it, the scene would run the search that looks at a grid
    fallback = usual[Case("nearest", step_mT=2.0, neighbours=named("nearest").neighbours).name]
    scenes = {name: load_scene(name).force.tolerance_rms_N for name in shipped_scenes()}
    chosen = {
        name: usual.get(of_scene(name).name, fallback) | {"tolerance_rms_N": tolerance_N}
        for name, tolerance_N in scenes.items()
    }
    p50_us = next(iter(chosen.values()))["p50_us"]
    return {
        "workload": f"synthetic torque element ({PLANT}, no memory), {effort.course} points of a smooth course",
        "environment": {  # what the times depend on besides
            "processors": os.cpu_count(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": torch.__version__,
            "load average": round(os.getloadavg()[0], 1),
        },
        "variants": rows,
        "refused": refused,
        "chosen": chosen,
        "speedup_vs_thesis_linear": usual["thesis-linear"]["p50_us"] / p50_us,
    }
