"""How a publisher's setpoints come, through a network of stated delays and losses: the cause within two seconds."""

import random
from collections.abc import Callable

import msgpack
import pytest

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


@pytest.fixture
def inbox() -> SetpointInbox:
    made = SetpointInbox()
    made._needs = NEEDS
    return made


def hear(
    inbox: SetpointInbox, rate_hz: float, delay: Delay, lost: float, seed: int, from_s: float = 0.0, to_s: float = 2.1
) -> None:
    """All that is sent from one time to the other; one connection's messages do not overtake each other."""
    noise, arrives_s = random.Random(seed), 0.0
    for number in range(round(from_s * rate_hz), round(to_s * rate_hz)):
        sent_s = number / rate_hz
        arrives_s = max(arrives_s, sent_s + delay(noise))
        message = {"v": 1, "source": "a", "seq": number, "stamp_ns": START_NS + round(sent_s * 1e9), "servo_cf": 1.0}
        if noise.random() >= lost:
            inbox.take(msgpack.packb(message | {"valid_for_ms": 1_000.0}), arrives_s, START_NS + round(arrives_s * 1e9))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rate_hz", "delay", "lost", "limits"), CASES)
def test_the_cause_is_named_within_two_seconds(
    inbox: SetpointInbox, rate_hz: float, delay: Delay, lost: float, limits: tuple[Limit, ...], seed: int
) -> None:
    hear(inbox, rate_hz, delay, lost, seed)
    assert set(inbox.newest.limits) == set(limits)
    told = inbox.told(2.1)
    assert all(told[limit].cause and told[limit].remedy for limit in limits)


def test_what_is_over_is_not_told_any_more(inbox: SetpointInbox) -> None:
    hear(inbox, 500.0, lambda noise: 0.02 + noise.uniform(0.0, 0.03) * (noise.random() < 0.5), 0.0, 1)
    assert inbox.newest.limits == (Limit.SOURCE_JITTER,)
    hear(inbox, 500.0, steady(0.03), 0.0, 1, 4.0, 6.2)
    assert inbox.newest.limits == ()
