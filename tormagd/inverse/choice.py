"""Which search a scene gets: the cheapest that its tolerance allows, by the table that `benchmark inverse` measured."""

from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

import msgspec
import numpy as np

from tormagd.inverse.bracketed import BracketedSearch, Refinement, finer_grid, newton
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import RisingSearch
from tormagd.inverse.solution import FieldSolver
from tormagd.physics.errors import DomainError

SOLVER_SHARE = 0.1
"""Share of a scene's force tolerance that the search may use up: a tenth adds 0.5% to the whole, in square."""

SAME_TIME = 1.1
"""Times within this ratio are no difference: the machine's own noise; then the more accurate search is better."""


class Variant(msgspec.Struct, frozen=True, kw_only=True):
    """One search with its settings, and what was measured of it on a network with `hidden` units.

    `solver_force_max_N` is the greatest difference between the force asked and the network's force at the answer.
    """

    solver: str
    step_mT: float
    neighbours: int
    dtype: str
    hidden: int
    p50_us: float
    solver_force_max_N: float


class Choice(NamedTuple):
    """A search with its settings, and why it was taken, for the log."""

    solver: str
    step_mT: float
    neighbours: int
    dtype: str
    reason: str


_DTYPE: dict[str, type[np.floating]] = {"float32": np.float32, "float64": np.float64}
_REFINEMENTS: dict[str, Refinement] = {"coarse-to-fine": finer_grid, "newton": newton}

RUNTIME_SOLVERS = ("nearest", *_REFINEMENTS)
"""The searches that the daemon may run. They answer from the curve alone and keep the branch of the last field.

The k-d tree and Brent's method want scipy, the direct inverse a training of its own; the closed form does not use the
learned model, and the row-by-row searches are baselines.
"""

_USUAL_STEP_MT = {"nearest": 2.0, "coarse-to-fine": 20.0, "newton": 20.0}
_USUAL_NEIGHBOURS = 4


def solver_table() -> tuple[Variant, ...]:
    """The measured table that comes with the package."""
    data = (resources.files(__package__) / "solver_table.json").read_bytes()
    return tuple(msgspec.json.decode(data, type=list[Variant]))


def choose(variants: Sequence[Variant], tolerance_N: float, hidden: int) -> Choice:
    """The cheapest runtime search whose force error stays under `SOLVER_SHARE` of `tolerance_N` (see `SAME_TIME`).

    Rows for the least measured network with at least `hidden` units count, or for the largest. Where no search is
    accurate enough, the most accurate is taken, and the reason says so. Raises `DomainError` on a table without rows.
    """
    offered = [variant for variant in variants if variant.solver in RUNTIME_SOLVERS]
    if not offered:
        raise DomainError("solver table", "no rows", f"rows for one of {', '.join(RUNTIME_SOLVERS)}")
    sizes = {variant.hidden for variant in offered}
    size = min((size for size in sizes if size >= hidden), default=max(sizes))
    offered = [variant for variant in offered if variant.hidden == size]
    allowed_N = SOLVER_SHARE * tolerance_N
    accurate = [variant for variant in offered if variant.solver_force_max_N <= allowed_N]
    if accurate:
        fast_us = SAME_TIME * min(variant.p50_us for variant in accurate)
        best = min((item for item in accurate if item.p50_us <= fast_us), key=lambda item: item.solver_force_max_N)
        why = "the cheapest within"
    else:
        best = min(offered, key=lambda variant: variant.solver_force_max_N)
        why = "the most accurate, but outside"
    reason = f"{why} {1e3 * allowed_N:.3g} mN: {1e3 * best.solver_force_max_N:.2g} mN, {best.p50_us:.0f} us measured"
    return Choice(best.solver, best.step_mT, best.neighbours, best.dtype, reason)


def named(solver: str, step_mT: float | None = None, neighbours: int | None = None) -> Choice:
    """A search by its name, with its usual settings where none are given. Raises `DomainError` on another name."""
    if solver not in RUNTIME_SOLVERS:
        raise DomainError("solver.name", repr(solver), f"one of {', '.join(RUNTIME_SOLVERS)}")
    step_mT = _USUAL_STEP_MT[solver] if step_mT is None else step_mT
    neighbours = _USUAL_NEIGHBOURS if neighbours is None else neighbours
    return Choice(solver, step_mT, neighbours, "float64", "named by the scene")


def build(choice: Choice, field_range_mT: tuple[float, float], *, rises: bool) -> FieldSolver:
    """The search that was chosen. Raises `DomainError` where its settings do not fit the range.

    `rises` says that every curve is known to rise over the range: "newton" then needs no look for other roots, and has
    no settings.
    """
    if choice.solver == "newton" and rises:
        return RisingSearch(field_range_mT)
    dtype = _DTYPE[choice.dtype]
    if choice.solver == "nearest":
        return NearestFieldSearch(
            field_range_mT=field_range_mT, step_mT=choice.step_mT, neighbours=choice.neighbours, dtype=dtype
        )
    refine = _REFINEMENTS[choice.solver]
    return BracketedSearch(field_range_mT=field_range_mT, refine=refine, step_mT=choice.step_mT, dtype=dtype)
