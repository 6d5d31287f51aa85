"""Whatever publishers send, with clocks and ways of their own, to one brake: inbox, core and device in virtual time."""

import contextlib
import math
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.config import Sources
from tormagd.control.assembly.build import Core
from tormagd.control.safety.operating_state import OperatingState, RefusedError
from tormagd.daemon.inbox import SetpointInbox
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.hand import ReversingHand, SteadyHand

REALTIME_NS = 1_800_000_000 * 10**9
PERIOD_S = 0.002


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
