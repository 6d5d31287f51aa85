import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, strategies as st

from tormagd.config import Sources
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint, Wall
from tormagd.control.safety.codes import Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.inbox import REPORTED, SILENT_S, SOURCES, SetpointInbox
from tormagd.daemon.source import AHEAD_S, FACTORS, SETTLED_S, STRAYS_S, Needs
from tormagd_client.messages import MAX_MESSAGE_BYTES, VERSION, Reply, SetpointReport, SourceReport, decode, encode

PRIORITY = ("patient", "console")
START_NS = 1_800_000_000_000_000_000
"Second 0 of the control clock."


class Publishing:
    def __init__(self, sources: Sources = Sources()) -> None:  # noqa: B008 it is immutable
        self.inbox = SetpointInbox(sources)
        self.now_s = self.step_s = 0.0

    @property
    def realtime_ns(self) -> int:
        return START_NS + round((self.now_s + self.step_s) * 1e9)

    def send(
        self,
        seq: int,
        force_N: float = 1.0,
        source: str = "a",
        age_s: float = 0.0,
        /,
        at_s: float | None = None,
        **fields: Any,
    ) -> bool:
        self.now_s = self.now_s if at_s is None else at_s
        message = {
            "v": 1,
            "source": source,
            "seq": seq,
            "stamp_ns": self.realtime_ns - round(age_s * 1e9),
            "servo_cf": force_N,
            "valid_for_ms": 50.0,
        }
        return self.inbox.take(msgpack.packb(message | fields), self.now_s, self.realtime_ns)

    def counters(self) -> tuple[int, int, int]:
        return self.inbox.accepted, self.inbox.refused, self.inbox.dropped

    @property
    def newest(self) -> TimedSetpoint:
        assert self.inbox.newest is not None
        return self.inbox.newest

    def of(self, source: str) -> SourceReport:
        self.inbox.refresh(self.now_s)
        return self.inbox.report(self.now_s).by_source[source]


@pytest.fixture
def publishing() -> Publishing:
    return Publishing()


@pytest.mark.parametrize("age_s", [0.02, 43_200.0])
def test_a_setpoint_is_put_on_the_control_clock_and_is_as_old_as_it_says(publishing: Publishing, age_s: float) -> None:
    assert publishing.send(1, 1.5, "a", age_s, at_s=7.0, rate_mm_s=30.0)
    newest = publishing.newest
    found = newest.stamp_s, newest.force_N, newest.valid_for_s, newest.rate_mm_s
    assert found == (pytest.approx(7.0 - age_s, abs=1e-9), 1.5, 0.05, 30.0)


def test_a_law_of_the_handles_way_is_taken_and_refused_by_name_for_a_pad(publishing: Publishing) -> None:
    wall = {"handle_mm": -12.5, "stiffness_N_mm": 0.5, "friction_N": 0.1, "place_sd_mm": 0.3, "stiffness_share": 0.2}
    law = {"withdraw_cf": 0.2, "contact": wall}
    assert publishing.send(1, **law)
    assert (publishing.newest.withdraw_N, publishing.newest.wall) == (0.2, Wall(-12.5, 0.5, 0.1, 0.3, 0.2))
    assert publishing.send(2, contact={"handle_mm": 3.0, "stiffness_N_mm": 2.0})
    assert (publishing.newest.withdraw_N, publishing.newest.wall) == (None, Wall(3.0, 2.0))
    publishing.inbox.has_way = False
    for number, (name, value) in enumerate(law.items()):
        assert not publishing.send(3 + number, **{name: value})
        assert publishing.inbox.last_refusal == f"{name}: allowed is servo_cf alone, as the scene's element is a pad"
    assert publishing.counters() == (2, 2, 0)


def test_a_publisher_that_starts_at_0_is_heard_at_once_when_what_it_said_is_over(publishing: Publishing) -> None:
    publishing.send(1_000)
    assert (publishing.send(0, 2.0, at_s=0.049), publishing.counters()) == (False, (1, 0, 1))
    assert (publishing.send(0, 2.0, at_s=0.051), publishing.newest.force_N) == (True, 2.0)


def test_a_new_run_begins_a_ramp_also_where_its_first_messages_are_refused(publishing: Publishing) -> None:
    publishing.send(100, valid_for_ms=1_000.0)
    for number in range(60):
        publishing.send(number, 2.0, "a", -2.0, at_s=0.01 + number * 0.005, valid_for_ms=1_000.0)
        assert publishing.newest.holder == (publishing.newest.force_N == 2.0)
    assert publishing.newest.force_N == 2.0


# -- who holds the brake -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("holder", "other", "passed"),
    [
        ("patient", "console", False),
        ("console", "patient", True),
        ("a", "console", True),
        ("patient", "a", False),
        ("a", "b", False),
    ],
)
def test_what_is_listed_goes_before_what_comes_later_or_is_not(holder: str, other: str, passed: bool) -> None:
    found = []
    for priority, is_given, at_s in (
        (PRIORITY, False, 0.0),
        (PRIORITY, False, 0.1),
        (PRIORITY, True, 0.0),
        ((), False, 0.0),
    ):
        publishing = Publishing(Sources(priority=priority))
        publishing.send(1, 1.0, holder)
        if is_given:
            publishing.inbox.give(holder, 0.0)
        found.append(publishing.send(1, 2.0, other, at_s=at_s))
    assert found == [passed, True, False, False]


def test_one_source_holds_the_brake_and_another_is_refused_and_named_until_it_is_stale(
    publishing: Publishing, caplog: pytest.LogCaptureFixture
) -> None:
    assert (publishing.send(1, 1.0, "a"), publishing.send(1, 2.0, "b", at_s=0.04)) == (True, False)
    assert (publishing.counters(), publishing.newest.force_N) == ((1, 1, 0), 1.0)
    assert publishing.send(2, 1.0, "a")
    assert publishing.newest.limits == (Limit.OTHER_SOURCE,)
    report = publishing.inbox.report(publishing.now_s)
    states = {source: each.state for source, each in report.by_source.items()}
    assert (report.newest_source, report.sources, states) == ("a", {"a": 2, "b": 1}, {"a": "holds", "b": "refused"})
    told = publishing.inbox.told(publishing.now_s)[Limit.OTHER_SOURCE]
    assert told.cause == "'b' sends setpoints too, and 'a' holds the brake"
    assert told.remedy.endswith("tormagctl take b")
    assert publishing.send(2, 2.0, "b", at_s=0.0901)
    newest = publishing.newest
    assert (newest.force_N, newest.holder, newest.limits) == (2.0, 1, ())
    publishing.inbox.tell(publishing.now_s)
    assert "'b' holds the brake instead of 'a': that is stale" in caplog.text
    assert not publishing.send(3, 1.0, "a")


def test_a_limit_that_is_over_is_over(publishing: Publishing) -> None:
    publishing.send(1, 1.0, "a")
    publishing.send(1, 2.0, "b")
    for tick in range(2, 200):
        publishing.now_s += 0.01
        assert publishing.send(tick, 1.0, "a")
        assert (Limit.OTHER_SOURCE in publishing.newest.limits) == (publishing.now_s < SILENT_S)


def test_a_source_that_is_late_itself_takes_nothing_over(publishing: Publishing) -> None:
    publishing.send(1, 1.0, "a")
    assert (publishing.send(1, 2.0, "b", 0.06, at_s=0.2), publishing.inbox.holder) == (False, "a")


def test_an_operator_gives_the_brake_to_a_source(publishing: Publishing) -> None:
    with pytest.raises(RefusedError, match="no source 'b' has sent setpoints"):
        publishing.inbox.give("b", 0.0)
    publishing.send(1, 1.0, "a")
    assert (publishing.inbox.in_force.seq, publishing.inbox.passed_over()) == (1, None)
    publishing.send(7, 2.0, "b")
    assert (publishing.inbox.in_force.seq, publishing.inbox.passed_over()) == (1, ("b", 7))
    publishing.inbox.give("b", publishing.now_s)
    assert (publishing.inbox.in_force.seq, publishing.inbox.passed_over()) == (7, None)
    assert publishing.inbox.holder == "b"
    newest = publishing.newest
    assert (newest.force_N, newest.holder, newest.limits) == (2.0, 1, ())
    assert (publishing.send(2, 1.0, "a"), publishing.send(8, 2.1, "b")) == (False, True)
    publishing.now_s = 0.2
    with pytest.raises(RefusedError, match="source 'a' has sent nothing that is still valid"):
        publishing.inbox.give("a", publishing.now_s)
    assert publishing.send(3, 1.0, "a")


@pytest.mark.parametrize("sessions", [(None, None), (1, 1), (1, 2), (2, 1)])
@pytest.mark.parametrize("rates", [(1, 1), (1, 2), (2, 1), (5, 1), (1, 5)])
def test_two_publishers_of_one_name_do_not_alternate_on_the_brake(
    publishing: Publishing, sessions: tuple[int | None, int | None], rates: tuple[int, int]
) -> None:
    numbers, forces_N, doubled = [0, 50_000], [], 0
    for tick in range(200):
        publishing.now_s = tick * 0.01
        for who in (*[0] * rates[0], *[1] * rates[1]):
            numbers[who] += 1
            publishing.send(numbers[who], (0.9, 1.6)[who], session=sessions[who])
            forces_N.append(publishing.newest.force_N)
        doubled += publishing.newest.limits == (Limit.OTHER_SOURCE,)
    assert sum(a != b for a, b in pairwise(forces_N)) <= 2
    assert doubled > 150
    why = [publishing.inbox.told(now_s)[Limit.OTHER_SOURCE].cause for now_s in (2.0, 2.0 + STRAYS_S)]
    assert ["two publishers call themselves 'a'" in each for each in why] == [True, False]


def test_why_it_is_stale_is_said(publishing: Publishing) -> None:
    publishing.send(1)
    publishing.now_s = 0.3
    silent = publishing.inbox.told(publishing.now_s)[Limit.STALE]
    publishing.send(2, 1.0, "a", 0.12)
    late = publishing.inbox.told(publishing.now_s)[Limit.STALE]
    assert silent.cause.startswith("'a' has sent nothing for 300 ms")
    assert late.cause.startswith("setpoints of 'a' come 120 ms late, and are valid for 50 ms")


# -- clocks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_s", [-3_600.0, -0.5, 0.5, 3_600.0])
def test_setting_the_time_of_this_machine_keeps_no_setpoint_out(publishing: Publishing, step_s: float) -> None:
    publishing.send(1, 1.0, "a", 0.01)
    publishing.step_s = step_s
    for tick in range(2, 5):
        publishing.now_s += 0.002
        assert publishing.send(tick, float(tick), "a", 0.001)
        newest = publishing.newest
        assert (newest.force_N, newest.stamp_s) == (tick, pytest.approx(publishing.now_s - 0.001, abs=1e-5))


def test_a_clock_that_is_set_makes_no_setpoint_older_or_younger(publishing: Publishing) -> None:
    for tick in range(100):
        publishing.send(tick, 1.0, "a", 0.5 * (tick >= 50), at_s=tick * 0.002)
        assert publishing.newest.stamp_s == pytest.approx(publishing.now_s, abs=1e-3)
    assert publishing.counters() == (100, 0, 0)


@pytest.mark.parametrize(
    ("late_s", "period_s", "count", "said"),
    [
        (lambda at_s: -0.5 * (at_s >= 0.1), 0.002, 100, "it was set forward by 0.500 s"),
        (lambda at_s: 0.5 * (at_s >= 0.1), 0.002, 100, "it was set back by 0.500 s"),
        (
            lambda at_s: START_NS * 1e-9 - 1_790.0,
            0.002,
            500,
            "its clock: it was never set (it says 1970), and is corrected",
        ),
        (lambda at_s: 1.0, 0.002, 500, "1.000 s behind this machine's"),
        (lambda at_s: -1.0, 0.002, 500, "ahead of this machine's, and is corrected"),
        (lambda at_s: -200e-6 * at_s, 0.01, 1_500, "ppm fast"),
        (lambda at_s: 200e-6 * at_s, 0.01, 1_500, "ppm slow"),
    ],
    ids=["set forward", "set back", "never set", "behind", "ahead", "fast", "slow"],
)
def test_what_is_wrong_with_a_clock_is_corrected_and_named(
    publishing: Publishing,
    late_s: Callable[[float], float],
    period_s: float,
    count: int,
    said: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    noise = random.Random(1)
    for seq in range(count):
        at_s = seq * period_s
        publishing.send(seq, 1.5, "a", late_s(at_s) + noise.uniform(0.0, 0.001), at_s=at_s)
    found = publishing.of("a")
    publishing.inbox.tell(publishing.now_s)
    told = (said in found.cause, "chrony" in found.remedy, found.cause in caplog.text, found.clock_steps)
    assert told == (True, True, True, "was set" in said), found
    assert publishing.newest.stamp_s == pytest.approx(publishing.now_s, abs=0.002)
    assert publishing.inbox.accepted > 0.75 * count


def test_a_stamp_ahead_of_the_clock_is_refused_until_it_is_known_to_be_the_clock(publishing: Publishing) -> None:
    assert (publishing.send(1, 2.0, "a", -AHEAD_S - 0.001), publishing.counters()) == (False, (0, 1, 0))
    with pytest.raises(RefusedError, match="nothing that is still valid"):
        publishing.inbox.give("a", publishing.now_s)
    assert "0.051 s ahead of this clock: allowed are 0.05 s ahead and 86400 s behind" in str(
        publishing.inbox.last_refusal
    )
    assert publishing.send(2, 2.0, "a", -AHEAD_S - 0.001, at_s=SETTLED_S)
    # a known source: it is the clock; no setpoint is younger than its arrival
    assert publishing.send(1, 1.0, "b", 0.0, valid_for_ms=1.0) is False
    assert publishing.newest.stamp_s == SETTLED_S


@pytest.mark.parametrize("unit", FACTORS)
@pytest.mark.parametrize("period_s", [0.002, 0.2])
def test_stamps_in_another_unit_are_refused_by_name_and_take_no_brake(
    publishing: Publishing, unit: str, period_s: float
) -> None:
    noise = random.Random(1)
    for number in range(30):
        publishing.now_s += period_s * noise.uniform(0.2, 1.8)
        assert not publishing.send(number, 1.5, "a", stamp_ns=publishing.realtime_ns // FACTORS[unit])
        assert f"of 'a' counts {unit}: send ns since 1970" in (publishing.inbox.last_refusal or "")
    assert (publishing.inbox.holder, publishing.inbox.newest) == ("", None)
    found = publishing.of("a")
    assert (found.cause, found.clock_behind_ms) == (f"its stamps count {unit}, and are refused", None)
    assert (publishing.send(30, 1.5, "a"), publishing.of("a").clock_behind_ms) == (True, 0.0)


def test_a_line_through_a_few_noisy_stamps_is_no_drift(publishing: Publishing) -> None:
    noise, drifts_ppm = random.Random(1), []
    for tick in range(800):
        publishing.send(tick, 1.0, "a", noise.uniform(0.0, 0.045), at_s=tick * 0.05, valid_for_ms=200.0)
        found = publishing.of("a")
        assert found.cause == ""
        if found.clock is not None:
            drifts_ppm.append(abs(found.clock.drift_ppm))
    assert max(drifts_ppm) > 200.0


def test_losses_and_delays_are_counted_for_each_source(publishing: Publishing) -> None:
    for tick in range(1_000):
        if tick % 10:
            publishing.send(tick, 1.0, "a", 0.003 if tick % 2 else 0.001, at_s=tick * 0.002)
    found = publishing.of("a")
    assert (found.lost, found.cause, found.clock_behind_ms) == (99, "", pytest.approx(0.0, abs=0.1))
    assert (found.delay_us.p50, found.delay_us.p99) == pytest.approx((3_000.0, 3_000.0), rel=0.04)
    assert found.jitter_us == pytest.approx(1_800.0, rel=0.2)


def test_one_publisher_too_many_is_refused_until_one_is_silent_unless_it_is_listed() -> None:
    publishing = Publishing(Sources(priority=("patient",)))
    for number in range(SOURCES):
        publishing.send(1, at_s=number * 0.01, source=f"source {number}", valid_for_ms=60_000.0)
    assert not publishing.send(1, 2.0, source="one more")
    assert "one more" in str(publishing.inbox.last_refusal)
    # the first holds the brake, the second has been silent long enough, the third has not
    publishing.send(1, 2.0, at_s=SILENT_S + 0.015, source="one more")
    assert publishing.send(1, 2.0, source="patient")
    kept = {f"source {number}" for number in range(SOURCES) if number not in (1, 2)}
    assert set(publishing.inbox.report(publishing.now_s).sources) == kept | {"one more", "patient"}


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
        {"source": "\x1b[2J"},
        {"session": -1},
        {"session": 2**63},
        {"session": "1"},
        {"seq": -1},
        {"seq": 2**63},
        {"seq": None},
        {"stamp_ns": 1.5},
        {"rate_mm_s": float("nan")},
        {"displacement_mm": 1e10},
        {"rate_mm_s": -1e308},
        {"preview_N": [float("nan")], "preview_dt_ms": 1.0},
        {"preview_dt_ms": float("nan")},
        {"preview_dt_ms": -1.0},
        {"contact": {"handle_mm": 1.0, "stiffness_N_mm": -0.1}},
    ],
)
def test_a_refused_setpoint_changes_nothing_but_the_counter(publishing: Publishing, fields: dict[str, Any]) -> None:
    publishing.send(1, 1.0)
    before = publishing.inbox.newest
    assert (publishing.send(2, **fields), publishing.inbox.newest is before, publishing.counters()) == (
        False,
        True,
        (1, 1, 0),
    )
    assert str(next(iter(fields))) in str(publishing.inbox.last_refusal)
    assert publishing.send(2, 1.1)


def test_a_force_around_zero_is_taken_as_zero_and_counted(publishing: Publishing) -> None:
    assert publishing.send(1, 1.0)
    assert publishing.send(2, -1e-17, preview_N=[1.0, -0.005, -0.0], preview_dt_ms=1.0, withdraw_cf=-0.004)
    assert publishing.inbox.in_force is not None
    taken = publishing.inbox.in_force.setpoint
    asked_N = [taken.force_N, *taken.preview_N, taken.withdraw_N]
    assert [str(force_N) for force_N in asked_N] == ["0.0", "1.0", "0.0", "0.0", "0.0"]
    assert publishing.inbox.in_force.is_raised
    assert [source.raised for source in publishing.inbox.report(publishing.now_s).by_source.values()] == [1]
    assert not publishing.send(3, -0.0051)


def test_the_report_fits_into_an_answer_whatever_the_sources_call_themselves(publishing: Publishing) -> None:
    assert not publishing.send(1, preview_N=[-1.2345678901234567e100] * 256, preview_dt_ms=1.0)
    for tick in range(30):
        publishing.now_s += 0.01
        for number in range(SOURCES):
            name = f"{number:2d}" + 62 * "\U00010348"  # four bytes each
            publishing.send(2**63 - 100 + tick, 1.0, name, 1e3, session=2**63 - 1)
            publishing.inbox.refresh(publishing.now_s)
    report = publishing.inbox.report(publishing.now_s)
    assert len(report.by_source) == REPORTED
    answer = encode(Reply(v=VERSION, id=1, ok=True, result=msgspec.to_builtins(report)))
    # the rest of the status needs room
    assert len(answer) < MAX_MESSAGE_BYTES - 4_000
    assert msgspec.convert(decode(answer, Reply).result, SetpointReport) == report


@given(
    events=st.lists(
        st.tuples(
            st.sampled_from("abc"),
            st.one_of(st.integers(0, 8), st.sampled_from([2**62, 2**63 - 1])),
            st.floats(-2.0, 2.0),
            st.floats(0.0, 2.0),
            st.floats(0.0, 0.4),
            st.sampled_from([None, 0, 2**63 - 1]),
        ),
        max_size=60,
    )
)
def test_every_message_is_counted_once_and_no_source_takes_the_brake_from_one_that_is_valid(
    events: list[tuple[str, int, float, float, float, int | None]],
) -> None:
    publishing = Publishing()
    for source, seq, age_s, force_N, elapsed_s, session in events:
        publishing.now_s += elapsed_s
        before = publishing.inbox.newest
        held = publishing.inbox.holder
        is_newest = publishing.send(seq, force_N, source, age_s, session=session)
        assert is_newest == (publishing.inbox.newest is not before)
        if is_newest:
            assert (publishing.newest.force_N, publishing.inbox.holder) == (force_N, source)
            assert publishing.newest.stamp_s <= publishing.now_s
            if before is not None and held != source:
                assert publishing.now_s - before.stamp_s > before.valid_for_s
                assert publishing.newest.holder == before.holder + 1
    assert sum(publishing.counters()) == len(events)


# -- networks with delays and losses: the cause shows within two seconds -----------------------------------------------


NEEDS = Needs(delay_s=0.15)
Delay = Callable[[random.Random], float]


def steady(delay_s: float) -> Delay:
    return lambda noise: delay_s


CASES: list[tuple[float, Delay, float, tuple[Limit, ...]]] = [
    # setpoints a second, delay, share of losses
    (5.0, steady(0.001), 0.0, (Limit.SOURCE_SELDOM,)),
    (20.0, steady(0.001), 0.0, ()),
    (100.0, steady(0.001), 0.0, ()),
    (500.0, steady(0.02), 0.0, ()),
    (500.0, steady(0.1), 0.0, ()),
    (500.0, steady(0.4), 0.0, (Limit.SOURCE_LATE,)),
    (100.0, lambda noise: 0.4 + noise.uniform(0.0, 0.05), 0.0, (Limit.SOURCE_JITTER, Limit.SOURCE_LATE)),
    (500.0, lambda noise: 0.02 + noise.uniform(0.0, 0.005), 0.0, ()),
    (500.0, lambda noise: 0.02 + noise.uniform(0.0, 0.03), 0.0, (Limit.SOURCE_JITTER,)),
    (500.0, lambda noise: 0.02 + abs(noise.gauss(0.0, 0.05)), 0.0, (Limit.SOURCE_JITTER,)),
    (500.0, lambda noise: 0.1 + noise.expovariate(1.0 / 0.03), 0.0, (Limit.SOURCE_JITTER, Limit.SOURCE_LATE)),
    (500.0, steady(0.001), 0.01, ()),
    (500.0, steady(0.001), 0.2, (Limit.SOURCE_LOSS,)),
]


@pytest.fixture
def judged(publishing: Publishing) -> Publishing:
    publishing.inbox._needs = NEEDS
    return publishing


def hear(
    judged: Publishing, rate_hz: float, delay: Delay, lost: float, seed: int, from_s: float = 0.0, to_s: float = 2.1
) -> None:
    noise, arrives_s = random.Random(seed), 0.0
    for number in range(round(from_s * rate_hz), round(to_s * rate_hz)):
        sent_s = number / rate_hz
        arrives_s = max(arrives_s, sent_s + delay(noise))
        if noise.random() >= lost:
            judged.send(number, 1.0, "a", arrives_s - sent_s, at_s=arrives_s, valid_for_ms=1_000.0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rate_hz", "delay", "lost", "limits"), CASES)
def test_the_cause_is_named_within_two_seconds(
    judged: Publishing, rate_hz: float, delay: Delay, lost: float, limits: tuple[Limit, ...], seed: int
) -> None:
    hear(judged, rate_hz, delay, lost, seed)
    assert set(judged.newest.limits) == set(limits)
    told = judged.inbox.told(2.1)
    assert all(told[limit].cause and told[limit].remedy for limit in limits)


def test_what_is_over_is_not_told_any_more(judged: Publishing) -> None:
    hear(judged, 500.0, lambda noise: 0.02 + noise.uniform(0.0, 0.03) * (noise.random() < 0.5), 0.0, 1)
    assert judged.newest.limits == (Limit.SOURCE_JITTER,)
    hear(judged, 500.0, steady(0.03), 0.0, 1, 4.0, 6.2)
    assert judged.newest.limits == ()


@pytest.mark.parametrize("rate_hz", [25.0, 100.0, 500.0])
@pytest.mark.parametrize("what", ["pauses", "restarts", "restarts with a session", "restarts elsewhere"])
def test_no_pause_and_no_restart_is_told_as_a_manner_of_sending(judged: Publishing, what: str, rate_hz: float) -> None:
    noise, now_s, number, session, way_s = random.Random(round(rate_hz)), 0.0, 0, 1, 0.001
    for _ in range(50):
        for _ in range(round(rate_hz * noise.uniform(0.2, 3.0))):
            now_s, number = now_s + noise.uniform(0.9, 1.1) / rate_hz, number + 1
            stated = session if "session" in what else None
            judged.send(number, 1.0, "a", way_s, at_s=now_s, valid_for_ms=100.0, session=stated)
            assert judged.newest.limits == (), (now_s, judged.inbox.told(now_s))
        if what == "pauses" or noise.random() < 0.7:
            now_s += noise.choice([0.15, 0.4, 0.9, 2.0, 20.0])
        if what != "pauses":
            number, session = 0, session + 1
        if what == "restarts elsewhere":
            way_s = noise.uniform(0.001, 0.1)


# -- playout -----------------------------------------------------------------------------------------------------------


TICK_S = 1e-3
PERIOD_S = 0.01


class Listening(Publishing):
    """What is in force in each tick: (now_s, stamp_s, force_N)."""

    def __init__(self, playout_ms: float, valid_for_ms: float = 500.0) -> None:
        super().__init__(Sources(playout_ms=playout_ms))
        self.valid_for_ms = valid_for_ms
        self.followed: list[tuple[float, float, float]] = []

    def take(self, now_s: float, seq: int, sent_s: float, source: str = "a") -> bool:
        force_N, age_s = 1.0 + 1e-3 * seq, now_s - sent_s
        return self.send(seq, force_N, source, age_s, at_s=now_s, valid_for_ms=self.valid_for_ms)

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
