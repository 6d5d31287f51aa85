"""How a publisher's setpoints come, through a network of stated delays and losses: the cause within two seconds."""

import random
from collections.abc import Callable

import msgpack
import pytest

from tormagd.control.records import TimedSetpoint
from tormagd.daemon.inbox import SetpointInbox
from tormagd.daemon.source_manner import Needs
from tormagd.safety.codes import Limit

START_NS = 1_800_000_000_000_000_000
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


def heard(rate_hz: float, delay: Delay, lost: float, seed: int, lasts_s: float = 2.1) -> SetpointInbox:
    """An inbox after two seconds of it; one connection's messages do not overtake each other."""
    inbox, noise, arrives_s = SetpointInbox(), random.Random(seed), 0.0
    inbox._needs = NEEDS
    for number in range(round(lasts_s * rate_hz)):
        sent_s = number / rate_hz
        arrives_s = max(arrives_s, sent_s + delay(noise))
        message = {"v": 1, "source": "a", "seq": number, "stamp_ns": START_NS + round(sent_s * 1e9), "servo_cf": 1.0}
        if noise.random() >= lost:
            inbox.take(msgpack.packb(message | {"valid_for_ms": 1_000.0}), arrives_s, START_NS + round(arrives_s * 1e9))
    return inbox


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rate_hz", "delay", "lost", "limits"), CASES)
def test_the_cause_is_named_within_two_seconds(
    rate_hz: float, delay: Delay, lost: float, limits: tuple[Limit, ...], seed: int
) -> None:
    inbox = heard(rate_hz, delay, lost, seed)
    newest = inbox.newest
    assert isinstance(newest, TimedSetpoint)
    assert set(newest.limits) == set(limits)
    told = inbox.told(2.1)
    assert all(told[limit].cause and told[limit].remedy for limit in limits)


def test_what_is_over_is_not_told_any_more() -> None:
    inbox = heard(500.0, lambda noise: 0.02 + noise.uniform(0.0, 0.03) * (noise.random() < 0.5), 0.0, 1)
    assert inbox.newest is not None
    assert inbox.newest.limits == (Limit.SOURCE_JITTER,)
    for number in range(2_000, 3_100):
        sent_s = number / 500.0
        message = {"v": 1, "source": "a", "seq": number, "stamp_ns": START_NS + round(sent_s * 1e9), "servo_cf": 1.0}
        inbox.take(msgpack.packb(message | {"valid_for_ms": 1_000.0}), sent_s + 0.03, START_NS + round(sent_s * 1e9))
    assert inbox.newest.limits == ()
