from collections.abc import Iterator
from unittest.mock import Mock

import pytest
from failing_search import FailingSearch

from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.beat import Beat
from tormagd.daemon.inbox import SetpointInbox, Taken
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.element.physics.errors import DomainError
from tormagd.record.journal import AFRESH, PLAN, Journal

US = 1_000
TICK_NS = 1_000 * US
DUE_NS = 4 * TICK_NS


class Rig:
    def __init__(self, core: Core, period_ns: int = DUE_NS) -> None:
        self.due_ns = 1_000 * TICK_NS
        self.search = FailingSearch(core)
        self.failed, self.inbox, self.journal = Mock(), SetpointInbox(), Journal()
        self.loop = InferenceLoop(
            self.search.core.planner(),
            self.inbox,
            period_ns,
            journal=self.journal,
            on_failure=self.failed,
            clock_ns=self.clock_ns,
        )

    def clock_ns(self) -> int:
        return self.due_ns + 50 * US

    def planned_ns(self) -> list[int]:
        return [
            round(entry[1] * 1e9) - 50 * US
            for entry in self.journal.take()
            if isinstance(entry, tuple) and entry[0] == PLAN
        ]

    def beat(self, beats: int = 1, *, is_asked: bool = False) -> None:
        self.due_ns += beats * TICK_NS
        self.loop.plan(Beat(self.due_ns, self.due_ns, beats - 1), None, is_asked=is_asked, is_followed=True)


@pytest.fixture
def rig(core: Core) -> Iterator[Rig]:
    made = Rig(core)
    yield made
    made.failed.assert_not_called()


def test_a_setpoint_is_planned_in_its_beat_and_the_next_plan_is_due_a_period_later(rig: Rig) -> None:
    rig.beat(is_asked=True)
    asked_ns = rig.due_ns
    rig.beat()
    rig.beat(is_asked=True)
    for _ in range(5):
        rig.beat()
    rig.beat(7)  # the next was due a period before
    rig.beat()
    assert [(each_ns - asked_ns) // TICK_NS for each_ns in rig.planned_ns()] == [0, 2, 6, 14]
    assert rig.loop.timing.lateness_us == pytest.approx(50.0)


@pytest.mark.parametrize(("period_ns", "plans"), [(TICK_NS, 401), (DUE_NS, 101), (round(1e9 / 83.0), 34)])
def test_without_setpoints_it_plans_when_due_and_never_chases_what_it_missed(
    core: Core, period_ns: int, plans: int
) -> None:
    rig = Rig(core, period_ns)
    for _ in range(401):
        rig.beat()
    assert len(rig.planned_ns()) == plans
    rig.beat(60)
    assert len(rig.planned_ns()) == 1
    rig.beat()
    assert len(rig.planned_ns()) == (1 if period_ns == TICK_NS else 0)


@pytest.mark.parametrize("error", [DomainError("displacement_mm", 1e10, "less"), ZeroDivisionError(), RuntimeError()])
def test_a_setpoint_that_cannot_be_planned_for_is_withdrawn_and_planning_goes_on(core: Core, error: Exception) -> None:
    rig = Rig(core)
    inbox, rejected = rig.inbox, TimedSetpoint(1.0, 0.0, 0.1)
    inbox.in_force = Taken(rejected, "a", 1, 0.0)
    rig.search.error = error
    rig.beat(is_asked=True)
    assert (rig.failed.call_count, inbox.newest, inbox.refused) == (1, None, 1)
    assert "no gap could be planned" in str(inbox.last_refusal)
    first_s, rig.search.error = rig.clock_ns() * 1e-9, None
    rig.beat(is_asked=True)
    assert (rig.failed.call_count, inbox.refused) == (1, 1)
    # the planner began anew in between, and the journal has that order
    assert rig.loop.planner.planned.number > 1
    second_s = rig.clock_ns() * 1e-9
    assert rig.journal.take() == [(PLAN, first_s, rejected), (AFRESH, first_s), (PLAN, second_s, None)]
