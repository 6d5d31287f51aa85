"""Solve times along the pulse experiment on the relaxation-aware model, with the thesis's searches beside them.

One thread, garbage collector frozen and FIFO scheduling where the kernel grants it, as in the daemon.
"""

import gc
import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from benchmarks.inverse import QUANTILES, environment, real_time
from tqdm import tqdm

from tactile.models import Trained
from tactile.pulse import FIELDS_MT, Course, nearest, solve_all
from tormagd.daemon.realtime import freeze_garbage
from tormagd.inverse.bracketed import BracketedSearch, newton
from tormagd.inverse.linear import GridArgmin, LinearFieldSearch, torch_row
from tormagd.inverse.solution import FieldSolver
from tormagd.model.features import FIELD
from tormagd.model.model_file import ForceModel
from tormagd.training.dataset import Array
from tormagd.training.grey_box import GreyBoxMemory

USED = "nearest 2 mT"
FIFO_PRIORITY = 50
SLOW_SHARE = 1000
"""A search of milliseconds makes this many times fewer solves, at points spread over the course."""
ROOT_GRID_MT = 0.25
ROOTS = 400
"""Points of the course at which the solver's error is looked at, or all of fewer."""

ForceSearch = Callable[[tuple[float, ...], float, float | None], float]
"""(features of the row, force asked, last field) -> field."""


def solve_times(trained: Trained, along: Course, solves: int) -> dict[str, Any]:
    """Time of each solve by search; the solver's error (to the network's own root) and the plant's, apart.

    `with_memory` is the whole step of the experiment: the force freed of memory, the search, the memory advanced.
    """
    model = trained.grey.model
    memory = GreyBoxMemory(trained.grey, along.dt_s)
    _, elastic_N = solve_all(nearest(), model, along.features, along.force_N, memory)
    row = torch_row(model)
    searches: dict[str, tuple[FieldSolver, bool]] = {
        USED: (nearest(), False),
        "newton 40 mT": (BracketedSearch(field_range_mT=FIELDS_MT, refine=newton, step_mT=40.0), False),
        "thesis-linear": (LinearFieldSearch(field_range_mT=FIELDS_MT, predict_one=row), True),
        "linear-argmin": (LinearFieldSearch(field_range_mT=FIELDS_MT, epsilon_N=0.0, predict_one=row), True),
        "vectorised-argmin": (GridArgmin(model, field_range_mT=FIELDS_MT), False),
    }
    freeze_garbage()
    rows: list[dict[str, Any]] = []
    with real_time(FIFO_PRIORITY) as fifo:
        for name, (solver, slow) in tqdm(searches.items(), desc="solve times", disable=None, leave=False):
            count = max(solves // SLOW_SHARE, 10) if slow else solves
            every = max(len(elastic_N) // count, 1) if slow else 1
            kept = along._replace(
                time_s=along.time_s[::every],
                features=along.features[::every],
                force_N=along.force_N[::every],
                slope_N_mT=along.slope_N_mT[::every],
            )
            times_us, fields = _timed(_search(solver, model), kept.features, elastic_N[::every], count)
            looked = np.flatnonzero(kept.scored)[:: max(int(kept.scored.sum()) // ROOTS, 1)]
            errors = _solver_error_mT(model, kept.features[looked], elastic_N[::every][looked], fields[looked])
            rows.append(
                {"name": name, "solves": count}
                | quantiles(times_us)
                | {"solver_mae_mT": float(np.nanmean(errors)), "solver_max_mT": float(np.nanmax(errors))}
                | {f"plant_{key}": value for key, value in kept.scores(fields).items()}
            )
        whole = GreyBoxMemory(trained.grey, along.dt_s)
        times_us, _ = _timed(_with_memory(nearest(), model, whole), along.features, along.force_N, len(along.force_N))
    gc.unfreeze()
    used_us = rows[0]["p50_us"]
    return {
        "hidden": model.metadata.hidden,
        "environment": environment() | {"fifo": fifo},
        "searches": rows,
        "with_memory": {"solves": len(times_us)} | quantiles(times_us),
        "times_faster_than": {row["name"]: row["p50_us"] / used_us for row in rows[2:]},
    }


def quantiles(times_us: Array) -> dict[str, float]:
    """Percentiles of the times, by the names of `benchmark inverse`."""
    return {f"{name}_us": float(np.percentile(times_us, share)) for name, share in QUANTILES.items()}


def _search(solver: FieldSolver, model: ForceModel) -> ForceSearch:
    def field_mT(row: tuple[float, ...], force_N: float, last_mT: float | None) -> float:
        return solver.solve(model.curve(row[0], row[1], row[3]), force_N, last_mT).field_mT

    return field_mT


def _with_memory(solver: FieldSolver, model: ForceModel, memory: GreyBoxMemory) -> ForceSearch:
    def field_mT(row: tuple[float, ...], force_N: float, last_mT: float | None) -> float:
        wanted_N = memory.elastic_N(row[0], row[1], force_N, row[3])
        found_mT = solver.solve(model.curve(row[0], row[1], row[3]), wanted_N, last_mT).field_mT
        memory.advance(row[0], row[1], found_mT, row[3])
        return found_mT

    return field_mT


def _timed(search: ForceSearch, features: Array, force_N: Array, solves: int) -> tuple[Array, Array]:
    """Times (solves), us, round and round the rows, and the fields (n) of the first round, which is always whole."""
    rows = list(zip(map(tuple, features.tolist()), force_N.tolist(), strict=True))
    times_ns, fields, last = [], [], None
    for row, asked_N in itertools.islice(itertools.cycle(rows), max(solves, len(rows))):
        begun_ns = time.perf_counter_ns()
        last = search(row, asked_N, last)
        times_ns.append(time.perf_counter_ns() - begun_ns)
        fields.append(last)
    return 1e-3 * np.array(times_ns), np.array(fields[: len(rows)])


def _solver_error_mT(model: ForceModel, features: Array, force_N: Array, fields_mT: Array) -> Array:
    """Distance (n) to the nearest field at which the network gives the force, NaN where there is none.

    From a fine grid and a straight line across its crossing: shares no code with the searches.
    """
    grid = np.linspace(*FIELDS_MT, round((FIELDS_MT[1] - FIELDS_MT[0]) / ROOT_GRID_MT) + 1)
    errors = np.full(len(force_N), np.nan)
    for index, (row, asked_N, found_mT) in enumerate(zip(features, force_N, fields_mT, strict=True)):
        rows = np.tile(row, (len(grid), 1))
        rows[:, FIELD] = grid
        excess = model.predict(rows) - asked_N
        left = np.flatnonzero((excess[1:] < 0) != (excess[:-1] < 0))
        if left.size:
            share = excess[left] / (excess[left] - excess[left + 1])
            errors[index] = np.abs(grid[left] + share * (grid[left + 1] - grid[left]) - found_mT).min()
    return errors
