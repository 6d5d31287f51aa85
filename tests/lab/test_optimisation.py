import itertools

import msgspec
import numpy as np
import pytest

from tormagd.lab.design import optimisation
from tormagd.lab.design.optimisation import (
    SLACK,
    Design,
    Outcome,
    Problem,
    Run,
    corner_cost,
    coverage,
    coverage_as_made,
    solve,
)
from tormagd.lab.design.phase_portrait import Region
from tormagd.physics.errors import DomainError

THESIS_SPEED_MM_S = 25.0 / 3.0
FEW = 15
"Generations."


def found(problem: Problem, start: Design) -> Outcome:
    """What the global search finds."""
    return solve(Run(problem, start, "global"))


@pytest.fixture
def few_generations(monkeypatch: pytest.MonkeyPatch) -> None:
    """An evolution that ends at less than a third: what it keeps only gets better."""
    monkeypatch.setattr(optimisation, "_GENERATIONS", FEW)


def grid(problem: Problem, side: int) -> list[Design]:
    low, high = (msgspec.structs.astuple(bound) for bound in (problem.lower, problem.upper))
    axes = [np.linspace(a, b, side) for a, b in zip(low, high, strict=True)]
    return [Design(*(float(value) for value in point)) for point in itertools.product(*axes)]


@pytest.mark.parametrize(
    ("use_case", "measure", "speed", "bar"),
    [
        (1, "true", 40.0, 0.99),
        (2, "trapezoid", THESIS_SPEED_MM_S, 0.999),
        (2, "true", THESIS_SPEED_MM_S, 0.974),
    ],
)
@pytest.mark.usefixtures("few_generations")
def test_the_best_design_is_above_the_bar(
    use_case_1: Region, use_case_2: Region, use_case: int, measure: str, speed: float, bar: float
) -> None:
    problem = Problem((use_case_1, use_case_2)[use_case - 1], measure, speed)
    assert found(problem, problem.lower).coverage >= bar


@pytest.mark.usefixtures("few_generations")
def test_no_design_on_a_grid_is_better_or_as_good_and_smaller(problem: Problem) -> None:
    best = found(problem, problem.lower)
    assert best.coverage >= 0.995
    for design in grid(problem, 7):
        reached = coverage(problem, design)
        assert reached <= best.coverage + 2 * SLACK
        if reached >= best.coverage:
            assert problem.volume_mm3(design) >= 0.999 * best.volume_mm3


@pytest.mark.usefixtures("few_generations")
@pytest.mark.parametrize("solver", ["local", "global"])
def test_no_solver_returns_less_than_its_start(use_case_1: Region, as_built: Design, solver: str) -> None:
    covering = Problem(use_case_1, "true", THESIS_SPEED_MM_S)
    assert solve(Run(covering, as_built, solver)).coverage >= coverage(covering, as_built) - SLACK
    corners = Problem(use_case_1, "corners", THESIS_SPEED_MM_S)
    assert solve(Run(corners, as_built, solver)).corner_cost <= corner_cost(corners, as_built)


@pytest.mark.usefixtures("few_generations")
def test_a_soft_elastomer_keeps_clear_of_collapse(use_case_2: Region) -> None:
    soft = Problem(use_case_2, "true", 40.0, shear_modulus_Pa=20e3)
    margins = [soft.load_margin(design) for design in grid(soft, 5)]
    assert min(margins) < 0.0 < max(margins)
    outcome = solve(Run(soft, Design(45.0, 50.0, 200.0), "global"))
    assert soft.load_margin(outcome.design) >= 0.0
    assert outcome.coverage > 0.9


@pytest.mark.usefixtures("few_generations")
def test_an_elastomer_too_soft_for_any_design_is_refused(use_case_2: Region, as_built: Design) -> None:
    jelly = Problem(use_case_2, "true", 40.0, shear_modulus_Pa=2e3, relative_permeability=6.0)
    assert max(jelly.load_margin(design) for design in grid(jelly, 5)) < 0.0
    for solver in ("local", "global"):
        with pytest.raises(DomainError, match="shear_modulus_Pa"):
            solve(Run(jelly, as_built, solver))


def test_what_a_design_covers_as_it_is_made_is_the_least_of_its_neighbours(use_case_1: Region) -> None:
    """The thesis's printed optimum of use case 1: what rounding to its printed digits does, and a percent of each."""
    problem, printed = Problem(use_case_1, "trapezoid", THESIS_SPEED_MM_S), Design(7.3, 12.5, 197.0)
    assert coverage_as_made(problem, printed, 0.0) == coverage(problem, printed)
    least = coverage_as_made(problem, printed, 0.01)
    assert least < coverage_as_made(problem, printed, 0.001) < coverage(problem, printed)
    assert least <= coverage(problem, msgspec.structs.replace(printed, thickness_mm=0.99 * printed.thickness_mm))


def test_a_design_that_cannot_bear_its_field_as_made_covers_nothing(use_case_1: Region) -> None:
    soft = Problem(use_case_1, "true", 38.0, shear_modulus_Pa=10e3)
    assert soft.load_margin(Design(6.5, 12.5, 197.0)) < 0.0
    assert coverage_as_made(soft, Design(6.5, 12.5, 197.0), 0.01) == 0.0
