"""Tests wait for the heartbeat's descriptor, never for a time."""

import contextlib
import os
import select
import time
from collections.abc import Iterator

import pytest

from tormagd.daemon.heartbeat import Heartbeat

PERIOD_NS = 20_000_000
PATIENCE_S = 10.0


@pytest.fixture
def heartbeat() -> Iterator[Heartbeat]:
    with contextlib.closing(Heartbeat(PERIOD_NS)) as made:
        yield made


def wait(heartbeat: Heartbeat) -> None:
    assert select.select([heartbeat.fileno()], [], [], PATIENCE_S)[0]


def test_nothing_is_due_before_the_first_period() -> None:
    with contextlib.closing(Heartbeat(3_600_000_000_000)) as slow:
        due_ns = slow.due_ns
        assert (slow.beats(), slow.due_ns, select.select([slow.fileno()], [], [], 0.0)[0]) == (0, due_ns, [])


def test_every_beat_is_due_one_period_after_the_last(heartbeat: Heartbeat) -> None:
    before_ns = heartbeat.due_ns
    for _ in range(3):
        wait(heartbeat)
        due_ns = heartbeat.due_ns + PERIOD_NS * heartbeat.beats()
        # a beat is never early
        assert before_ns < due_ns == heartbeat.due_ns <= time.monotonic_ns()
        before_ns = due_ns


def test_missed_beats_are_merged_and_counted(heartbeat: Heartbeat) -> None:
    before_ns = heartbeat.due_ns
    with contextlib.closing(Heartbeat(5 * PERIOD_NS)) as other:
        wait(other)
    wait(heartbeat)
    beats = heartbeat.beats()
    assert beats >= 5
    assert heartbeat.due_ns == before_ns + beats * PERIOD_NS


def test_closing_gives_the_descriptor_back() -> None:
    made = Heartbeat(PERIOD_NS)
    descriptor = made.fileno()
    made.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
