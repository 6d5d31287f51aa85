"""When plans are made: at once where the slack allows, right after the tick where not, and at the latest when due."""

import random
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tormagd.assembly.journal import Journal
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.inbox import SetpointInbox
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.physics.errors import DomainError

US = 1_000
TICK_NS = 1_000 * US
DUE_NS = 4 * TICK_NS


class Rig:
    """An inference loop whose plans take as long as the test says, on a clock that moves with them."""

    def __init__(self, planner: Any = None) -> None:
        self.now_ns = 1_000 * TICK_NS
        self.plan_ns = 60 * US
        self.has_arrived = False
        self.planned_ns: list[int] = []
        self.foreseen_ns: list[int] = []
        self.failed, self.inbox, self.journal = Mock(), SetpointInbox(), Journal()
        planner = planner or SimpleNamespace(plan=self.plan, foresee=self.foresee)
        endpoint: Any = SimpleNamespace(drain_setpoints=self.drain, is_flooded=False, inbox=self.inbox)
        self.loop = InferenceLoop(
            planner, endpoint, DUE_NS, lambda: self.now_ns, journal=self.journal, on_failure=self.failed
        )

    def plan(self, *_arguments: Any) -> None:
        self.planned_ns.append(self.now_ns)
        self.now_ns += self.plan_ns

    def foresee(self) -> None:
        self.foreseen_ns.append(self.now_ns)

    def drain(self) -> bool:
        arrived, self.has_arrived = self.has_arrived, False
        return arrived

    def setpoint(self, at_ns: int, next_tick_ns: int) -> None:
        """One arrives, and the event loop says so."""
        self.now_ns, self.has_arrived = at_ns, True
        self.loop.receive(None, next_tick_ns)

    def learn(self, times: int) -> None:
        """So many plans with slack for each."""
        for _ in range(times):
            self.setpoint(self.now_ns, self.now_ns + TICK_NS)
        self.planned_ns.clear()


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.failed.assert_not_called()


def test_a_setpoint_is_planned_at_once_where_the_slack_allows(rig: Rig) -> None:
    start_ns = rig.now_ns
    rig.setpoint(start_ns + 100 * US, start_ns + TICK_NS)
    assert rig.planned_ns == [start_ns + 100 * US]


def test_one_that_comes_too_late_is_planned_right_after_the_tick_and_once(rig: Rig) -> None:
    rig.learn(400)
    start_ns = rig.now_ns
    rig.setpoint(start_ns, start_ns + 50 * US)
    assert rig.planned_ns == []
    rig.now_ns = start_ns + 150 * US
    rig.loop.after_tick(None)
    assert rig.planned_ns == [start_ns + 150 * US]
    rig.loop.after_tick(None)
    assert len(rig.planned_ns) == 1
    assert rig.loop.timing.lateness_us == pytest.approx(150.0)


def test_one_that_no_descriptor_told_of_is_found_after_the_tick(rig: Rig) -> None:
    rig.has_arrived = True
    start_ns = rig.now_ns
    rig.loop.after_tick(None)
    assert rig.planned_ns == [start_ns]


def test_without_setpoints_it_plans_when_due_and_never_chases_what_it_missed(rig: Rig) -> None:
    start_ns = rig.now_ns
    for tick in range(402):  # the ticks end at varying times
        rig.now_ns = start_ns + tick * TICK_NS + (150 + 7 * tick % 80) * US
        rig.loop.after_tick(None)
    assert len(rig.planned_ns) == 1 + 100  # with the first tick, then when due
    rig.planned_ns.clear()
    rig.now_ns += 60 * TICK_NS
    for _ in range(3):
        rig.loop.after_tick(None)
    assert len(rig.planned_ns) == 1


def test_what_the_daemon_does_before_its_first_tick_is_no_stall_of_planning(rig: Rig) -> None:
    rig.now_ns += 50 * DUE_NS
    rig.loop.after_tick(None)
    assert (rig.loop.timing.runs, rig.loop.timing.stalls, rig.loop.timing.lateness_us) == (1, 0, 0.0)


@pytest.mark.parametrize("plan_us", [60, 300])
def test_the_slack_that_is_asked_for_follows_what_plans_take(rig: Rig, plan_us: int) -> None:
    rig.plan_ns = plan_us * US
    rig.learn(400)
    rig.setpoint(rig.now_ns, rig.now_ns + round(0.98 * plan_us * US))
    assert rig.planned_ns == []
    rig.setpoint(rig.now_ns, rig.now_ns + round(1.12 * plan_us * US))
    assert len(rig.planned_ns) == 1


def test_plans_that_vary_make_the_tick_wait_by_little(rig: Rig) -> None:
    varied = random.Random(1)
    at_once, late_us = [], []
    for _ in range(4_000):
        rig.planned_ns.clear()
        rig.plan_ns = round(varied.gauss(100.0, 20.0)) * US
        tick_ns = rig.now_ns + round(varied.uniform(0.0, 1_000.0)) * US
        rig.setpoint(rig.now_ns, tick_ns)
        at_once.append(len(rig.planned_ns))
        late_us.append(max(rig.now_ns - tick_ns, 0) / US)
        rig.loop.after_tick(None)
    assert 0.88 < np.mean(at_once) < 0.92
    assert np.quantile(late_us, 0.99) < 20.0


def test_one_interrupted_plan_does_not_keep_the_slack_from_the_next(rig: Rig) -> None:
    rig.learn(400)
    rig.plan_ns = 20_000 * US
    rig.setpoint(rig.now_ns, rig.now_ns + TICK_NS)
    rig.plan_ns = 60 * US
    rig.planned_ns.clear()
    rig.setpoint(rig.now_ns, rig.now_ns + 75 * US)
    assert len(rig.planned_ns) == 1


def test_what_the_next_plans_need_is_prepared_after_a_tick_and_not_while_a_setpoint_waits(rig: Rig) -> None:
    start_ns = rig.now_ns
    rig.setpoint(start_ns + 900 * US, start_ns + TICK_NS)
    assert rig.foreseen_ns == []
    rig.now_ns = start_ns + TICK_NS
    rig.loop.after_tick(None)
    assert rig.foreseen_ns == [rig.now_ns]


@pytest.mark.parametrize("error", [DomainError("displacement_mm", 1e10, "less"), ZeroDivisionError(), RuntimeError()])
def test_a_setpoint_that_cannot_be_planned_for_is_withdrawn_and_planning_goes_on(error: Exception) -> None:
    """The one that makes planning fail would make it fail again and again."""
    planner = Mock(**{"plan.side_effect": [error, None], "foresee.return_value": None})
    rig = Rig(planner)
    inbox, loop = rig.inbox, rig.loop
    rejected = inbox.newest = TimedSetpoint(1.0, 0.0, 0.1)
    rig.has_arrived = True
    loop.after_tick(None)
    assert (rig.failed.call_count, inbox.newest, inbox.refused) == (1, None, 1)
    assert "no gap could be planned" in str(inbox.last_refusal)
    rig.has_arrived = True
    loop.after_tick(None)
    assert (rig.failed.call_count, inbox.refused) == (1, 1)
    assert [name for name, *_ in planner.mock_calls] == ["plan", "afresh", "foresee", "plan", "foresee"]
    assert [call.args[1] for call in planner.plan.call_args_list] == [rejected, None]
    # and it is written down in that order: what a replay has to do
    first_s = rig.now_ns * 1e-9
    assert rig.journal.take() == [("plan", first_s, rejected), ("afresh", first_s), ("plan", first_s, None)]
