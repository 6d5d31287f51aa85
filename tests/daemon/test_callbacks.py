"""Who is to blame for a late tick, on a clock that the test moves."""

from collections.abc import Callable
from itertools import count

import pytest

from tormagd.daemon.callbacks import KERNEL, NEWS_NS, Callbacks, Delay

MS = 1_000_000


class Loop:
    """An event loop whose descriptors are readable when the test says so; each callback takes its time."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.readers: dict[int, Callable[[], None]] = {}

    def clock_ns(self) -> int:
        return self.now_ns

    def add_reader(self, fd: int, callback: Callable[[], None]) -> None:
        self.readers[fd] = callback

    def remove_reader(self, fd: int) -> None:
        del self.readers[fd]

    def run_for(self, duration_ns: int) -> None:
        self.now_ns += duration_ns


@pytest.fixture
def loop() -> Loop:
    return Loop()


@pytest.fixture
def callbacks(loop: Loop) -> Callbacks:
    """Of a thread that had the processor all the time."""
    return Callbacks(loop, loop.clock_ns, count(0, 1_000 * MS).__next__)


class Slow:
    """Something with a callback."""

    def __init__(self, loop: Loop, takes_ns: int) -> None:
        self._loop, self._takes_ns = loop, takes_ns

    def receive(self) -> None:
        self._loop.run_for(self._takes_ns)


def test_the_callback_that_ran_into_the_tick_is_named(loop: Loop, callbacks: Callbacks) -> None:
    callbacks.add_reader(1, Slow(loop, 3 * MS).receive)
    loop.run_for(9 * MS)
    loop.readers[1]()
    # due at 10 ms, begun when the callback ended at 12 ms
    callbacks.ran("tick", 12 * MS, 12 * MS + 1)
    assert callbacks.blame(10 * MS, 12 * MS + 1) == Delay(2 * MS + 1, "Slow.receive", 2 * MS)
    assert callbacks.blamed == {"Slow.receive": 1}


RUNS: dict[str, tuple[list[tuple[str, int, int]], int, Delay]] = {
    "what a callback took before the tick was due does not count": (
        [("long, but before", 0, 9), ("short", 10, 11), ("tick", 11, 13)],
        13,
        Delay(3 * MS, "tick", 2 * MS),
    ),
    "many short runs of one callback add up": (
        [("often", start, start + 1) for start in range(10, 18, 2)] + [("once", 18, 21)],
        21,
        Delay(11 * MS, "often", 4 * MS),
    ),
    "where nothing of ours ran it was the kernel": ([("tick", 14, 15)], 15, Delay(5 * MS, KERNEL, 4 * MS)),
}


@pytest.mark.parametrize(("runs", "done", "delay"), RUNS.values(), ids=RUNS)
def test_who_is_to_blame_for_a_tick_that_was_due_at_10_ms(
    callbacks: Callbacks, runs: list[tuple[str, int, int]], done: int, delay: Delay
) -> None:
    for name, begun, ended in runs:
        callbacks.ran(name, begun * MS, ended * MS)
    assert callbacks.blame(10 * MS, done * MS) == delay


def test_a_callback_in_whose_midst_the_thread_was_stopped_is_not_to_blame(loop: Loop) -> None:
    ran_ns = [0]
    callbacks = Callbacks(loop, loop.clock_ns, lambda: ran_ns[0])
    callbacks.ran("tick", 9 * MS, 50 * MS)
    ran_ns[0] = 3 * MS
    assert callbacks.blame(10 * MS, 50 * MS) == Delay(40 * MS, KERNEL, 37 * MS)
    callbacks.ran("tick", 50 * MS, 60 * MS)
    ran_ns[0] += 9 * MS
    assert callbacks.blame(50 * MS, 60 * MS) == Delay(10 * MS, "tick", 10 * MS)


def test_a_tick_in_time_leaves_nothing_to_the_next_and_no_news(loop: Loop, callbacks: Callbacks) -> None:
    callbacks.ran("earlier", 0, 20 * MS)
    callbacks.forget()
    assert callbacks.news() is None
    callbacks.ran("tick", 19 * MS, 20 * MS)
    assert callbacks.blame(10 * MS, 20 * MS).culprit == KERNEL
    # and a late one leaves nothing to the one after it
    assert callbacks.blame(10 * MS, 20 * MS) == Delay(10 * MS, KERNEL, 10 * MS)


def test_one_log_line_in_a_while_with_the_worst_of_all(loop: Loop, callbacks: Callbacks) -> None:
    callbacks.ran("tick", 0, 2 * MS)
    callbacks.blame(0, 2 * MS)
    first = callbacks.news()
    assert str(first) == (
        "control ticks that were late: 1, the worst done 2.0 ms after it was due; 2.0 ms of that went to tick"
    )
    assert callbacks.news() is None
    for took in (3, 7, 5):
        callbacks.ran(f"reader {took}", 0, took * MS)
        callbacks.blame(0, took * MS)
    loop.run_for(NEWS_NS - 1)
    assert callbacks.news() is None
    loop.run_for(1)
    second = callbacks.news()
    assert (second.ticks, second.worst) == (3, Delay(7 * MS, "reader 7", 7 * MS))
    loop.run_for(NEWS_NS)
    assert callbacks.news() is None
    assert callbacks.blamed.total() == 4


def test_a_descriptor_that_is_no_longer_watched_is_taken_from_the_loop(loop: Loop, callbacks: Callbacks) -> None:
    callbacks.add_reader(5, Slow(loop, 1).receive)
    callbacks.remove_reader(5)
    assert loop.readers == {}
