import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest
from failing_search import FailingSearch

from tormagd.config import Config, Rates
from tormagd.control.aim.aim import OLDEST_ANSWER_S
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.beat import Beat
from tormagd.daemon.inbox import SetpointInbox, Taken
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.daemon.search_process import SearchProcess
from tormagd.element.inverse.solution import Answer, Question
from tormagd.element.physics.errors import DomainError
from tormagd.record.stream import AFRESH, PLAN, Journal
from tormagd.simulation.closed_loop import SEARCH_S, ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd_client.endpoints import ConfigError

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


# -- beside the plans ---------------------------------------------------------------------------------------


SHIPPED = Path(__file__).parents[2] / "examples" / "scenes" / "thesis.toml"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def thesis(tmp_path_factory: pytest.TempPathFactory) -> Core:
    """A tenth of the thesis's fields: each takes a pass of torch."""
    scene = tmp_path_factory.mktemp("scenes") / "thesis.toml"
    scene.write_text(SHIPPED.read_text(encoding="utf-8").replace("step_mT = 1.0", "step_mT = 10.0"), encoding="utf-8")
    return build_core(Config(rates=Rates(inference_hz=250), scene=str(scene)))


@pytest.fixture(scope="module")
def process(thesis: Core) -> Iterator[SearchProcess]:
    made = SearchProcess(thesis)
    yield made
    made.close()


def setpoint(force_N: float, now_s: float) -> TimedSetpoint:
    return TimedSetpoint(force_N, now_s, 10.0)


def test_a_plan_uses_the_newest_answer_asks_anew_and_says_how_old_it_is(thesis: Core) -> None:
    planner = thesis.planner(1.0)
    first = planner.plan(1.01, setpoint(1.5, 1.01), None)
    assert first.gap_mm >= thesis.portrait.gap_mm_at(first.governed_N)  # nothing has been found yet
    for step in range(1, 100):
        question = planner.aim.question
        assert question is not None
        planner.aim.answer = planner.aim.answer_to(question)
        plan = planner.plan(1.01 + 0.02 * step, setpoint(1.5, 1.01), None)
        assert plan.search_age_s == pytest.approx(0.02)
        assert planner.aim.question != question
    assert plan.governed_N == pytest.approx(1.5)
    assert plan.gap_mm == pytest.approx(thesis.portrait.gap_mm_at(1.5), abs=2.0)  # of another handle


def test_without_an_answer_for_long_planning_fails_and_begins_anew(thesis: Core) -> None:
    planner, late_s = thesis.planner(0.0), OLDEST_ANSWER_S + 0.01
    planner.plan(OLDEST_ANSWER_S, setpoint(1.5, 0.1), None)
    with pytest.raises(DomainError, match=r"solver = no answer for 0\.51 s.*0\.5 s"):
        planner.plan(late_s, setpoint(1.5, 0.1), None)
    planner.afresh(late_s)
    assert planner.plan(late_s + 0.01, None, None).gap_mm > 0.99 * thesis.scene.insert.gap_open_mm


def test_in_virtual_time_an_answer_comes_a_fixed_time_after_its_question(thesis: Core) -> None:
    loop = ClosedLoop(
        thesis.config, thesis.stepper(), thesis.planner(), VirtualDevice(load_plant("sample_1"), SteadyHand(), [], 1)
    )
    loop.arm()
    start_s = loop.now_s
    held = list(loop.run(3.0, lambda now_s: setpoint(1.2, start_s)))[-100:]
    period_s = 1.0 / thesis.config.rates.inference_hz
    assert all(SEARCH_S - 1e-9 <= sample.plan.search_age_s <= SEARCH_S + 3.0 * period_s for sample in held)
    assert held[-1].truth.force_N == pytest.approx(1.2, abs=0.1)


def test_the_process_answers_what_the_search_would_and_one_question_at_a_time(
    thesis: Core, process: SearchProcess
) -> None:
    question = Question(7.0, 2.0, 42.0, 1.5, 300.0)
    process.ask(question)
    process.ask(Question(8.0, 2.0, 42.0, 3.0, 300.0))
    assert answered(process) == thesis.planner().aim.answer_to(question)
    assert process.timing.runs == 1
    assert process.answer() is None
    # it reports what it cannot search for, and goes on
    process.ask(Question(9.0, 2.0, 42.0, float("nan"), 300.0))
    assert answered(process, until=2) is None
    process.ask(question)
    assert answered(process) is not None


def answered(process: SearchProcess, until: int = -1, again: Question | None = None) -> Answer | None:
    until_s = time.monotonic() + PATIENCE_S
    while (answer := process.answer()) is None and process.timing.runs != until:
        assert time.monotonic() < until_s
        if again is not None:
            process.ask(again)
        time.sleep(0.001)
    return answer


def test_a_search_that_is_gone_is_replaced_and_one_that_cannot_start_is_refused(
    thesis: Core, process: SearchProcess, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    elsewhere = msgspec.structs.replace(thesis.scene.insert, model="none.safetensors")
    with pytest.raises(ConfigError, match=r"solver\.name = 'thesis': its process did not start"):
        SearchProcess(thesis._replace(models=tmp_path, scene=msgspec.structs.replace(thesis.scene, insert=elsewhere)))
    process._beside.process.kill()
    process._beside.process.wait()
    question = Question(7.0, 2.0, 42.0, 1.5, 300.0)
    assert answered(process, again=question) == thesis.planner().aim.answer_to(question)
    assert caplog.messages == ["the search beside the plans has ended; another one starts"]
