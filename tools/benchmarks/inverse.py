"""`benchmark inverse`: every search for the field on one workload in one run: time, memory, errors.

One thread and the garbage collector frozen, as in the daemon. Synthetic data (`inverse_workload.py`).
"""

import argparse
import contextlib
import gc
import itertools
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from tqdm import tqdm

from benchmarks import inverse_report as report
from benchmarks.inverse_workload import (
    CIP_PERCENT,
    FIELDS_MT,
    INSERT,
    Array,
    Course,
    course,
    network_roots_mT,
    plant_force_N,
    plant_slope_N_per_mT,
    trained,
    training_data,
)
from tormagd.daemon.realtime import freeze_garbage
from tormagd.inverse.bracketed import BracketedSearch, brent, finer_grid, newton
from tormagd.inverse.choice import RUNTIME_SOLVERS, named
from tormagd.inverse.linear import GridArgmin, LinearFieldSearch, torch_row
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import RisingSearch
from tormagd.inverse.scan import FieldScan
from tormagd.inverse.solution import FieldSolver
from tormagd.lab.searches.closed_form import ClosedForm
from tormagd.lab.searches.direct import DirectInverse
from tormagd.lab.searches.kd_tree import KdTreeSearch
from tormagd.model.model_file import ForceModel
from tormagd.model.rising import falling_at
from tormagd.physics.errors import DomainError
from tormagd.physics.force import TORMAG
from tormagd.scenes.scene import AUTO, load_scene, shipped_scenes
from tormagd.simulation.parameters import PlantParameters, load_plant

OWN, MISMATCHED = "sample_1", ("sample_2", "sample_3")
USUAL_HIDDEN = 50
QUANTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9}
NEWTON, RISING = "newton", "newton-rising"
"The daemon refuses a model that does not rise: the first is what it runs by name, and the second how that is done."
SAME_TIME, LEAST_FORCE_N = 1.1, 1e-6
"Times within this ratio are no difference: the machine's own noise. Nor are forces so near each other."
BASELINES = ("thesis-linear", "linear-argmin", "vectorised-argmin")
NUMPY_DTYPE: dict[str, type[np.floating]] = {"float32": np.float32, "float64": np.float64}
ENCODER_FIELD_MT = 0.02
"About what one encoder count changes (1/560 mm, 5 to 22 mT/mm): smaller differences of error decide nothing."


class Effort(NamedTuple):
    """How much is measured: `solves` in each of `rounds`."""

    hidden: tuple[int, ...]
    training_rows: int
    epochs: int
    course: int
    rounds: int
    solves: int
    slow_solves: int
    chosen_solves: int


FULL = Effort((10, 25, 50, 100, 200), 6000, 40, 2000, 4, 3000, 50, 100_000)
QUICK = Effort((10, 50), 1500, 12, 200, 1, 200, 10, 1000)


class Case(NamedTuple):
    """One search with its settings; 0 stands for a setting that it does not have."""

    solver: str
    hidden: int = USUAL_HIDDEN
    dtype: str = "float64"
    step_mT: float = 0.0
    neighbours: int = 0
    threads: int = 1

    @property
    def name(self) -> str:
        """The solver with its settings; the baselines have none that vary."""
        step = f" {self.step_mT:g} mT" if self.step_mT and self.solver not in BASELINES else ""
        return self.solver + step + (f" k={self.neighbours}" if self.neighbours else "")


def cases(effort: Effort) -> Iterator[Case]:
    """Solver x hidden size x step x k x precision x threads: everything at the usual size, the best at every size."""
    precisions = tuple(NUMPY_DTYPE)
    for hidden in effort.hidden:
        usual = hidden == USUAL_HIDDEN
        for solver in ("thesis-linear", "linear-argmin", "vectorised-argmin"):
            yield Case(solver, hidden, step_mT=1.0)
        yield Case("linear-argmin curve", hidden, step_mT=1.0)
        steps, counts = ((1.0, 2.0, 5.0, 10.0, 20.0), (1, 4, 16)) if usual else ((2.0, 20.0), (4,))
        for dtype, step, count in itertools.product(precisions, steps, counts):
            yield Case("nearest", hidden, dtype, step, count)
        for solver, dtype, step in itertools.product(
            ("coarse-to-fine", NEWTON, "brent"), precisions, (10.0, 20.0, 40.0) if usual else (20.0,)
        ):
            if solver != "brent" or dtype == "float64":
                yield Case(solver, hidden, dtype, step)
        yield Case(RISING, hidden)
        for count in (1, 8, 32) if usual else (8,):
            yield Case("k-d tree", hidden, step_mT=4.0, neighbours=count)
        yield Case("direct", hidden)
    yield Case("closed form")
    yield Case("vectorised-argmin", dtype="float32", step_mT=1.0)
    for threads in (2, 4):
        yield Case("vectorised-argmin", step_mT=1.0, threads=threads)


def make(case: Case, model: ForceModel) -> FieldSolver:
    """The search. Raises `DomainError` where it refuses the model."""
    span: dict[str, Any] = {"field_range_mT": FIELDS_MT}
    stepped = span | {"step_mT": case.step_mT}
    refinements = {"coarse-to-fine": finer_grid, NEWTON: newton, "brent": brent}
    builders: dict[str, Callable[[], FieldSolver]] = {
        # the thesis took its network's mean error for the radius; so does this, with its own network's
        "thesis-linear": lambda: LinearFieldSearch(
            epsilon_N=model.metadata.metrics["mae_N"], predict_one=torch_row(model), **stepped
        ),
        "linear-argmin": lambda: LinearFieldSearch(epsilon_N=0.0, predict_one=torch_row(model), **stepped),
        "linear-argmin curve": lambda: LinearFieldSearch(epsilon_N=0.0, **stepped),
        "vectorised-argmin": lambda: GridArgmin(model, dtype=getattr(torch, case.dtype), **stepped),
        "nearest": lambda: NearestFieldSearch(neighbours=case.neighbours, dtype=NUMPY_DTYPE[case.dtype], **stepped),
        "k-d tree": lambda: KdTreeSearch(model, neighbours=case.neighbours, **stepped),
        RISING: lambda: rising(model),
        "direct": lambda: DirectInverse(model, **span),
        "closed form": lambda: ClosedForm(model, INSERT.elastomer, TORMAG, **span),
    }
    if case.solver in refinements:
        return BracketedSearch(refine=refinements[case.solver], dtype=NUMPY_DTYPE[case.dtype], **stepped)
    return builders[case.solver]()


def rising(model: ForceModel) -> RisingSearch:
    """Raises `DomainError` on a model that the daemon would refuse."""
    if falling_at(model, FIELDS_MT, model.feature_ranges[0][1]) is not None:
        raise DomainError("model", "not rising with the field", "a force that rises with the field everywhere")
    return RisingSearch(FIELDS_MT)


class Bench:
    """The workload with what the answers are held against, per network."""

    def __init__(self, effort: Effort) -> None:
        self.effort = effort
        self.plant = load_plant(OWN)
        self.course = course(self.plant, effort.course)
        self.data = training_data(self.plant, effort.training_rows, seed=1)
        self.models: dict[int, ForceModel] = {}
        self.roots: dict[int, list[Array]] = {}

    def prepare(self) -> None:
        """Trains the networks and finds their roots."""
        for hidden in tqdm(self.effort.hidden, desc="networks", disable=not sys.stderr.isatty()):
            self.models[hidden] = trained(self.data, hidden, self.effort.epochs)
            self.roots[hidden] = network_roots_mT(self.models[hidden], self.course)

    def sweep(self) -> tuple[list[dict[str, Any]], dict[str, str]]:
        """The rows of the table, and the searches that refused a network. In rounds: a disturbance meets all alike."""
        runs, refused = [], {}
        for case in tqdm(list(cases(self.effort)), desc="building", disable=not sys.stderr.isatty()):
            try:
                runs.append(Run(self, case))
            except DomainError as error:
                refused[f"{case.name}, {case.hidden} units"] = str(error)
        freeze_garbage()
        for _ in tqdm(range(self.effort.rounds), desc="rounds", disable=not sys.stderr.isatty()):
            for run in runs:
                run.advance(self.effort.slow_solves if run.is_slow else self.effort.solves)
        return [run.row() for run in runs], refused


class Run:
    """One search on its network: fields of its first time along the course, and the time of every solve."""

    def __init__(self, bench: Bench, case: Case) -> None:
        """Raises `DomainError` where the search refuses the network."""
        self.case, self._bench, self._model = case, bench, bench.models[case.hidden]
        self._solver = make(case, self._model)
        self.is_slow = "linear" in case.solver
        # a search of milliseconds takes every so many points; it does not use the last field
        every = max(bench.effort.course // bench.effort.slow_solves, 1) if self.is_slow else 1
        self._course = Course(*(column[::every] for column in bench.course))
        self._roots = bench.roots[case.hidden][::every]
        self._fields: Array | None = None
        self._times_us: list[Array] = []

    def advance(self, solves: int) -> None:
        """That many solves more."""
        torch.set_num_threads(self.case.threads)
        fields, times_us = follow(self._solver, self._model, self._course, max(solves, len(self._course.field_mT)))
        torch.set_num_threads(1)
        self._times_us.append(times_us)
        if self._fields is None:
            self._fields = fields[: len(self._course.field_mT)]

    def row(self) -> dict[str, Any]:
        """The row of the table."""
        times_us = np.concatenate(self._times_us)
        return (
            self.case._asdict()
            | {"name": self.case.name, "solves": len(times_us)}
            | {f"{name}_us": float(np.percentile(times_us, share)) for name, share in QUANTILES.items()}
            | self._errors()
            | {"memory_kB": held_bytes(self._solver) / 1024}
        )

    def _errors(self) -> dict[str, float]:
        """The solver's error (against the network's own nearest root) and the plant's, apart."""
        along, fields = self._course, self._fields
        assert fields is not None, "a row comes after the first round"
        rooted = np.array([found.size > 0 for found in self._roots])
        to_root = [abs(found - field).min() for found, field in zip(self._roots, fields, strict=True) if found.size]
        features = np.column_stack((along.displacement_mm, along.rate_mm_s, fields, np.full(len(fields), CIP_PERCENT)))
        error_N = np.abs(self._model.predict(features) - along.force_N)
        return {
            "solver_mae_mT": float(np.mean(to_root)),
            "solver_max_mT": float(np.max(to_root)),
            "solver_force_max_N": float(error_N[rooted].max()),
            "network_reach": float(rooted.mean()),
        } | plant_errors(self._bench.plant, along, fields)


def plant_errors(plant: PlantParameters, along: Course, fields: Array) -> dict[str, float]:
    """Field against the plant's true field, and the plant's force at the answer against the force asked."""
    rendered_N = plant_force_N(plant, along.displacement_mm, along.rate_mm_s, fields)
    error_mT = np.abs(fields - along.field_mT)
    return {
        "plant_mae_mT": float(error_mT.mean()),
        "plant_max_mT": float(error_mT.max()),
        "force_mae_N": float(np.abs(rendered_N - along.force_N).mean()),
    }


def follow(solver: FieldSolver, model: ForceModel, along: Course, solves: int) -> tuple[Array, Array]:
    """Fields and times (us) of that many solves along the course, round and round; each is told the last field.

    The curve belongs to the solve: it is another one for every state of the handle.
    """
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
    """Bytes of the arrays, tensors, lists and trees that a search owns, beside the network that all of them share."""
    total = 0
    for value in getattr(owner, "__dict__", {}).values():
        if isinstance(value, np.ndarray):
            total += value.nbytes
        elif isinstance(value, torch.Tensor):
            total += value.untyped_storage().nbytes()
        elif isinstance(value, list):
            total += sys.getsizeof(value) + sum(map(sys.getsizeof, value))
        elif isinstance(value, FieldScan):
            total += held_bytes(value)
        elif isinstance(value, cKDTree):
            total += value.data.nbytes + value.indices.nbytes
    return total


def mark_pareto(rows: list[dict[str, Any]]) -> None:
    """Sets `pareto` on the one-thread rows that no faster one equals in plant error, to an encoder count."""
    for row in rows:
        better = (
            other["p50_us"] < row["p50_us"] and other["plant_mae_mT"] < row["plant_mae_mT"] + ENCODER_FIELD_MT
            for other in rows
            if other["threads"] == 1
        )
        row["pareto"] = row["threads"] == 1 and not any(better)


def precision(bench: Bench) -> dict[str, dict[str, float]]:
    """Greatest and mean difference in field between float32 and float64, per search, over the course."""
    found = {}
    for solver, step, neighbours in (
        ("nearest", 2.0, 4),
        ("nearest", 20.0, 4),
        ("coarse-to-fine", 20.0, 0),
        (NEWTON, 20.0, 0),
    ):
        fields = [
            follow(
                make(Case(solver, USUAL_HIDDEN, dtype, step, neighbours), bench.models[USUAL_HIDDEN]),
                bench.models[USUAL_HIDDEN],
                bench.course,
                bench.effort.course,
            )[0]
            for dtype in NUMPY_DTYPE
        ]
        difference = np.abs(fields[0] - fields[1])
        name = Case(solver, step_mT=step, neighbours=neighbours).name
        found[name] = {"max_mT": float(difference.max()), "mean_mT": float(difference.mean())}
    return found


def chosen(bench: Bench, fifo_priority: int) -> dict[str, dict[str, Any]]:
    """What each shipped scene runs where it searches, measured at length, on this plant and on others."""
    measured: dict[Case, dict[str, Any]] = {}
    result = {}
    for name in shipped_scenes():
        scene = load_scene(name)
        wanted = NEWTON if scene.solver.name == AUTO else scene.solver.name
        choice = named(wanted, scene.solver.step_mT or None, scene.solver.neighbours or None)
        case = Case(choice.solver, step_mT=choice.step_mT, neighbours=choice.neighbours)
        if choice.solver == NEWTON:
            case = Case(RISING)
        if case not in measured:
            run = Run(bench, case)
            with real_time(fifo_priority) as fifo:
                run.advance(bench.effort.chosen_solves)
            measured[case] = run.row() | {"fifo": fifo, "mismatched": mismatched(bench, case)}
        result[name] = measured[case] | {"tolerance_rms_N": scene.force.tolerance_rms_N}
    return result


def dominated(rows: list[dict[str, Any]]) -> list[str]:
    """Where Newton's method, as the daemon runs it, is not the cheapest of the searches that the daemon may run, to
    SAME_TIME, or not the most exact: at which size of the network, and by what."""
    found = []
    for best in (row for row in rows if row["solver"] == RISING):
        for row in rows:
            if row["hidden"] == best["hidden"] and row["solver"] in RUNTIME_SOLVERS and row["threads"] == 1:
                is_faster = SAME_TIME * row["p50_us"] < best["p50_us"]
                is_nearer = row["solver_force_max_N"] + LEAST_FORCE_N < best["solver_force_max_N"]
                if is_faster or is_nearer:
                    found.append(f"{row['hidden']} units: {row['name']} {row['dtype']}")
    return found


def mismatched(bench: Bench, case: Case) -> dict[str, dict[str, float]]:
    """The plant's errors where the forces come from another plant than the one the network learned."""
    errors = {}
    for name in MISMATCHED:
        plant = load_plant(name)
        along = course(plant, bench.effort.course)
        model = bench.models[case.hidden]
        fields, _ = follow(make(case, model), model, along, bench.effort.course)
        errors[name] = plant_errors(plant, along, fields)
    return errors


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[bool]:
    """This thread under FIFO, as the daemon's may be; whether it was asked for and granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:  # priority 0 is none
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The contract's object for `benchmark inverse`; with `--write`, also the page."""
    effort = QUICK if options.quick else FULL
    started_s = time.monotonic()
    torch.set_num_threads(1)
    bench = Bench(effort)
    bench.prepare()
    rows, refused = bench.sweep()
    mark_pareto(rows)
    picked = chosen(bench, options.fifo)
    gc.unfreeze()
    slope = plant_slope_N_per_mT(bench.plant, bench.course)
    sigma_N = 1e-3 * bench.plant.force_sensor.noise_mN
    first = next(iter(picked.values()))
    # both from the rounds: the long run of the chosen search has a scheduling that the baselines had not
    p50_us = {(row["name"], row["dtype"]): row["p50_us"] for row in rows if _is_usual(row)}
    chosen_us = p50_us[first["name"], first["dtype"]]
    speedups = {name: p50_us[name, "float64"] / chosen_us for name in BASELINES}
    result = {
        "workload": f"synthetic torque element ({OWN}, no memory), {effort.course} points of a smooth course",
        "environment": environment(),
        "noise_bound_mae_mT": float((0.8 * sigma_N / slope).mean()),
        "variants": rows,
        "refused": refused,
        "beaten": dominated(rows),
        "chosen": picked,
        "speedup_vs_thesis_linear": speedups["thesis-linear"],
        "speedup": speedups,
        "float32_against_float64": precision(bench),
        "seconds": time.monotonic() - started_s,
    }
    if options.write:
        report.write(result)
    return result


def _is_usual(row: dict[str, Any]) -> bool:
    return bool(row["hidden"] == USUAL_HIDDEN and row["threads"] == 1)


def environment() -> dict[str, Any]:
    """What the times depend on."""
    return {
        "processors": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "load average": round(os.getloadavg()[1], 1),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark inverse`."""
    parser.add_argument("--quick", action="store_true", help="few solves, two networks: shows that it works, no more")
    parser.add_argument("--fifo", type=int, default=50, help="SCHED_FIFO priority for the chosen search; 0 for none")
    parser.add_argument("--write", action="store_true", help="rewrite docs/inverse_trade.md and its plot")


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    print("\n".join(report.lines(result)))
