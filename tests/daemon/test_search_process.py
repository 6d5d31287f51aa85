import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from tormagd.config import Config, Rates
from tormagd.control.aim.aim import OLDEST_ANSWER_S
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.search_process import SearchProcess
from tormagd.element.inverse.solution import Answer, Question
from tormagd.element.physics.errors import DomainError
from tormagd.simulation.closed_loop import SEARCH_S, ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd_client.endpoints import ConfigError

SHIPPED = Path(__file__).parents[2] / "examples" / "scenes" / "thesis.toml"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Core:
    """A tenth of the thesis's fields: each takes a pass of torch."""
    scene = tmp_path_factory.mktemp("scenes") / "thesis.toml"
    scene.write_text(SHIPPED.read_text(encoding="utf-8").replace("step_mT = 1.0", "step_mT = 10.0"), encoding="utf-8")
    return build_core(Config(rates=Rates(inference_hz=250), scene=str(scene)))


@pytest.fixture(scope="module")
def process(core: Core) -> Iterator[SearchProcess]:
    made = SearchProcess(core)
    yield made
    made.close()


def setpoint(force_N: float, now_s: float) -> TimedSetpoint:
    return TimedSetpoint(force_N, now_s, 10.0)


def test_a_plan_uses_the_newest_answer_asks_anew_and_says_how_old_it_is(core: Core) -> None:
    planner = core.planner(1.0)
    first = planner.plan(1.01, setpoint(1.5, 1.01), None)
    assert first.gap_mm >= core.portrait.gap_mm_at(first.governed_N)  # nothing has been found yet
    for step in range(1, 100):
        question = planner.aim.question
        assert question is not None
        planner.aim.answer = planner.aim.answer_to(question)
        plan = planner.plan(1.01 + 0.02 * step, setpoint(1.5, 1.01), None)
        assert plan.search_age_s == pytest.approx(0.02)
        assert planner.aim.question != question
    assert plan.governed_N == pytest.approx(1.5)
    assert plan.gap_mm == pytest.approx(core.portrait.gap_mm_at(1.5), abs=2.0)  # of another handle


def test_without_an_answer_for_long_planning_fails_and_begins_anew(core: Core) -> None:
    planner, late_s = core.planner(0.0), OLDEST_ANSWER_S + 0.01
    planner.plan(OLDEST_ANSWER_S, setpoint(1.5, 0.1), None)
    with pytest.raises(DomainError, match=r"solver = no answer for 0\.51 s.*0\.5 s"):
        planner.plan(late_s, setpoint(1.5, 0.1), None)
    planner.afresh(late_s)
    assert planner.plan(late_s + 0.01, None, None).gap_mm > 0.99 * core.scene.insert.gap_open_mm


def test_in_virtual_time_an_answer_comes_a_fixed_time_after_its_question(core: Core) -> None:
    loop = ClosedLoop(
        core.config, core.stepper(), core.planner(), VirtualDevice(load_plant("sample_1"), SteadyHand(), [], 1)
    )
    loop.arm()
    start_s = loop.now_s
    held = list(loop.run(3.0, lambda now_s: setpoint(1.2, start_s)))[-100:]
    period_s = 1.0 / core.config.rates.inference_hz
    assert all(SEARCH_S - 1e-9 <= sample.plan.search_age_s <= SEARCH_S + 3.0 * period_s for sample in held)
    assert held[-1].truth.force_N == pytest.approx(1.2, abs=0.1)


def test_the_process_answers_what_the_search_would_and_one_question_at_a_time(
    core: Core, process: SearchProcess
) -> None:
    question = Question(7.0, 2.0, 42.0, 1.5, 300.0)
    process.ask(question)
    process.ask(Question(8.0, 2.0, 42.0, 3.0, 300.0))
    assert answered(process) == core.planner().aim.answer_to(question)
    assert process.timing.runs == 1
    assert process.answer() is None
    # it reports what it cannot search for, and goes on
    process.ask(Question(9.0, 2.0, 42.0, float("nan"), 300.0))
    assert answered(process, until=2) is None
    process.ask(question)
    assert answered(process) is not None


def answered(process: SearchProcess, until: int = -1) -> Answer | None:
    until_s = time.monotonic() + PATIENCE_S
    while (answer := process.answer()) is None and process.timing.runs != until:
        assert time.monotonic() < until_s
        time.sleep(0.001)
    return answer


def test_a_search_that_is_gone_is_replaced_and_one_that_cannot_start_is_refused(
    core: Core, process: SearchProcess, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    elsewhere = msgspec.structs.replace(core.scene.insert, model="none.safetensors")
    with pytest.raises(ConfigError, match=r"solver\.name = 'thesis': its process did not start"):
        SearchProcess(core._replace(models=tmp_path, scene=msgspec.structs.replace(core.scene, insert=elsewhere)))
    process._beside.process.kill()
    process._beside.process.wait()
    question = Question(7.0, 2.0, 42.0, 1.5, 300.0)
    until_s = time.monotonic() + PATIENCE_S
    while (answer := process.answer()) is None and time.monotonic() < until_s:
        process.ask(question)
        time.sleep(0.001)
    assert answer == core.planner().aim.answer_to(question)
    assert caplog.messages == ["the search beside the plans has ended; another one starts"]
