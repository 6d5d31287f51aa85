"""The design of a brake, and the thesis's tables 2.4 and 2.5."""

import dataclasses
import itertools
import math
import re
from argparse import Namespace
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormag_lab.arrays import Json
from tormag_lab.design import optimisation
from tormag_lab.design.brake import Brake
from tormag_lab.design.optimisation import (
    SLACK,
    Design,
    Problem,
    Run,
    coverage,
    solve,
    sweep,
)
from tormag_lab.design.phase_portrait import PhasePortrait, Region
from tormag_lab.design.range_fit import (
    fit_exponent,
    fit_friction,
    frictionless_range_N,
    mean_relative_error,
)
from tormag_lab.thesis import page, reproduction, table_2_5
from tormag_lab.thesis.table_2_5 import judge, rank
from tormag_lab.thesis.values import TABLE_2_5, ForceTask
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import FieldLaw, PowerFieldLaw, ThesisFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.element.physics.inserts import INSERTS

BRAKE = Brake.as_built(Elastomer(300e3, 3.8, 0.2))
USE_CASE_1, USE_CASE_2 = Region(0.0, 0.0, 2.5, 1.0), Region(0.5, 0.25, 3.0, 1.0)
THESIS_SPEED_MM_S = 25.0 / 3.0
PROBLEM = Problem(USE_CASE_2, "true", 40.0)
AS_BUILT = Design(11.0, 20.0, 95.0)


def count_points(portrait: PhasePortrait, region: Region, *, true: bool, side: int = 500) -> float:
    """Coverage by counting points of the region, without an integral."""
    force, share = np.meshgrid((np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side)
    force = region.least_N + force * (region.most_N - region.least_N)
    # equal steps of rate share have unequal height: weigh each point with it
    required = region.rate_N_s(force)
    judge = portrait.true_cloud if true else portrait.trapezoid_cloud
    covered = judge(force.ravel(), (share * required).ravel()).reshape(force.shape)
    return float(np.sum(covered * required) / np.sum(required))


@pytest.mark.parametrize("speed", [THESIS_SPEED_MM_S, 40.0])
@pytest.mark.parametrize("region", [USE_CASE_1, USE_CASE_2])
def test_coverage_agrees_with_counted_points(region: Region, speed: float) -> None:
    portrait = PhasePortrait(BRAKE, speed)
    counted = [count_points(portrait, region, true=true) for true in (True, False)]
    assert [portrait.true_coverage(region), portrait.trapezoid_coverage(region)] == pytest.approx(counted, abs=1e-3)


OUT_OF_REACH = Region(BRAKE.most_N, 0.1, BRAKE.most_N + 1.0, 0.1)


@pytest.mark.parametrize(("region", "share"), [(OUT_OF_REACH, 0.0), (Region(2.0, 0.1, 3.0, 0.1), 1.0)])
def test_a_region_out_of_reach_is_not_covered_and_one_inside_is_whole(region: Region, share: float) -> None:
    portrait = PhasePortrait(BRAKE, 40.0)
    covered = (portrait.true_coverage(region), portrait.trapezoid_coverage(region))
    assert covered == pytest.approx((share, share), abs=1e-12)


@given(
    least=st.floats(0.0, 5.0),
    width=st.floats(0.01, 5.0),
    rates=st.tuples(st.floats(0.0, 10.0), st.floats(0.01, 10.0)),
    speed=st.floats(0.1, 100.0),
)
def test_coverage_is_a_share_that_grows_with_the_gap_speed(
    least: float, width: float, rates: tuple[float, float], speed: float
) -> None:
    region = Region(least, rates[0], least + width, rates[1])
    slow, fast = PhasePortrait(BRAKE, speed), PhasePortrait(BRAKE, 2.0 * speed)
    for name in ("true_coverage", "trapezoid_coverage"):
        assert 0.0 <= getattr(slow, name)(region) <= getattr(fast, name)(region) + 1e-9 <= 1.0 + 1e-9


def test_a_point_that_is_too_fast_or_out_of_range_is_not_covered() -> None:
    limit = 40.0 * BRAKE.slope_N_mm(BRAKE.gap_mm(2.0))
    force = np.array([2.0, 2.0, 2.0, 0.5 * BRAKE.least_N, BRAKE.most_N + 0.1])
    rate = np.array([0.99 * limit, 1.01 * limit, -1.01 * limit, 0.0, 0.0])
    portrait = PhasePortrait(BRAKE, 40.0)
    assert portrait.true_cloud(force, rate).tolist() == [True, False, False, False, False]
    assert portrait.trapezoid_cloud(force, rate).tolist() == [True, True, True, False, False]


@pytest.mark.parametrize("g0_Pa", [20e3, 79.5e3, 185.5e3, 277.3e3])
@pytest.mark.parametrize("law", [ThesisFieldLaw(), PowerFieldLaw()])
def test_end_forces_come_back_as_end_gaps(law: FieldLaw, g0_Pa: float) -> None:
    device = Brake.as_built(Elastomer(g0_Pa, 2.7, 0.2), law)
    ends = [device.most_N, device.least_N]
    # Eq. 7 is flat at 95 mm, so its inverse has half of the digits there
    assert [device.gap_mm(force) for force in ends] == pytest.approx([45.0, 95.0], abs=1e-4)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Region(0.5, 0.1, 0.5, 0.1), "^most_N "),
        (lambda: Region(-0.1, 0.1, 0.5, 0.1), "^least_N "),
        (lambda: Region(0.0, math.nan, 0.5, 0.1), "^least_rate_N_s "),
        (lambda: Region(0.0, 0.0, math.inf, 0.1), "^most_N "),
        (lambda: Region(0.0, 0.0, 0.5, 0.0), "^most_rate_N_s "),
        (lambda: dataclasses.replace(BRAKE, closed_mm=95.0, open_mm=45.0), "open_mm"),
        (lambda: dataclasses.replace(BRAKE, field=ThesisFieldLaw(), open_mm=120.0), "open_mm = 120"),
        (lambda: dataclasses.replace(BRAKE, elastomer=Elastomer(5e3, 3.8, 0.2), closed_mm=5.0), "radial_moment_Tm"),
        (lambda: PhasePortrait(BRAKE, 0.0), "gap_speed_mm_s"),
        (lambda: BRAKE.gap_mm(2.0 * BRAKE.most_N), "force_N"),
    ],
)
def test_impossible_regions_brakes_and_speeds_are_refused(made: Callable[[], object], said: str) -> None:
    with pytest.raises(DomainError, match=said):
        made()


@pytest.fixture
def few_generations(monkeypatch: pytest.MonkeyPatch) -> None:
    """An evolution that ends early: what it keeps only gets better."""
    monkeypatch.setattr(optimisation, "_GENERATIONS", 8)


def grid(problem: Problem, side: int) -> list[Design]:
    low, high = (msgspec.structs.astuple(bound) for bound in (problem.lower, problem.upper))
    axes = [np.linspace(a, b, side) for a, b in zip(low, high, strict=True)]
    return [Design(*(float(value) for value in point)) for point in itertools.product(*axes)]


@pytest.mark.parametrize(
    ("use_case", "measure", "speed", "bar"),
    [
        (USE_CASE_1, "true", 40.0, 0.99),
        (USE_CASE_2, "trapezoid", THESIS_SPEED_MM_S, 0.999),
        (USE_CASE_2, "true", THESIS_SPEED_MM_S, 0.974),
    ],
)
@pytest.mark.usefixtures("few_generations")
def test_the_best_design_is_above_the_bar(use_case: Region, measure: str, speed: float, bar: float) -> None:
    problem = Problem(use_case, measure, speed)
    assert solve(Run(problem, problem.lower))["coverage"] >= bar


def test_no_design_on_a_grid_is_better_or_as_good_and_smaller() -> None:
    best = solve(Run(PROBLEM, PROBLEM.lower))
    assert best["coverage"] >= 0.995
    reached = {design: coverage(PROBLEM, design) for design in grid(PROBLEM, 7)}
    assert max(reached.values()) <= best["coverage"] + 2 * SLACK
    as_good_mm3 = [PROBLEM.volume_mm3(design) for design, share in reached.items() if share >= best["coverage"]]
    assert min(as_good_mm3, default=math.inf) >= 0.999 * best["volume_mm3"]


@pytest.mark.usefixtures("few_generations")
def test_nothing_less_than_the_start_is_returned() -> None:
    covering = Problem(USE_CASE_1, "true", THESIS_SPEED_MM_S)
    assert solve(Run(covering, AS_BUILT))["coverage"] >= coverage(covering, AS_BUILT) - SLACK


@pytest.mark.usefixtures("few_generations")
def test_a_soft_elastomer_keeps_clear_of_collapse() -> None:
    soft = msgspec.structs.replace(PROBLEM, elastomer=Elastomer(20e3, 3.8, 0.2))
    margins = [soft.load_margin(design) for design in grid(soft, 5)]
    assert min(margins) < 0.0 < max(margins)
    outcome = solve(Run(soft, Design(45.0, 50.0, 200.0)))
    assert soft.load_margin(outcome["design"]) >= 0.0
    assert outcome["coverage"] > 0.9


JELLY = msgspec.structs.replace(PROBLEM, elastomer=Elastomer(2e3, 6.0, 0.2))


@pytest.mark.usefixtures("few_generations")
def test_an_elastomer_too_soft_for_any_design_is_refused() -> None:
    assert max(JELLY.load_margin(design) for design in grid(JELLY, 5)) < 0.0
    with pytest.raises(DomainError, match="shear_modulus_Pa"):
        solve(Run(JELLY, AS_BUILT))


RUNS = [Run(Problem(region, "trapezoid", THESIS_SPEED_MM_S), AS_BUILT) for region in (USE_CASE_1, USE_CASE_2)]


@pytest.fixture
def thread(monkeypatch: pytest.MonkeyPatch) -> Iterator[Executor]:
    monkeypatch.setattr(optimisation, "_GENERATIONS", 1)
    with ThreadPoolExecutor(1) as executor:
        yield executor


def test_other_processes_give_the_same_answer(thread: Executor) -> None:
    with ProcessPoolExecutor(1) as pool:
        found = [sweep(RUNS, executor) for executor in (thread, pool)]
    here, there = ([(run, each["design"], each["coverage"]) for run, each in outcomes.items()] for outcomes in found)
    assert (here, [run for run, *_ in here]) == (there, RUNS)
    assert len({design for _, design, _ in here}) > 1


def test_runs_that_stand_twice_are_solved_once(thread: Executor) -> None:
    counting = Mock(submit=Mock(side_effect=thread.submit))
    assert (list(sweep([RUNS[0], RUNS[0]], counting)), counting.submit.call_count) == (RUNS[:1], 1)


def test_a_run_that_fails_ends_the_sweep(thread: Executor) -> None:
    with pytest.raises(DomainError, match="shear_modulus_Pa"):
        sweep([*RUNS, Run(JELLY, AS_BUILT)], thread)


STEP_MM = 0.1


def judged(least_N: float, most_N: float, resolution_N: float, brake: Brake = BRAKE) -> Json:
    return judge("MRE-50-40", brake, ForceTask("task", least_N, most_N, resolution_N), STEP_MM)


def test_a_task_within_the_brake_is_served_by_its_coarsest_step() -> None:
    verdict, coarsest_N = judged(1.0, 2.0, 0.1), STEP_MM * BRAKE.slope_N_mm(BRAKE.gap_mm(2.0))
    assert (verdict["served_share"], verdict["resolution_mN"]) == pytest.approx((1.0, 1e3 * coarsest_N), rel=1e-9)


@pytest.mark.parametrize(
    ("task_N", "reasons"),
    [
        ((1.0, 2.0, 0.1), []),
        ((0.0, 2.0, 0.1), ["least force"]),
        ((1.0, 50.0, 0.1), ["most force"]),
        ((1.0, 2.0, 0.001), ["one gap"]),
        # a least force missed by less than the resolution is served
        ((BRAKE.least_N - 0.05, 2.0, 0.051), []),
        ((BRAKE.least_N - 0.05, 2.0, 0.049), ["least force"]),
    ],
)
def test_each_lack_is_a_reason(task_N: tuple[float, float, float], reasons: list[str]) -> None:
    assert [" ".join(reason.split()[:2]) for reason in judged(*task_N)["reasons"]] == reasons


def test_ranking_puts_the_finest_that_serves_first() -> None:
    weakly = dataclasses.replace(BRAKE.elastomer, friction_coefficient=0.15)
    inserts = {
        "MRE-10-10": dataclasses.replace(BRAKE, closed_mm=90.0),  # reaches too little
        "MRE-50-40": BRAKE,
        "MRE-30-40": dataclasses.replace(BRAKE, elastomer=weakly, closed_mm=50.0),
        "MRE-30-30": dataclasses.replace(BRAKE, closed_mm=60.0),
    }
    ranked = rank(inserts, ForceTask("task", 1.0, 1.5, 0.1), STEP_MM)
    steps_mN = [row["resolution_mN"] for row in ranked if row["serves"]]
    assert (ranked[-1]["insert"], len(steps_mN)) == ("MRE-10-10", 3)
    assert steps_mN == sorted(steps_mN)


ALL = list(INSERTS.values())
LAWS = (ThesisFieldLaw(), PowerFieldLaw())


@pytest.mark.parametrize("law", LAWS)
def test_table_2_4_within_the_thesis_error(law: FieldLaw) -> None:
    assert mean_relative_error(fit_friction(ALL, law), ALL) <= 0.102
    assert mean_relative_error(fit_exponent(ALL, law), ALL) <= 0.075


def test_the_registrys_friction_is_the_least_squares_of_the_relative_errors() -> None:
    for matrix in (ALL[:4], ALL[4:8], ALL[8:]):
        ratios = np.array([frictionless_range_N(item, LAWS[0]) / item.force_range.measured_N for item in matrix])
        least = ratios.sum() / (ratios**2).sum()
        assert {item.elastomer.friction_coefficient for item in matrix} == {round(float(least), 3)}


def test_exponent_one_is_the_force_law_itself() -> None:
    item, law = INSERTS["MRE-50-20"], PowerFieldLaw()
    forces = brake_force_N(law.radial_moment_Tm(np.array([45.0, 95.0])), item.elastomer, TORMAG)
    friction = item.elastomer.friction_coefficient
    assert friction * frictionless_range_N(item, law) == pytest.approx(forces[0] - forces[1], rel=1e-12)


FOUND = table_2_5.table_2_5()


def test_every_insert_stands_before_every_task_in_both_readings() -> None:
    for (task, _), found in zip(TABLE_2_5, FOUND["tasks"], strict=True):
        assert {row["insert"] for row in found["ranked"]} == set(INSERTS)
        for row in found["ranked"]:
            wide = INSERTS[row["insert"]].force_range.measured_N >= task.most_N - task.least_N
            assert (row["matched_share"] == 1.0) == wide
            assert not row["serves"]  # every task begins at 0 N


def test_the_page_has_it() -> None:
    assert page.table_2_5(FOUND) in Path(__file__).parents[2].joinpath("docs/reproduction.md").read_text("utf-8")


def test_a_reproduction_that_is_stopped_writes_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproduction, "ProcessPoolExecutor", ThreadPoolExecutor)
    monkeypatch.setattr(reproduction, "chapter_4", dict)
    monkeypatch.setattr(reproduction, "step_test", Mock(side_effect=KeyboardInterrupt))
    assert reproduction.run(Namespace(out=tmp_path, gap_speed=40.0, workers=1, seed=1)).exit_code == 130
    written = (tmp_path / "reproduction.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\w+ ?[\d.]*)", written, re.M) == [
        "Table 2.3",
        "Table 2.4",
        "Table 2.5",
        "Figure 2.5",
        "Errata",
    ]
    assert [path.name for path in (tmp_path / "reproduction").iterdir()] == ["figure_2_5.png"]
