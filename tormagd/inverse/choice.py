"""The searches that the daemon may run, by name."""

from typing import NamedTuple

from tormagd.inverse.bracketed import BracketedSearch, Refinement, finer_grid, newton
from tormagd.inverse.nearest import NearestFieldSearch
from tormagd.inverse.newton import RisingSearch
from tormagd.inverse.solution import FieldSolver
from tormagd.physics.errors import DomainError


class Choice(NamedTuple):
    """A search with its settings, and why it was taken, for the log."""

    solver: str
    step_mT: float
    neighbours: int
    reason: str


_REFINEMENTS: dict[str, Refinement] = {"coarse-to-fine": finer_grid, "newton": newton}

RUNTIME_SOLVERS = ("nearest", *_REFINEMENTS)
"""The searches that the daemon may run. They answer from the curve alone and keep the branch of the last field."""

_USUAL_STEP_MT = {"nearest": 2.0, "coarse-to-fine": 20.0, "newton": 20.0}
_USUAL_NEIGHBOURS = 4


def named(
    solver: str, step_mT: float | None = None, neighbours: int | None = None, reason: str = "named by the scene"
) -> Choice:
    """A search by its name, with its usual settings where none are given. Raises `DomainError` on another name."""
    if solver not in RUNTIME_SOLVERS:
        raise DomainError("solver.name", repr(solver), f"one of {', '.join(RUNTIME_SOLVERS)}")
    step_mT = _USUAL_STEP_MT[solver] if step_mT is None else step_mT
    neighbours = _USUAL_NEIGHBOURS if neighbours is None else neighbours
    return Choice(solver, step_mT, neighbours, reason)


def build(choice: Choice, field_range_mT: tuple[float, float], *, rises: bool) -> FieldSolver:
    """The search that was chosen. Raises `DomainError` where its settings do not fit the range.

    `rises` says that every curve is known to rise over the range: "newton" then needs no look for other roots, and has
    no settings.
    """
    if choice.solver == "newton" and rises:
        return RisingSearch(field_range_mT)
    if choice.solver == "nearest":
        return NearestFieldSearch(field_range_mT=field_range_mT, step_mT=choice.step_mT, neighbours=choice.neighbours)
    refine = _REFINEMENTS[choice.solver]
    return BracketedSearch(field_range_mT=field_range_mT, refine=refine, step_mT=choice.step_mT)
