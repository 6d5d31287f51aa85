from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tormagd.lab.design.optimisation import Design, Outcome, Problem, Run
from tormagd.lab.design.sweep import read_state, sweep
from tormagd.physics.errors import DomainError


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


class Refusing(Executor):
    """Takes a number of runs, then breaks down."""

    def __init__(self, executor: Executor, takes: int) -> None:
        self.executor, self.takes = executor, takes

    def submit(self, function: Any, /, *arguments: Any, **keywords: Any) -> Future[Any]:
        if self.takes == 0:
            broken: Future[Any] = Future()
            broken.set_exception(ConnectionError("worker lost"))
            return broken
        self.takes -= 1
        future = self.executor.submit(function, *arguments, **keywords)
        future.exception()
        return future


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


def test_what_was_finished_is_kept_and_a_stopped_sweep_goes_on_there(
    runs: list[Run], thread: Executor, tmp_path: Path
) -> None:
    state = tmp_path / "sweep.json"
    with pytest.raises(ConnectionError):
        sweep([runs[0]], Refusing(thread, 0), state)
    assert read_state(state) == {}
    first = sweep(runs[:2], thread, state)
    with pytest.raises(ConnectionError, match="worker lost"):
        sweep(runs, Refusing(thread, 0), state)
    assert read_state(state) == first
    rest = sweep(runs, Refusing(thread, 1), state)
    assert (list(rest), {run: rest[run] for run in first}) == (runs, first)
    assert read_state(state) == rest


def test_another_problem_does_not_take_an_old_answer(runs: list[Run], thread: Executor, tmp_path: Path) -> None:
    state = tmp_path / "sweep.json"
    sweep(runs[:1], thread, state)
    other = msgspec.structs.replace(runs[0], problem=msgspec.structs.replace(runs[0].problem, gap_speed_mm_s=20.0))
    with pytest.raises(ConnectionError):
        sweep([other], Refusing(thread, 0), state)
    sweep([other], thread, state)
    assert set(read_state(state)) == {runs[0], other}


def test_runs_that_stand_twice_are_solved_once(runs: list[Run], thread: Executor) -> None:
    assert list(sweep([runs[0], runs[0]], Refusing(thread, 1))) == runs[:1]


@pytest.mark.parametrize(
    "text", ["", "[]", '{"version": 1}', '{"version": 2, "finished": []}', '{"version": 1, "finished": [[1, 2]]}']
)
def test_other_files_are_refused_and_left_alone(runs: list[Run], thread: Executor, tmp_path: Path, text: str) -> None:
    state = tmp_path / "sweep.json"
    state.write_text(text)
    with pytest.raises(DomainError, match=r"sweep\.json"):
        sweep(runs, thread, state)
    assert state.read_text() == text
