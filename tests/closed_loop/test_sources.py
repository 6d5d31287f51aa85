"""Several publishers, with clocks and ways of their own, at one brake: inbox, core and device in virtual time."""

import heapq
import math
import random
from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgpack
import pytest

from tormagd.config import Sources
from tormagd.control.assembly.build import Core
from tormagd.control.safety.codes import Limit
from tormagd.daemon.force_delay import ForceDelay
from tormagd.daemon.inbox import EQUAL_SOURCES, SetpointInbox
from tormagd.daemon.source import SETTLED_S
from tormagd.scenes.scene import Budget
from tormagd.simulation.closed_loop import ClosedLoop, Sample
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
    clock_s: Callable[[float], float] = lambda t: t
    way_s: Callable[[float], float] = lambda t: WAY_S
    first_seq: int = 0
    session: int | None = None
    is_lost: Callable[[int], bool] = lambda number: False

    def messages(self, start_s: float, lasts_s: float) -> Iterable[tuple[float, bytes]]:
        arrived_s = -math.inf
        for number in range(round(self.from_s / PERIOD_S), round(min(self.to_s, lasts_s) / PERIOD_S)):
            sent_s = number * PERIOD_S
            if self.is_lost(number):
                continue
            arrived_s = max(arrived_s, sent_s + self.way_s(sent_s))
            fields = {
                "v": 1,
                "source": self.source,
                "session": self.session,
                "seq": self.first_seq + number - round(self.from_s / PERIOD_S),
                "stamp_ns": START_NS + round((start_s + self.clock_s(sent_s)) * 1e9),
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


def test_when_the_first_is_gone_the_second_takes_over_along_the_ramp(armed: ClosedLoop, core: Core) -> None:
    done = run(armed, Publisher(constant(1.6), to_s=1.5), Publisher(constant(0.8), "b", from_s=1.0))
    assert done.error_N(constant(1.6), 1.0, 1.5) < 0.05
    assert done.error_N(constant(0.8), 2.2) < 0.05
    passed_s = [time_s for time_s in done.held_by(Limit.TAKEOVER) if time_s > 1.0]
    assert passed_s[0] == pytest.approx(1.6, abs=0.01)
    assert done.fastest_loss_N_s() <= 1.25 * core.scene.force.release_N_s


@pytest.mark.parametrize("priority", [(), ("b",)])
def test_on_purpose_another_takes_over_along_the_ramp(armed: ClosedLoop, core: Core, priority: tuple[str, ...]) -> None:
    def give(inbox: SetpointInbox, time_s: float) -> None:
        if not priority and abs(time_s - 1.0) < 5e-4:
            inbox.give("b", armed.now_s)

    publishers = Publisher(constant(1.6)), Publisher(constant(0.8), "b", from_s=1.0 if priority else 0.5)
    done = run(armed, *publishers, sources=Sources(priority=priority), at=give)
    assert done.error_N(constant(1.6), 0.9, 1.0) < 0.05
    assert done.error_N(constant(0.8), 1.6) < 0.05
    assert done.fastest_loss_N_s() <= 1.25 * core.scene.force.release_N_s
    assert done.of("a").state == "refused"


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


@pytest.mark.parametrize(("seq", "dropped", "refused"), [(2**63 - 1, 1, 0), (2**63, 0, 1)], ids=["last", "beyond"])
def test_one_wrong_number_locks_nobody_out(armed: ClosedLoop, seq: int, dropped: int, refused: int) -> None:
    done = run(armed, Publisher(swell_N), Publisher(constant(0.2), from_s=1.5, to_s=1.5 + PERIOD_S, first_seq=seq))
    assert not done.held_by(Limit.STALE)
    assert done.error_N(swell_N, 1.0) < 0.05
    assert (done.of("a").restarts, done.inbox.dropped, done.inbox.refused) == (0, dropped, refused)


CLOCKS = {
    "1 s behind": (lambda t: t - 1.0, 1_000.0),
    "set forward": (lambda t: t + 1.0 * (t > 1.5), -1_000.0),
    "200 ppm slow": (lambda t: t * (1.0 - 200e-6), 0.8),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_a_wrong_clock_makes_no_setpoint_stale_and_is_named(armed: ClosedLoop, name: str) -> None:
    clock_s, behind_ms = CLOCKS[name]
    noise = random.Random(1)
    publisher = Publisher(
        swell_N,
        clock_s=clock_s,
        way_s=lambda t: WAY_S + noise.expovariate(1.0 / 0.002),
        is_lost=lambda number: number % 20 == 7,
    )
    done = run(armed, publisher, lasts_s=5.0)
    settled_s = SETTLED_S + 0.01
    assert not [time_s for time_s in done.held_by(Limit.STALE) if time_s > settled_s]
    assert done.error_N(swell_N, 1.5) < 0.06
    ages_s = [each.plan.setpoint_age_s or 0.0 for each in done.samples if each.time_s - done.start_s > settled_s]
    assert min(ages_s) >= 0.0
    assert max(ages_s) < 0.04
    found = done.of("a")
    assert found.clock_behind_ms == pytest.approx(behind_ms, abs=4.0)
    if abs(behind_ms) > 50.0:
        assert f"{'behind' if behind_ms > 0.0 else 'ahead of'} this machine's" in found.cause
        assert "and is corrected" in found.cause
        assert "chrony" in found.remedy
    else:
        assert found.clock.drift_ppm == pytest.approx(-200.0, abs=100.0)
    assert found.lost == pytest.approx(125, abs=1)


def test_a_way_that_takes_too_long_is_stale_and_says_why(armed: ClosedLoop) -> None:
    done = run(armed, Publisher(swell_N, way_s=lambda t: WAY_S + 0.3 * (1.5 < t < 2.0)))
    stale_s = done.held_by(Limit.STALE)
    assert (stale_s[0], stale_s[-1]) == (pytest.approx(1.6, abs=0.02), pytest.approx(2.3, abs=0.05))
    assert (done.of("a").clock_steps, done.of("a").delay_us.max) == (0, pytest.approx(301e3, rel=0.03))


def test_the_whole_way_is_measured_part_by_part(armed: ClosedLoop) -> None:
    noise = random.Random(1)
    done = run(armed, Publisher(swell_N, way_s=lambda t: noise.uniform(0.08, 0.0815)), lasts_s=6.0)
    found = done.way.report(400.0, armed.planner.believe.carriages.lag_s, Budget())
    delay_us = done.of("a").delay_us
    # what arrives is read in the next tick of 1 ms, and driven in the one after
    assert 0.0 < found.to_duty_us.p50 - delay_us.p50 <= 1_000.0 + 0.04 * delay_us.p50
    assert delay_us.p50 == pytest.approx(81e3, rel=0.04)
    assert found.carriages_ms is not None
    assert found.total_ms == pytest.approx((found.to_duty_us.p99 + 400.0) * 1e-3 + found.carriages_ms, abs=0.02)
    assert found.total_ms is not None
    assert (found.total_ms < 400.0, found.budget_ms) == (True, 400.0)


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
