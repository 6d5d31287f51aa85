"""What the host takes, as bare timers and the kernel see it; made-up stalls, and one that is real."""

import os
import time
from pathlib import Path

import pytest
from machines import host
from machines.host import Stall


def test_a_stall_costs_the_beats_that_were_due_in_it():
    at_the_ends = [Stall(9.0, 10.5), Stall(19.9, 30.0), Stall(40.0, 50.0)]
    found = [host.kept(stalls, 10.0, 20.0) for stalls in ([], [Stall(11.0, 11.0505)], at_the_ends, [Stall(0.0, 99.0)])]
    assert found == pytest.approx([1.0, 1.0 - 50 / 10_000, 0.94, 0.0])


@pytest.mark.parametrize(
    ("changes", "took_much"),
    [
        ({}, False),
        ({"bare_worst_ms": 9.9}, False),
        ({"bare_worst_ms": 10.0}, True),
        ({"bare_kept": 0.98}, True),
        ({"waited": {"daemon": 0.02, "simulated device": 0.2}}, True),
        ({"waited_worst_ms": 24.0}, False),
        ({"waited_worst_ms": 60.0}, True),
        ({"steal": 0.5}, False),  # what was stolen while nobody wanted it did no harm
    ],
)
def test_what_was_taken_is_judged_by_what_a_program_would_have_missed(changes, took_much):
    assert host.Host(steal=0.0, bare_kept=1.0, bare_worst_ms=1.2, waited={})._replace(**changes).took_much is took_much


def looked(time_s: float, **waited_s: float) -> host.Counters:
    return host.Counters(time_s, stolen=0, ticks=round(100 * time_s), waited_s=waited_s, blocked_s=0.0)


@pytest.mark.parametrize(
    ("looks", "times_s", "waited", "worst_ms"),
    [
        (
            [
                looked(1.0),
                looked(1.2, device=0.010),
                looked(1.4, device=0.014),
                looked(1.6, device=0.134),  # 110 ms until 1.55: the fault is of 1.54
                looked(1.8),
            ],
            (1.1, 1.54),
            {"device": pytest.approx(0.134 / 0.6)},
            100.0,
        ),
        (
            [looked(1.0, worker=7.0), looked(1.2, worker=7.09, newer=9.0), looked(1.4, worker=7.09)],
            (1.0, 1.4),
            {},
            70.0,
        ),
    ],
    ids=["a process that faulted meanwhile", "a worker of the wire"],
)
def test_who_waited_is_told_and_much(tmp_path: Path, looks, times_s, waited, worst_ms) -> None:
    with (tmp_path / "log").open("w") as log, host.HostWatch(0, log) as watched:
        watched.wait_for("device", os.getpid())
        watched.end()
        watched._looks = looks
        found = watched.between(*times_s)
    assert (found.waited, found.waited_worst_ms) == (waited, pytest.approx(worst_ms))
    assert found.took_much
    assert ("device waited" in str(found)) is bool(waited)


def test_a_timer_on_every_processor_and_a_process_that_waits(tmp_path: Path):
    with (tmp_path / "log").open("w") as log, host.HostWatch(0, log) as watched:
        watched.wait_for("test", os.getpid())
        start_s = time.monotonic()
        while time.monotonic() < start_s + 1.5:
            pass
        watched.end()
        found = watched.between(start_s, time.monotonic())
        watched.end()
    assert 0.0 <= found.steal <= 1.0
    assert 0.0 <= found.bare_kept <= 1.0
    assert (set(found.waited), (tmp_path / "log").read_text(), len(watched._stalls)) == (
        {"test"},
        "",
        min(len(os.sched_getaffinity(0)), host.MAX_TIMERS),
    )
