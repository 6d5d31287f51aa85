import dataclasses

import pytest

from tormagd.lab.design.brake import Brake
from tormagd.lab.design.selection import ForceTask, judge, rank

STEP_MM = 0.1


def test_a_task_within_the_brake_is_served(brake: Brake) -> None:
    verdict = judge("it", brake, ForceTask("task", 1.0, 2.0, 0.1), STEP_MM)
    assert not verdict.reasons
    assert verdict.served_share == pytest.approx(1.0)
    assert verdict.resolution_N == pytest.approx(STEP_MM * brake.slope_N_mm(brake.gap_mm(2.0)), rel=1e-9)


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
    assert [verdict.insert for verdict in ranked][-1] == "short"
    assert len(serving) == 3
    assert [v.resolution_N for v in serving] == sorted(v.resolution_N for v in serving)
