"""The searches that the daemon may run, by name."""

from typing import NamedTuple

from tormagd.element.inverse.nearest import NearestFieldSearch, field_grid
from tormagd.element.inverse.newton import RisingSearch
from tormagd.element.inverse.solution import FieldSolver
from tormagd.element.model.model_file import ForceModel
from tormagd.element.physics.errors import DomainError, require_that


class Choice(NamedTuple):
    """A search with its settings, and why it was taken."""

    solver: str
    step_mT: float
    neighbours: int
    reason: str


_USUAL = {"newton": (0.0, 0), "nearest": (2.0, 4), "torch": (1.0, 4), "thesis": (1.0, 0)}
"The usual step of the grid, mT, and number of neighbours."

RUNTIME_SOLVERS = tuple(_USUAL)
OF_TORCH = ("torch", "thesis")
"Searches for which torch is loaded."
BESIDE_PLANS = ("thesis",)
"They take longer than a plan has, and run in a process of their own."


def named(
    solver: str, step_mT: float | None = None, neighbours: int | None = None, reason: str = "named by the scene"
) -> Choice:
    """Return the choice of a search by its name; None stands for a usual setting."""
    require_that(solver in _USUAL, "solver.name", repr(solver), f"one of {', '.join(RUNTIME_SOLVERS)}")
    settings = []
    for key, given, usual in zip(("step_mT", "neighbours"), (step_mT, neighbours), _USUAL[solver], strict=True):
        require_that(given is None or usual > 0, f"solver.{key}", given, f"none beside solver.name = {solver!r}")
        settings.append(usual if given is None else given)
    return Choice(solver, float(settings[0]), int(settings[1]), reason)


def build(choice: Choice, field_range_mT: tuple[float, float], model: ForceModel, *, rises: bool) -> FieldSolver:
    if choice.solver == "newton":
        require_that(rises, "solver.name", "'newton'", "nearest or torch where the model's force falls somewhere")
        return RisingSearch(field_range_mT)
    fields_mT = field_grid(field_range_mT, choice.step_mT)
    if choice.solver == "nearest":
        return NearestFieldSearch(fields_mT, choice.neighbours)
    try:
        from tormagd.element.inverse import ordered
    except ModuleNotFoundError as error:
        allowed = f"one of {', '.join(name for name in RUNTIME_SOLVERS if name not in OF_TORCH)} without it"
        raise DomainError("solver.name", f"{choice.solver!r}, which needs the package {error.name}", allowed) from error
    if choice.solver == "torch":
        return NearestFieldSearch(fields_mT, choice.neighbours, ordered.batch(model, fields_mT))
    return ordered.RowByRow(fields_mT, mean_error_N(model), ordered.row(model))


def mean_error_N(model: ForceModel) -> float:
    name, metrics = "validation_mae_N", model.metadata.metrics
    require_that(name in metrics, name, "missing in the model's metrics", "a model that states its mean error")
    return metrics[name]
