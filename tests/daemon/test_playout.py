"""The playout buffer: every setpoint is followed a stated time after its stamp, without jitter."""

import random
from collections.abc import Callable

import msgpack
import pytest
from hypothesis import given, strategies as st

from tormagd.config import Sources
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Limit
from tormagd.daemon.inbox import SetpointInbox

START_NS = 1_800_000_000_000_000_000
TICK_S = 1e-3
PERIOD_S = 0.01


class Listening:
    """What is in force in each tick: (now_s, stamp_s, force_N)."""

    def __init__(self, playout_ms: float, valid_for_ms: float = 500.0) -> None:
        self.inbox, self.valid_for_ms = SetpointInbox(Sources(playout_ms=playout_ms)), valid_for_ms
        self.followed: list[tuple[float, float, float]] = []

    def take(self, now_s: float, seq: int, sent_s: float, source: str = "a") -> bool:
        message = {"v": 1, "source": source, "seq": seq, "stamp_ns": START_NS + round(sent_s * 1e9)}
        fields = message | {"servo_cf": 1.0 + 1e-3 * seq, "valid_for_ms": self.valid_for_ms}
        return self.inbox.take(msgpack.packb(fields), now_s, START_NS + round(now_s * 1e9))

    def listen(self, delay_s: Callable[[int], float], lasts_s: float) -> None:
        arrives_s, coming = 0.0, []
        for seq in range(round(lasts_s / PERIOD_S)):
            arrives_s = max(arrives_s, seq * PERIOD_S + delay_s(seq))
            coming.append((arrives_s, seq))
        for tick in range(round(lasts_s / TICK_S)):
            now_s, before = tick * TICK_S, self.inbox.newest
            while coming and coming[0][0] <= now_s:
                _, seq = coming.pop(0)
                self.take(now_s, seq, seq * PERIOD_S)
            self.inbox.hand_on(now_s)
            newest = self.inbox.newest
            if newest is not None and newest is not before:
                self.followed.append((now_s, self.inbox.in_force.stamp_s, newest.force_N))


@given(seed=st.integers(0, 2**32), playout_ms=st.sampled_from([5.0, 60.0, 200.0]))
def test_each_setpoint_is_followed_a_stated_time_after_its_stamp(seed: int, playout_ms: float) -> None:
    noise, listening = random.Random(seed), Listening(playout_ms)
    listening.listen(lambda seq: noise.uniform(0.0, playout_ms * 1e-3 - TICK_S), 1.0)
    found = [(now_s - stamp_s, round((force_N - 1.0) * 1e3)) for now_s, stamp_s, force_N in listening.followed]
    assert [seq for _, seq in found] == list(range(len(found)))
    assert len(found) >= (1.0 - playout_ms * 1e-3) / PERIOD_S - 1.0
    assert all(-1e-9 <= late_s - playout_ms * 1e-3 < TICK_S + 1e-9 for late_s, _ in found)
    report = listening.inbox.report(1.0).playout
    assert (report.playout_ms, report.setpoints, report.late) == (playout_ms, listening.inbox.accepted, 0)


def test_what_is_held_back_is_for_the_planner_as_if_it_had_been_meant_that_much_later() -> None:
    held, at_once = Listening(60.0), Listening(0.0)
    assert not held.take(5.0, 1, 4.99)
    assert at_once.take(5.0, 1, 4.99)
    assert held.inbox.hand_on(5.0501)
    meant, played = at_once.inbox.newest, held.inbox.newest
    assert (played.stamp_s, played.valid_for_s) == pytest.approx((meant.stamp_s + 0.06, meant.valid_for_s - 0.06))
    assert meant.replaced(stamp_s=played.stamp_s, valid_for_s=played.valid_for_s) == played
    assert held.inbox.in_force.stamp_s == meant.stamp_s


def test_what_comes_too_late_is_followed_at_once_and_counted() -> None:
    listening = Listening(30.0)
    listening.listen(lambda seq: 0.0805 if seq % 20 == 10 else 0.01 + 0.004 * (seq % 2), 4.0)
    listening.inbox.refresh(4.0)
    report = listening.inbox.report(4.0).playout
    # the late one delays those behind it: 81, 71, .. 31 ms after their stamps
    assert (report.setpoints, report.late, report.held_us.p50, report.jitter_us) == (
        399,
        20 * 6,
        pytest.approx(16e3, rel=0.05),
        pytest.approx(4e3, rel=0.5),
    )
    # of a burst only the newest is followed
    late_s = [now_s - stamp_s for now_s, stamp_s, _ in listening.followed]
    assert (min(late_s), max(late_s)) == pytest.approx((0.03, 0.031), abs=1.1 * TICK_S)


def test_a_setpoint_that_is_not_valid_for_so_long_is_stale_and_says_why() -> None:
    listening = Listening(60.0, valid_for_ms=50.0)
    listening.listen(lambda seq: 0.01, 1.0)
    why = listening.inbox.told(1.0)[Limit.STALE]
    assert "followed from 60 ms after their stamp on, and are valid for 50 ms" in why.cause
    assert "lower sources.playout_ms" in why.remedy


def test_jitter_names_the_playout_that_takes_it_out_and_is_gone_with_it() -> None:
    def way_s(seq: int) -> float:
        return 0.02 + 0.028 * (seq % 10 == 0)

    listening = Listening(0.0)
    listening.listen(way_s, 2.5)
    assert listening.inbox.told(2.5)[Limit.SOURCE_JITTER].remedy.startswith("set sources.playout_ms = 50,")
    listening = Listening(50.0)
    listening.listen(way_s, 2.5)
    assert listening.inbox.newest.limits == ()


def test_nothing_that_waits_outlives_a_scene_or_another_holder(core: Core) -> None:
    listening = Listening(50.0)
    inbox = listening.inbox
    assert not listening.take(0.0, 1, 0.0)
    inbox.begin_scene(core.scene)
    assert not inbox.hand_on(0.06)
    assert not listening.take(0.1, 2, 0.1)
    inbox.sources = Sources(priority=("b",), playout_ms=0.0)
    assert listening.take(0.11, 1, 0.11, "b"), "a playout that was taken away holds nothing that comes"
    assert inbox.in_force.source == "b"
    assert not inbox.hand_on(0.2)


def test_a_flood_is_held_in_bounds() -> None:
    listening = Listening(200.0)
    for seq in range(5_000):
        listening.take(seq * 1e-5, seq, seq * 1e-5)
    assert listening.inbox.hand_on(0.3)
    assert listening.inbox.in_force.seq == 4_999
