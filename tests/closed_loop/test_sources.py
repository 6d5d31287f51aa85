"""Several publishers, with clocks and ways of their own, at one brake: inbox, core and device in virtual time."""

import contextlib
import heapq
import math
import random
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import msgpack
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.config import Sources
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Limit
from tormagd.control.safety.operating_state import OperatingState, RefusedError
from tormagd.daemon.force_delay import ForceDelay
from tormagd.daemon.inbox import EQUAL_SOURCES, SetpointInbox
from tormagd.simulation.closed_loop import ClosedLoop, Sample
from tormagd.simulation.hand import ReversingHand, SteadyHand
from tormagd_client.messages import SourceReport

START_NS = 1_800_000_000_000_000_000
PERIOD_S = 0.002
VALID_MS = 100.0
WAY_S = 0.001


class Publisher(NamedTuple):
    """One process that sends a force by its own clock."""

    force_N: Callable[[float], float]
    source: str = "a"
    from_s: float = 0.0
    to_s: float = math.inf
    way_s: Callable[[float], float] = lambda t: WAY_S
    first_seq: int = 0
    session: int | None = None

    def messages(self, start_s: float, lasts_s: float) -> Iterable[tuple[float, bytes]]:
        arrived_s = -math.inf
        for number in range(round(self.from_s / PERIOD_S), round(min(self.to_s, lasts_s) / PERIOD_S)):
            sent_s = number * PERIOD_S
            arrived_s = max(arrived_s, sent_s + self.way_s(sent_s))
            fields = {
                "v": 1,
                "source": self.source,
                "session": self.session,
                "seq": self.first_seq + number - round(self.from_s / PERIOD_S),
                "stamp_ns": START_NS + round((start_s + sent_s) * 1e9),
                "servo_cf": self.force_N(sent_s),
                "valid_for_ms": VALID_MS,
            }
            yield start_s + arrived_s, msgpack.packb(fields)


class Run(NamedTuple):
    samples: list[Sample]
    inbox: SetpointInbox
    way: ForceDelay
    start_s: float

    def of(self, source: str) -> SourceReport:
        return self.inbox.report(self.samples[-1].time_s).by_source[source]

    def held_by(self, limit: Limit) -> list[float]:
        return [each.time_s - self.start_s for each in self.samples if limit in each.plan.limits]

    def error_N(self, force_N: Callable[[float], float], from_s: float, to_s: float = math.inf) -> float:
        return max(
            abs(each.truth.force_N - force_N(each.time_s - self.start_s))
            for each in self.samples
            if from_s <= each.time_s - self.start_s <= to_s
        )

    def fastest_loss_N_s(self, over_s: float = 0.05) -> float:
        forces, over = [each.truth.force_N for each in self.samples], round(over_s * 1e3)
        return max((a - b) / over_s for a, b in zip(forces, forces[over:], strict=False))


def run(
    loop: ClosedLoop,
    *publishers: Publisher,
    lasts_s: float = 3.0,
    sources: Sources = EQUAL_SOURCES,
    at: Callable[[SetpointInbox, float], None] = lambda inbox, now_s: None,
) -> Run:
    """Run the loop with these publishers; `at` is called in every tick."""
    inbox, way, samples, start_s = SetpointInbox(sources), ForceDelay(), [], loop.now_s
    coming = heapq.merge(*(each.messages(start_s, lasts_s) for each in publishers))
    following = next(coming, None)
    for _ in range(round(lasts_s * 1e3)):
        now_s = loop.now_s
        while following is not None and following[0] <= now_s:
            inbox.take(following[1], now_s, START_NS + round(now_s * 1e9))
            following = next(coming, None)
        inbox.hand_on(now_s)
        at(inbox, now_s - start_s)
        used = loop.planner.planned
        samples.append(loop.tick(inbox.newest))
        way.ticked(loop.stepper.time_s, used, sources.playout_ms * 1e-3)
    for _ in range(8):
        inbox.refresh(loop.now_s)
    way.to_duty.refresh()
    return Run(samples, inbox, way, start_s)


def constant(force_N: float) -> Callable[[float], float]:
    return lambda time_s: force_N


def swell_N(time_s: float) -> float:
    return 1.3 - 0.3 * math.cos(math.tau * 0.8 * time_s)


@pytest.mark.parametrize(
    ("ends_s", "begins_s", "priority", "given_s", "passes_s", "state"),
    [
        (1.5, 1.0, (), math.inf, 1.6, "stale"),
        (math.inf, 0.5, (), 1.0, 1.0, "refused"),
        (math.inf, 1.0, ("b",), math.inf, 1.0, "refused"),
    ],
    ids=["the first is gone", "an operator gives it", "it goes first"],
)
def test_another_takes_over_along_the_ramp(
    armed: ClosedLoop,
    core: Core,
    ends_s: float,
    begins_s: float,
    priority: tuple[str, ...],
    given_s: float,
    passes_s: float,
    state: str,
) -> None:
    def give(inbox: SetpointInbox, time_s: float) -> None:
        if abs(time_s - given_s) < 5e-4:
            inbox.give("b", armed.now_s)

    publishers = Publisher(constant(1.6), to_s=ends_s), Publisher(constant(0.8), "b", from_s=begins_s)
    done = run(armed, *publishers, sources=Sources(priority=priority), at=give)
    assert done.error_N(constant(1.6), 0.9, min(ends_s, passes_s)) < 0.05
    assert done.error_N(constant(0.8), passes_s + 0.6) < 0.05
    passed_s = [time_s for time_s in done.held_by(Limit.TAKEOVER) if time_s > 0.9]
    assert passed_s[0] == pytest.approx(passes_s, abs=0.01)
    assert done.fastest_loss_N_s() <= 1.25 * core.scene.force.release_N_s
    assert done.of("a").state == state


@pytest.mark.parametrize(
    ("session", "gap_s"), [((1, 2), 0.0), ((None, None), 3 * PERIOD_S)], ids=["with session", "without"]
)
def test_a_restarted_publisher_goes_on_without_a_gap(
    armed: ClosedLoop, session: tuple[int | None, int | None], gap_s: float
) -> None:
    done = run(
        armed,
        Publisher(swell_N, to_s=1.5, session=session[0], first_seq=5_000),
        Publisher(swell_N, from_s=1.5, session=session[1]),
    )
    assert not done.held_by(Limit.STALE)
    assert max(each.plan.setpoint_age_s or 0.0 for each in done.samples[100:]) <= WAY_S + PERIOD_S + gap_s + 0.004
    assert done.error_N(swell_N, 1.0) < 0.05
    assert done.of("a").restarts == 1


def aligned_rms_N(done: Run, from_s: float = 1.5) -> float:
    """Return how well the plant's force follows the swell, with the best delay taken out."""
    known = [(each.time_s - done.start_s, each.truth.force_N) for each in done.samples]
    counted = [(time_s, force_N) for time_s, force_N in known if time_s >= from_s]
    return min(
        math.sqrt(sum((force_N - swell_N(time_s - late_s)) ** 2 for time_s, force_N in counted) / len(counted))
        for late_s in (0.002 * step for step in range(60))
    )


def test_a_playout_of_the_delays_p99_makes_jitter_as_good_as_a_steady_way(arm: Callable[[], ClosedLoop]) -> None:
    def jittery() -> Publisher:
        noise = random.Random(3)
        return Publisher(swell_N, way_s=lambda t: 0.02 + noise.expovariate(1.0 / 0.01))

    before = run(arm(), jittery())
    playout_ms = before.of("a").delay_us.p99 * 1e-3
    steady = run(arm(), Publisher(swell_N, way_s=lambda t: playout_ms * 1e-3))
    played = run(arm(), jittery(), sources=Sources(playout_ms=playout_ms))
    assert aligned_rms_N(played) <= 1.2 * aligned_rms_N(steady) < aligned_rms_N(before)
    found = played.inbox.report(played.samples[-1].time_s).playout
    assert found is not None
    assert 0 < found.late <= 0.03 * found.setpoints
    assert found.held_us.p50 == pytest.approx(playout_ms * 1e3 - before.of("a").delay_us.p50, rel=0.1)
    assert played.way.to_duty.report.p50 == pytest.approx(playout_ms * 1e3 + 1_000.0, rel=0.05)


# -- whatever a publisher sends ----------------------------------------------------------------------------------------


REALTIME_NS = 1_800_000_000 * 10**9
LAST = 2**63 - 1
Fields = dict[str, Any]


class Draw(random.Random):
    """Numbers and messages, mostly allowed ones."""

    def upto(self, most: float) -> float:
        edges, hostile = [0.0, 5e-324, 1e-9, most], [-1e-9, math.nextafter(most, math.inf), 1e308, math.inf, math.nan]
        return self.choice([self.uniform(0.0, most)] * 16 + edges * 2 + hostile)

    def within(self, most: float) -> float:
        return self.choice((-1.0, 1.0)) * self.upto(most)

    def forces(self, most_N: float) -> list[float]:
        levels = [self.uniform(0.0, most_N) for _ in range(self.randint(1, 4))]
        return [*self.choices(levels, k=self.randint(0, 255)), self.upto(most_N)]

    def wall(self, most_N_mm: float) -> Fields:
        place_mm = self.choice([self.uniform(-30.0, 30.0), self.within(1e4)])
        return {"handle_mm": place_mm, "stiffness_N_mm": self.upto(most_N_mm), "friction_N": self.upto(2.0)}

    def mistyped(self) -> Any:
        return self.choice([None, "x", "\x1b[2J", -1, True, [], [1.0], {}, b"", 2**64 - 1, 0.5, math.nan])


KINDS: dict[str, Callable[[Draw, Fields], Fields]] = {
    "well": lambda draw, sent: {},
    "force": lambda draw, sent: {"servo_cf": draw.upto(3.0)},
    "great force": lambda draw, sent: {"servo_cf": draw.upto(1e3)},
    "withdrawing": lambda draw, sent: {"withdraw_cf": draw.upto(draw.choice([3.0, 1e3]))},
    "validity": lambda draw, sent: {"valid_for_ms": draw.choice([draw.upto(6e4), 5e-324, 1e-3, 1.0, 6e4])},
    "displacement": lambda draw, sent: {"displacement_mm": draw.upto(2.0)},
    "rate": lambda draw, sent: {"rate_mm_s": draw.within(300.0)},
    "preview": lambda draw, sent: {"preview_N": draw.forces(3.0), "preview_dt_ms": draw.uniform(1.0, 20.0)},
    "wild preview": lambda draw, sent: {
        "preview_N": draw.forces(1e3),
        "preview_dt_ms": draw.choice([0.1, 1e3, draw.upto(1e3), 5e-324]),
    },
    "wall": lambda draw, sent: {"contact": draw.wall(2.0), "withdraw_cf": draw.choice([None, draw.upto(2.0)])},
    "hard wall": lambda draw, sent: {"contact": draw.wall(100.0)},
    "never set": lambda draw, sent: {"stamp_ns": sent["stamp_ns"] - REALTIME_NS},
    "stamp 0": lambda draw, sent: {"stamp_ns": 0},
    "any stamp": lambda draw, sent: {"stamp_ns": draw.choice([draw.randint(-9, LAST + 9), draw.randint(0, 9), LAST])},
    "near stamp": lambda draw, sent: {"stamp_ns": sent["stamp_ns"] + round(draw.gauss(0.0, 1e9))},
    "unit": lambda draw, sent: {"stamp_ns": sent["stamp_ns"] // draw.choice([10**3, 10**6, 10**9])},
    "numbers": lambda draw, sent: {"seq": draw.choice([draw.randint(-2, LAST + 2), draw.randint(0, 9), LAST])},
    "sessions": lambda draw, sent: {"session": draw.choice([None, draw.randint(-1, 9), LAST])},
    "names": lambda draw, sent: {"source": draw.choice(["", "\x1b", "é" * 64, *map(str, range(40))])},
    "mistyped": lambda draw, sent: {draw.choice([*sent, "contact", "preview_N", "rate_mm_s"]): draw.mistyped()},
}  # fmt: skip
"What a run of messages of one publisher is like, besides what is well."


def sent_and_planned(loop: ClosedLoop, seed: int, setpoints: int) -> Counter[str]:
    """So many setpoints of three publishers, of a kind or two each, through inbox and core; what came of them,
    counted."""
    draw, found = Draw(seed), Counter[str]()
    inbox = SetpointInbox(Sources(priority=draw.choice([(), ("b",)]), playout_ms=draw.choice([0.0, 0.0, 60.0])))
    kinds, step_s, sent = dict.fromkeys("abc", "well"), 0.0, 0
    while sent < setpoints:
        now_s = loop.now_s
        if draw.random() < 1e-3:  # somebody sets the time of this machine
            step_s = draw.choice([0.0, -1.8e9, draw.gauss(0.0, 10.0)])
        realtime_ns = REALTIME_NS + round((now_s + step_s) * 1e9)
        for name in kinds:
            if draw.random() < 0.02:
                kinds[name] = draw.choice([*KINDS, "silent"])
            if kinds[name] == "silent" or draw.random() < 0.5:
                continue
            well = {"v": 1, "source": name, "seq": sent, "stamp_ns": realtime_ns - 10**6, "session": None}
            well |= {"servo_cf": 1.0 + 0.5 * math.sin(3.0 * now_s), "valid_for_ms": 100.0}
            fields = dict(well)
            for kind in (kinds[name], draw.choice(list(KINDS)) if draw.random() < 0.1 else "well"):
                fields |= KINDS[kind](draw, well)
                found[kind] += 1
            with contextlib.suppress(OverflowError):  # of msgpack, whose integers have 64 bits
                inbox.take(msgpack.packb(fields), now_s, realtime_ns)
            sent += 1
        inbox.hand_on(now_s)
        if draw.random() < 0.01:
            with contextlib.suppress(RefusedError):
                inbox.give(draw.choice("abcd"), now_s)
        if draw.random() < 0.05:
            inbox.refresh(now_s), inbox.tell(now_s), inbox.told(now_s), inbox.report(now_s)
        sample = loop.tick(inbox.newest)  # raises where the daemon latches PLAN_FAILED
        assert sample.safety.operating_state is OperatingState.ENABLED, sample.safety
        found.update(map(str, sample.plan.limits))
    return found + Counter(accepted=inbox.accepted, refused=inbox.refused, dropped=inbox.dropped)


@settings(max_examples=settings.default.max_examples // 8)
@given(seed=st.integers(0, 2**32))
def test_whatever_is_sent_the_core_plans_on(arm: Callable[..., ClosedLoop], seed: int) -> None:
    found = sent_and_planned(arm("sample_1", ReversingHand() if seed % 2 else SteadyHand()), seed, 500)
    assert found["accepted"] > 10


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("case", ["first", "restarted", "burst"])
def test_a_publisher_that_says_1970_makes_no_plan_fail(core: Core, case: str, seed: int) -> None:
    planner, inbox, now_s = core.planner(), SetpointInbox(), 0.0
    began = random.Random(seed).randint(100, 200)
    for number in range(600):
        now_s = number * PERIOD_S
        realtime_ns = REALTIME_NS + round(now_s * 1e9)
        well, unset = (10_000 + number, realtime_ns), (number, realtime_ns - REALTIME_NS)
        coming = [unset if case == "first" or (case == "restarted" and number >= began) else well]
        if case == "burst" and number == began:
            coming += [(each, 0) for each in range(6)]
        for seq, stamp_ns in coming:
            fields = {"v": 1, "source": "a", "seq": seq, "stamp_ns": stamp_ns, "servo_cf": 1.2, "valid_for_ms": 100.0}
            inbox.take(msgpack.packb(fields), now_s, realtime_ns)
        assert (planner.plan(now_s, inbox.newest, None, True).setpoint_age_s or 0.0) < 1.0
    assert (planner.planned.setpoint_N, planner.planned.setpoint_age_s) == (1.2, pytest.approx(0.0, abs=0.01))
