"""The design of a brake: its coverage, the best designs, sweeps of searches, and inserts before tasks."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.lab.design import optimisation
from tormagd.lab.design.brake import Brake
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
from tormagd.lab.design.phase_portrait import PhasePortrait, Region
from tormagd.lab.design.selection import ForceTask, judge, rank
from tormagd.lab.design.sweep import sweep
from tormagd.physics.errors import DomainError
from tormagd.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.physics.force import TORMAG, Elastomer

# -- coverage in the phase portrait ------------------------------------------------------------------------------------


SPEEDS = (25.0 / 3.0, 40.0)


def count_points(portrait: PhasePortrait, region: Region, *, true: bool, side: int = 500) -> float:
    """Coverage by counting a grid of points in the region: slow, and without an integral."""
    force, share = np.meshgrid((np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side)
    force = region.least_N + force * (region.most_N - region.least_N)
    # rows of equal share of the rate have unequal height: weigh each point with it
    required = region.rate_N_s(force)
    judge = portrait.true_cloud if true else portrait.trapezoid_cloud
    covered = judge(force.ravel(), (share * required).ravel()).covered.reshape(force.shape)
    return float(np.sum(covered * required) / np.sum(required))


@pytest.mark.parametrize("speed", SPEEDS)
def test_coverage_agrees_with_counted_points(
    brake: Brake, use_case_1: Region, use_case_2: Region, speed: float
) -> None:
    portrait = PhasePortrait(brake, speed)
    for region in (use_case_1, use_case_2):
        counted = [count_points(portrait, region, true=true) for true in (True, False)]
        assert [portrait.true_coverage(region), portrait.trapezoid_coverage(region)] == pytest.approx(counted, abs=1e-3)


def test_a_region_out_of_reach_is_not_covered_and_one_inside_is_whole(brake: Brake) -> None:
    portrait = PhasePortrait(brake, 40.0)
    for region, share in ((Region(brake.most_N, 0.1, brake.most_N + 1.0, 0.1), 0.0), (Region(2.0, 0.1, 3.0, 0.1), 1.0)):
        assert (portrait.true_coverage(region), portrait.trapezoid_coverage(region)) == pytest.approx(
            (share, share), abs=1e-12
        )


@given(
    least=st.floats(0.0, 5.0),
    width=st.floats(0.01, 5.0),
    rates=st.tuples(st.floats(0.0, 10.0), st.floats(0.01, 10.0)),
    speed=st.floats(0.1, 100.0),
)
def test_coverage_is_a_share_that_grows_with_the_gap_speed(
    brake: Brake, least: float, width: float, rates: tuple[float, float], speed: float
) -> None:
    region = Region(least, rates[0], least + width, rates[1])
    slow, fast = PhasePortrait(brake, speed), PhasePortrait(brake, 2.0 * speed)
    for name in ("true_coverage", "trapezoid_coverage"):
        assert 0.0 <= getattr(slow, name)(region) <= getattr(fast, name)(region) + 1e-9 <= 1.0 + 1e-9


def test_cloud_says_which_points_fail_and_why(brake: Brake) -> None:
    portrait = PhasePortrait(brake, 40.0)
    limit = 40.0 * brake.slope_N_mm(brake.gap_mm(2.0))
    force = np.array([2.0, 2.0, 2.0, 0.5 * brake.least_N, brake.most_N + 0.1])
    cloud = portrait.true_cloud(force, np.array([0.99 * limit, 1.01 * limit, -1.01 * limit, 0.0, 0.0]))
    said = [cloud.covered, cloud.too_fast, cloud.below_least_force, cloud.above_most_force]
    assert [np.flatnonzero(points).tolist() for points in said] == [[0], [1, 2], [3], [4]]
    assert cloud.share == pytest.approx(0.2)


@pytest.mark.parametrize("g0_Pa", [20e3, 79.5e3, 185.5e3, 277.3e3])
@pytest.mark.parametrize("law", [ThesisFieldLaw(), PowerFieldLaw()])
def test_end_forces_come_back_as_end_gaps(law: FieldLaw, g0_Pa: float) -> None:
    device = Brake(law, Elastomer(g0_Pa, 2.7, 0.2), TORMAG, 45.0, 95.0)
    ends = [device.most_N, device.least_N]
    # Eq. 7 is flat at 95 mm: its inverse has half of the digits there
    assert [device.gap_mm(force) for force in ends] == pytest.approx([45.0, 95.0], abs=1e-4)
    assert device.gap_mm(np.array(ends)) == pytest.approx([45.0, 95.0], abs=1e-4)


SOFT, USUAL = Elastomer(5e3, 3.8, 0.2), Elastomer(300e3, 3.8, 0.2)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda _: Region(0.5, 0.1, 0.5, 0.1), "^most_N "),
        (lambda _: Region(-0.1, 0.1, 0.5, 0.1), "^least_N "),
        (lambda _: Region(0.0, math.nan, 0.5, 0.1), "^least_rate_N_s "),
        (lambda _: Region(0.0, 0.0, math.inf, 0.1), "^most_N "),
        (lambda _: Region(0.0, 0.0, 0.5, 0.0), "^most_rate_N_s "),
        (lambda _: Brake(PowerFieldLaw(), USUAL, TORMAG, 95.0, 45.0), "open_mm"),
        (lambda _: Brake(ThesisFieldLaw(), USUAL, TORMAG, 45.0, 120.0), "open_mm = 120"),
        (lambda _: Brake(PowerFieldLaw(), SOFT, TORMAG, 5.0, 95.0), "radial_moment_Tm"),
        (lambda brake: PhasePortrait(brake, 0.0), "gap_speed_mm_s"),
        (lambda brake: brake.gap_mm(2.0 * brake.most_N), "force_N"),
    ],
)
def test_impossible_regions_brakes_and_speeds_are_refused(
    brake: Brake, made: Callable[[Brake], object], said: str
) -> None:
    with pytest.raises(DomainError, match=said):
        made(brake)


# -- the best design ---------------------------------------------------------------------------------------------------


THESIS_SPEED_MM_S = 25.0 / 3.0
FEW = 8
"Generations."


def found(problem: Problem, start: Design) -> Outcome:
    """What the global search finds."""
    return solve(Run(problem, start, "global"))


@pytest.fixture
def few_generations(monkeypatch: pytest.MonkeyPatch) -> None:
    """An evolution that ends at less than a fifth: what it keeps only gets better."""
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


# -- sweeps of searches ------------------------------------------------------------------------------------------------


@pytest.fixture
def runs(problem: Problem) -> list[Run]:
    """Local ones: quick, and each with its own answer."""
    slow = msgspec.structs.replace(problem, gap_speed_mm_s=8.0)
    starts = (Design(11.0, 20.0, 95.0), Design(7.0, 27.0, 150.0), Design(20.0, 15.0, 100.0))
    return [Run(slow, start, "local") for start in starts]


@pytest.fixture
def thread() -> Iterator[Executor]:
    with ThreadPoolExecutor(1) as executor:
        yield executor


def answers(outcomes: dict[Run, Outcome]) -> list[tuple[Design, float]]:
    """All but the processor time."""
    return [(outcome.design, outcome.coverage) for outcome in outcomes.values()]


def test_other_processes_give_the_same_answer(runs: list[Run], thread: Executor) -> None:
    """As Dask's workers do: a run goes there and its outcome comes back."""
    here = sweep(runs, thread)
    with ProcessPoolExecutor(1) as pool:
        there = sweep(runs, pool)
    assert (answers(here), list(here)) == (answers(there), runs)
    assert len({outcome.design for outcome in here.values()}) > 1


def test_runs_that_stand_twice_are_solved_once(runs: list[Run], thread: Executor) -> None:
    counting = Mock(submit=Mock(side_effect=thread.submit))
    assert list(sweep([runs[0], runs[0]], counting)) == runs[:1]
    assert counting.submit.call_count == 1


def test_a_run_that_fails_ends_the_sweep(runs: list[Run], thread: Executor) -> None:
    impossible = msgspec.structs.replace(runs[0].problem, shear_modulus_Pa=2e3, relative_permeability=6.0)
    with pytest.raises(DomainError, match="shear_modulus_Pa"):
        sweep([*runs, msgspec.structs.replace(runs[0], problem=impossible)], thread)


# -- inserts before a task ---------------------------------------------------------------------------------------------


STEP_MM = 0.1


def test_a_task_within_the_brake_is_served(brake: Brake) -> None:
    verdict = judge("it", brake, ForceTask("task", 1.0, 2.0, 0.1), STEP_MM)
    assert not verdict.reasons
    assert (verdict.served_share, verdict.resolution_N) == (
        pytest.approx(1.0),
        pytest.approx(STEP_MM * brake.slope_N_mm(brake.gap_mm(2.0)), rel=1e-9),
    )


@pytest.mark.parametrize(
    ("task", "step_mm", "reason"),
    [
        (ForceTask("low", 0.0, 2.0, 0.1), STEP_MM, "least force"),
        (ForceTask("high", 1.0, 50.0, 0.1), STEP_MM, "most force"),
        (ForceTask("fine", 1.0, 2.0, 0.001), STEP_MM, "one gap step"),
    ],
)
def test_each_lack_is_a_reason(brake: Brake, task: ForceTask, step_mm: float, reason: str) -> None:
    verdict = judge("it", brake, task, step_mm)
    assert len(verdict.reasons) == 1
    assert verdict.reasons[0].startswith(reason)


def test_a_least_force_missed_by_less_than_the_resolution_is_served(brake: Brake) -> None:
    least = brake.least_N - 0.05
    assert not judge("it", brake, ForceTask("task", least, 2.0, 0.051), STEP_MM).reasons
    assert judge("it", brake, ForceTask("task", least, 2.0, 0.049), STEP_MM).reasons


def test_the_sufficient_gap_makes_the_brake_serve(brake: Brake) -> None:
    task = ForceTask("task", 0.0, 2.0, 0.1)
    gap = judge("it", brake, task, STEP_MM).sufficient_gap_mm
    assert gap > brake.open_mm
    assert not judge("it", dataclasses.replace(brake, open_mm=gap * 1.0001), task, STEP_MM).reasons


def test_ranking_puts_the_finest_that_serves_first(brake: Brake) -> None:
    finer = dataclasses.replace(brake, closed_mm=60.0)
    short = dataclasses.replace(brake, closed_mm=90.0)
    weak = dataclasses.replace(
        brake, elastomer=dataclasses.replace(brake.elastomer, friction_coefficient=0.15), closed_mm=50.0
    )
    task = ForceTask("task", 1.0, 1.5, 0.1)
    ranked = rank({"short": short, "coarse": brake, "weak": weak, "finer": finer}, task, STEP_MM)
    serving = [verdict for verdict in ranked if not verdict.reasons]
    assert ([verdict.insert for verdict in ranked][-1], len(serving)) == ("short", 3)
    assert [v.resolution_N for v in serving] == sorted(v.resolution_N for v in serving)
