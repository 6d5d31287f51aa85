import contextlib
import os
import select
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec.structs import astuple

from tormagd.daemon.beat import COUNTED, KERNEL, NEWS_NS, Beat, Delay, Phases
from tormagd.daemon.rate_group import ERROR_PERIODS, HORIZON_NS, SHARES, Histogram, RateGroup
from tormagd.daemon.realtime import Heartbeat

MS = 1_000_000


class Rig:
    """Each phase and slice takes as many ms as the test says, and drives judge the delay."""

    def __init__(self) -> None:
        self.now_ns = self.stopped_ns = 0
        self.took: dict[str, int] = {}
        self.waiting: dict[str, int] = {"first": 0, "second": 0}
        self.ran: list[str] = []
        self.delays: list[Delay] = []
        self.errors: dict[str, Exception] = {}
        self.phases = Phases(6 * MS, lambda: self.now_ns, lambda: self.now_ns - self.stopped_ns)
        self.phases.begin(
            [(name, partial(self.phase, name)) for name in ("read", "drive")],
            [(name, partial(self.slice, name)) for name in self.waiting],
        )

    def phase(self, name: str, beat: Beat) -> None:
        self.ran.append(name)
        self.now_ns += self.took.get(name, 0) * MS
        if name in self.errors:
            raise self.errors[name]
        if name == "drive" and self.now_ns - beat.due_ns > MS:
            self.delays.append(self.phases.blame(beat.due_ns))
        elif name == "drive":
            self.phases.on_time()

    def slice(self, name: str, beat: Beat) -> bool:
        is_waiting = self.waiting[name] > 0
        if is_waiting:
            self.waiting[name] -= 1
            self.phase(name, beat)
        return is_waiting

    def beat(self, due_ms: int, **took: int) -> list[str]:
        self.ran.clear()
        self.took = took
        self.now_ns = max(self.now_ns, due_ms * MS)
        self.phases.run(due_ms * MS, 0)
        return self.ran


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_all_phases_run_in_their_order_and_then_one_slice_in_turn(rig: Rig) -> None:
    rig.waiting |= {"first": 10, "second": 13}
    in_turn = [list(rig.beat(due_ms)) for due_ms in range(25)]
    assert all(ran[:2] == ["read", "drive"] for ran in in_turn)
    assert [len(ran) for ran in in_turn] == [3] * 23 + [2] * 2
    assert sorted(ran[2] for ran in in_turn[:20]) == ["first"] * 10 + ["second"] * 10


def test_an_error_ends_its_phase_alone_and_is_told_once(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    rig.errors["read"] = TypeError("a bug")
    assert rig.beat(0) == rig.beat(1) == ["read", "drive"]
    assert [record.getMessage() for record in caplog.records] == [
        "the beat goes on without 'read', which failed: report the trace"
    ]


@pytest.mark.parametrize(
    ("before", "late", "delay"),
    [
        ({}, {"read": 3}, Delay(3 * MS, "read", 3 * MS)),
        ({}, {"drive": 3}, Delay(3 * MS, "drive", 3 * MS)),
        # what a slice took before the beat was due does not count
        ({"second": 12}, {"read": 1}, Delay(4 * MS, "second", 3 * MS)),
    ],
)
def test_whatever_filled_most_of_the_delay_is_named(
    rig: Rig, before: dict[str, int], late: dict[str, int], delay: Delay
) -> None:
    rig.waiting |= dict.fromkeys(rig.waiting, len(before))
    rig.beat(1, **before)
    rig.waiting |= dict.fromkeys(rig.waiting, 0)
    rig.beat(10, **late)
    assert rig.delays == [delay]
    assert rig.phases.blamed == {delay.culprit: 1}


def test_where_the_thread_was_stopped_it_was_the_kernel_also_in_the_midst_of_a_phase(rig: Rig) -> None:
    rig.beat(0)
    rig.now_ns = rig.stopped_ns = 15 * MS
    rig.beat(10)
    rig.stopped_ns += 32 * MS  # 5 of them before the beat is due
    rig.beat(20, read=40)
    rig.beat(61, drive=10)
    assert rig.delays == [
        Delay(5 * MS, KERNEL, 5 * MS),
        Delay(40 * MS, KERNEL, 27 * MS),
        Delay(10 * MS, "drive", 10 * MS),
    ]


def test_one_log_line_in_a_while_with_the_worst_of_all(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    def told() -> list[tuple[str, str]]:
        caplog.clear()
        rig.phases.tell()
        return [(record.levelname, record.getMessage()) for record in caplog.records]

    def line(beats: int, took: int) -> str:
        return (
            f"control ticks that were late: {beats}, the worst done {took}.0 ms after it was due; "
            f"{took}.0 ms of that went to read"
        )

    assert told() == []
    rig.beat(0, read=2)
    assert told() == [("WARNING", line(1, 2))]
    for due_ms, took in ((10, 3), (20, 7), (30, 5)):
        rig.beat(due_ms, read=took)
    assert told() == []
    rig.now_ns = 2 * MS + NEWS_NS
    assert told() == [("ERROR", line(3, 7))]
    rig.now_ns += NEWS_NS
    assert told() == []
    assert rig.phases.blamed.total() == 4


def test_the_times_of_the_parts_are_reported(rig: Rig) -> None:
    for due_ms in range(10 * COUNTED):
        rig.beat(10 * due_ms, read=2)
    assert {name: spent.report().max for name, spent in rig.phases.spent.items()} == {
        "read": 2_000.0,
        "drive": 0.0,
        "first": 0.0,
        "second": 0.0,
    }


# -- the heartbeat -----------------------------------------------------------------------------------------------------


PERIOD_NS = 20_000_000
PATIENCE_S = 10.0


@pytest.fixture
def heartbeat() -> Iterator[Heartbeat]:
    with contextlib.closing(Heartbeat(PERIOD_NS)) as made:
        yield made


def test_nothing_is_due_before_the_first_period_and_closing_gives_the_descriptor_back() -> None:
    with contextlib.closing(Heartbeat(3_600_000_000_000)) as slow:
        descriptor, due_ns = slow.fileno(), slow.due_ns
        assert (slow.beats(), slow.due_ns, select.select([slow.fileno()], [], [], 0.0)[0]) == (0, due_ns, [])
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)


def test_every_beat_is_due_one_period_after_the_last_and_missed_ones_are_merged(heartbeat: Heartbeat) -> None:
    due_ns = heartbeat.due_ns
    for missed in (0, 0, 5):
        time.sleep(missed * PERIOD_NS * 1e-9)
        assert select.select([heartbeat.fileno()], [], [], PATIENCE_S)[0]
        beats = heartbeat.beats()
        due_ns += beats * PERIOD_NS
        # a beat is never early
        assert (beats >= max(missed, 1), heartbeat.due_ns) == (True, due_ns)
        assert due_ns <= time.monotonic_ns()


# -- rate groups ------------------------------------------------------------------------------


TICK_NS = MS


def recorded(lateness_us: list[float]) -> RateGroup:
    group = RateGroup("test", TICK_NS)
    for number, late in enumerate(lateness_us):
        due = number * TICK_NS
        start = due + round(late * 1e3)
        group.record(due, start, start + 10_000)
    return group


@pytest.fixture
def group() -> RateGroup:
    return RateGroup("test", TICK_NS)


def test_before_the_first_run_everything_is_zero_and_good(group: RateGroup) -> None:
    report = group.report()
    assert (report.hz, report.runs, report.merged, report.overruns, report.grade) == (0.0, 0, 0, 0, "good")
    assert set(astuple(report.lateness_us)) == set(astuple(report.exec_us)) == {0.0}


@given(values=st.lists(st.floats(0.0, 1e5), min_size=1, max_size=300))
def test_percentiles_are_exact_to_the_width_of_their_bin(values: list[float]) -> None:
    histogram = Histogram()
    for value in values:
        histogram.add(0.0, value)
    found = histogram.report()
    assert found.max == pytest.approx(max(values), abs=0.05 + 1e-9)  # half a tenth rounds either way
    for name, share in zip(("p50", "p99", "p999"), SHARES, strict=True):
        exact = float(np.quantile(values, share, method="inverted_cdf"))
        assert exact - 0.05 <= getattr(found, name) <= exact * (1.0 + 1.0 / 32.0) + 1.0


def test_what_is_beyond_the_last_bin_is_still_the_largest() -> None:
    histogram = Histogram()
    histogram.add(0.0, 1e12)
    assert histogram.report().max == 1e12


def test_the_horizon_forgets_and_the_worst_does_not() -> None:
    count = round(2.2 * HORIZON_NS / TICK_NS)
    report = recorded([900.0] + [5.0] * count).report()
    assert (report.runs, report.hz, report.lateness_us.worst, report.lateness_us.max) == (
        count + 1,
        pytest.approx(1_000.0, rel=1e-3),
        900.0,
        5.0,
    )
    assert recorded([900.0] + [5.0] * round(0.9 * HORIZON_NS / TICK_NS)).report().lateness_us.max == 900.0


def test_the_rate_is_that_of_the_horizon(group: RateGroup) -> None:
    for due in (*range(0, HORIZON_NS, TICK_NS), *range(HORIZON_NS, 5 * HORIZON_NS, 4 * TICK_NS)):
        group.record(due, due, due)
    assert group.report().hz == pytest.approx(250.0, rel=1e-2)


def test_merged_runs_and_overruns_are_counted(group: RateGroup) -> None:
    group.record(0, 100, TICK_NS)
    assert group.overruns == 0
    group.record(TICK_NS, TICK_NS, 2 * TICK_NS + 1)
    # late is as bad as slow: the next one is due
    group.record(2 * TICK_NS, 3 * TICK_NS, 3 * TICK_NS + 1, merged=3)
    # the delay counts from the first run that was missed
    assert (group.delay_ns, group.lateness_us) == (4 * TICK_NS + 1, pytest.approx(1e3))
    group.record(6 * TICK_NS, 6 * TICK_NS, 6 * TICK_NS + 1)
    assert (group.runs, group.merged, group.overruns, group.stalls) == (4, 3, 2, 0)


def test_a_stall_is_an_error_and_an_overrun_a_warning_for_as_long_as_the_horizon(group: RateGroup) -> None:
    stall_ns = round(ERROR_PERIODS * TICK_NS) + 1
    for due_ns, took_ns, grade in (
        (0, TICK_NS, "good"),
        (TICK_NS, TICK_NS + 1, "warning"),
        (2 * TICK_NS, stall_ns - 1, "warning"),
        (3 * TICK_NS, stall_ns, "error"),
        (4 * TICK_NS, 0, "error"),
        # forgotten after one to two horizons, while the counters stay
        (HORIZON_NS + TICK_NS, 0, "error"),
        (2 * HORIZON_NS + 2 * TICK_NS, 0, "good"),
    ):
        group.record(due_ns, due_ns, due_ns + took_ns)
        assert group.report().grade == grade, due_ns
    assert (group.overruns, group.stalls) == (3, 1)
