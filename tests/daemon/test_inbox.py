"""The setpoint inbox: whatever is published, the newest valid setpoint wins and everything else is counted."""

from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tormagd.daemon.inbox import AHEAD_S, SILENT_S, SOURCES, SetpointInbox
from tormagd.messages import VERSION, Reply, SetpointReport, decode, encode

START_NS = 1_800_000_000_000_000_000
"Some day on CLOCK_REALTIME that is second 0 of the control clock here."


class Publishing:
    """An inbox on a clock that the test moves."""

    def __init__(self) -> None:
        self.inbox = SetpointInbox()
        self.now_s = 0.0
        self.step_s = 0.0
        "By how much somebody has set the time of day forward."

    @property
    def realtime_ns(self) -> int:
        return START_NS + round((self.now_s + self.step_s) * 1e9)

    def take(self, data: bytes) -> bool:
        return self.inbox.take(data, self.now_s, self.realtime_ns)

    def send(self, seq: int, force_N: float = 1.0, source: str = "a", age_s: float = 0.0, /, **fields: Any) -> bool:
        """Publishes one setpoint, stamped `age_s` ago."""
        message = {
            "v": 1,
            "source": source,
            "seq": seq,
            "stamp_ns": self.realtime_ns - round(age_s * 1e9),
            "servo_cf": force_N,
            "valid_for_ms": 50.0,
        }
        return self.take(msgpack.packb(message | fields))

    def counters(self) -> tuple[int, int, int]:
        return self.inbox.accepted, self.inbox.refused, self.inbox.dropped

    @property
    def force_N(self) -> float | None:
        return None if self.inbox.newest is None else self.inbox.newest.force_N


@pytest.fixture
def publishing() -> Publishing:
    return Publishing()


def test_a_setpoint_is_put_on_the_control_clock(publishing: Publishing) -> None:
    publishing.now_s = 7.0
    assert publishing.send(1, 1.5, "a", 0.02, rate_mm_s=30.0)
    newest = publishing.inbox.newest
    assert newest is not None
    assert newest.stamp_s == pytest.approx(6.98)
    assert (newest.force_N, newest.valid_for_s, newest.rate_mm_s) == (1.5, 0.05, 30.0)


@pytest.mark.parametrize("seq", [5, 4, 0])
def test_an_older_or_repeated_number_is_dropped(publishing: Publishing, seq: int) -> None:
    publishing.send(5, 1.0)
    assert not publishing.send(seq, 2.0)
    assert publishing.force_N == 1.0
    assert publishing.counters() == (1, 0, 1)
    assert publishing.send(6, 2.0)


def test_a_publisher_that_was_silent_may_start_again(publishing: Publishing) -> None:
    publishing.send(1_000)
    publishing.now_s = SILENT_S - 0.01
    assert not publishing.send(0, 2.0)
    publishing.now_s = SILENT_S
    assert publishing.send(0, 2.0)
    assert publishing.force_N == 2.0


def test_dropped_messages_keep_no_publisher_alive(publishing: Publishing) -> None:
    """A publisher that restarted at 0 is heard after a second, although it never paused."""
    publishing.send(1_000)
    for tick in range(1, 200):
        publishing.now_s = tick * 0.01
        publishing.send(tick, 2.0)
    assert publishing.force_N == 2.0
    assert publishing.inbox.dropped == pytest.approx(SILENT_S / 0.01, abs=2)


def test_of_several_publishers_the_newest_stamp_wins(publishing: Publishing) -> None:
    publishing.now_s = 1.0
    assert publishing.send(1, 1.0, "a", 0.02)
    assert publishing.send(1, 2.0, "b", 0.01)
    assert not publishing.send(2, 3.0, "a", 0.015)
    assert publishing.force_N == 2.0
    assert publishing.inbox.report().newest_source == "b"
    assert publishing.send(3, 4.0, "a", 0.0)
    assert publishing.inbox.report().newest_source == "a"
    assert publishing.inbox.report().sources == {"a": 3, "b": 1}
    assert publishing.counters() == (4, 0, 0)


@pytest.mark.parametrize("step_s", [-3_600.0, -0.5, 0.5, 3_600.0])
def test_setting_the_time_of_this_machine_keeps_no_setpoint_out(publishing: Publishing, step_s: float) -> None:
    """Publisher and daemon read the same clock: the ages stay what they are, also between sources."""
    publishing.send(1, 1.0, "a", 0.01)
    publishing.send(1, 1.5, "b", 0.005)
    publishing.step_s = step_s
    for tick in range(2, 5):
        publishing.now_s += 0.002
        assert publishing.send(tick, float(tick), "a", 0.001)
        assert publishing.force_N == tick
        assert publishing.inbox.newest is not None
        assert publishing.now_s - publishing.inbox.newest.stamp_s == pytest.approx(0.001, abs=1e-6)
    assert not publishing.send(2, 9.0, "b", 0.3)
    assert publishing.force_N == 4.0


def test_a_publisher_whose_clock_is_set_back_is_heard_on_with_older_setpoints(publishing: Publishing) -> None:
    """Its seq goes on, so it is newer; by the stamp it is half a second old, and the governor lets that decay."""
    publishing.send(1, 1.0, "a", 0.0)
    publishing.now_s = 0.002
    assert publishing.send(2, 1.2, "a", 0.5)
    assert publishing.force_N == 1.2
    assert publishing.inbox.newest is not None
    assert publishing.inbox.newest.stamp_s == pytest.approx(-0.498)


def test_a_stamp_ahead_of_the_clock_is_refused(publishing: Publishing) -> None:
    assert publishing.send(1, 1.0, "a", -AHEAD_S)
    assert not publishing.send(2, 2.0, "a", -AHEAD_S - 0.001)
    assert publishing.counters() == (1, 1, 0)
    assert publishing.inbox.last_refusal is not None
    assert "51 ms ahead" in publishing.inbox.last_refusal
    # the refused one does not use up its number
    assert publishing.send(2, 3.0, "a", -AHEAD_S)


def test_a_stamp_of_long_ago_is_taken_and_is_as_old_as_it_says(publishing: Publishing) -> None:
    assert publishing.send(1, stamp_ns=0)
    newest = publishing.inbox.newest
    assert newest is not None
    assert publishing.now_s - newest.stamp_s == pytest.approx(START_NS * 1e-9)


def test_one_publisher_too_many_is_refused_until_one_is_silent(publishing: Publishing) -> None:
    for number in range(SOURCES):
        publishing.now_s = number * 0.01
        assert publishing.send(1, source=f"source {number}")
    assert not publishing.send(1, 2.0, source="one more")
    assert "one more" in str(publishing.inbox.last_refusal)
    assert publishing.send(2, source="source 3")
    # the first has been silent for long enough, the second has not
    publishing.now_s = SILENT_S + 0.005
    assert publishing.send(1, 2.0, source="one more")
    sources = publishing.inbox.report().sources
    assert len(sources) == SOURCES
    assert "source 0" not in sources
    assert "source 1" in sources


def test_a_flood_of_names_takes_no_memory(publishing: Publishing) -> None:
    for number in range(2_000):
        publishing.send(1, source=f"source {number}")
        publishing.now_s += 0.01
    assert len(publishing.inbox.report().sources) == SOURCES
    assert publishing.inbox.accepted + publishing.inbox.refused == 2_000


@pytest.mark.parametrize(
    "fields",
    [
        {"servo_cf": float("nan")},
        {"servo_cf": float("inf")},
        {"servo_cf": -1.0},
        {"servo_cf": "1"},
        {"valid_for_ms": 0.0},
        {"v": 2},
        {"source": ""},
        {"seq": -1},
        {"seq": None},
        {"stamp_ns": 1.5},
        {"rate_mm_s": float("nan")},
        {"displacement_mm": 1e10},
        {"rate_mm_s": -1e308},
        {"preview_N": [float("nan")], "preview_dt_ms": 1.0},
    ],
)
def test_a_refused_setpoint_changes_nothing_but_the_counter(publishing: Publishing, fields: dict[str, Any]) -> None:
    publishing.send(1, 1.0)
    before = publishing.inbox.newest
    assert not publishing.send(2, **fields)
    assert publishing.inbox.newest is before
    assert publishing.counters() == (1, 1, 0)
    assert str(next(iter(fields))) in str(publishing.inbox.last_refusal)
    assert publishing.send(2, 1.1)


def test_the_last_refusal_fits_into_an_answer(publishing: Publishing) -> None:
    hostile = {"preview_N": [-1.2345678901234567e-100] * 256, "preview_dt_ms": 1.0}
    assert not publishing.send(1, **hostile)
    answer = Reply(v=VERSION, id=1, ok=True, result=msgspec.to_builtins(publishing.inbox.report()))
    assert msgspec.convert(decode(encode(answer), Reply).result, SetpointReport) == publishing.inbox.report()


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x00" * 20_000, msgpack.packb("setpoint")])
def test_garbage_is_counted(publishing: Publishing, data: bytes) -> None:
    assert not publishing.take(data)
    assert publishing.counters() == (0, 1, 0)
    assert publishing.inbox.newest is None


@settings(max_examples=60, deadline=None)
@given(
    events=st.lists(
        st.tuples(
            st.sampled_from("abc"), st.integers(0, 8), st.floats(-0.1, 0.5), st.floats(0.0, 2.0), st.floats(0.0, 0.4)
        ),
        max_size=60,
    )
)
def test_every_message_is_counted_once_and_no_source_supersedes_a_newer_one(
    events: list[tuple[str, int, float, float, float]],
) -> None:
    publishing = Publishing()
    last_source, last_stamp_ns = "", 0
    for source, seq, age_s, force_N, elapsed_s in events:
        publishing.now_s += elapsed_s
        stamp_ns = publishing.realtime_ns - round(age_s * 1e9)
        if publishing.send(seq, force_N, source, stamp_ns=stamp_ns):
            assert stamp_ns >= last_stamp_ns or source == last_source
            last_source, last_stamp_ns = source, stamp_ns
            assert publishing.force_N == force_N
    assert sum(publishing.counters()) == len(events)
