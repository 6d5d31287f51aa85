"""A million messages that nobody may take: cut, mistyped, out of range, too deep, too large, over all endpoints.

None of them becomes valid by chance: each is a valid message with one thing done to it that has to be refused. Every
setpoint has to be counted as refused, and every request has to be answered with an error. They come as fast as the
daemon reads them: what goes beyond is dropped unread (`floods`), and would show nothing here.
"""

import math
import random
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import msgpack
import zmq
from tqdm import tqdm

from intrusion.besieged import FAULT, Besieged, Line, besieged, stand
from tormagd.config import Endpoints
from tormagd.daemon.endpoint import SETPOINTS_PER_S
from tormagd_client.messages import MAX_MESSAGE_BYTES, Reply, decode

SETPOINTS, REQUESTS, SUBSCRIPTIONS = 800_000, 100_000, 50_000
"On `setpoint`, on `control`, on each of `telemetry` and `recording`."
PUBLISHERS = 2
PACE = 0.95
"Of what a publisher may send."
CLIENTS, AT_ONCE = 4, 16
"Connections to `control`, and unanswered requests of each."
SUBSCRIPTIONS_PER_S = 1_000.0
OVERSIZE = 100
OVERSIZE_S = 0.2
"Between two of these: libzmq cuts off whoever sends one, who comes back after a while."
PATIENCE_S = 20.0
"Until what was sent has been read, or a request is answered."
PER_BURST = 20
LOOK_S = 0.5

Message = list[bytes]
"The parts of one."

SETPOINT: dict[str, Any] = {
    "v": 1,
    "source": "hostile",
    "seq": 7,
    "stamp_ns": 1_800_000_000_000_000_000,
    "servo_cf": 1.0,
    "valid_for_ms": 50.0,
}
REQUEST: dict[str, Any] = {"v": 1, "id": 1, "command": "stop", "args": {}}
NO_NUMBERS = (math.nan, math.inf, -math.inf)
NO_SETPOINT: dict[str, tuple[Any, ...]] = {
    "v": (0, 2, -1, 2**63),
    "source": ("", "x" * 65, "\x1b[2J", "a\nb", "\u202e"),
    "seq": (-1, 2**63, 2**64 - 1, 1.5),
    "stamp_ns": (-1, 2**63, 2**64 - 1),
    "servo_cf": (*NO_NUMBERS, -1e-9, -1.0, 1_001.0, 1e308),
    "valid_for_ms": (*NO_NUMBERS, 0.0, -1.0, 60_001.0),
    "displacement_mm": (*NO_NUMBERS, -0.1, 2.1),
    "rate_mm_s": (*NO_NUMBERS, -301.0, 301.0),
    "preview_N": ([1.0], [math.nan], [-1.0], [1.0] * 300, "x"),
    "session": (-1, 2**63),
}
NO_REQUEST: dict[str, tuple[Any, ...]] = {
    "v": (0, 2, -1),
    "id": (1.5, [1], {}),
    "command": ("", "stop ", "STOP", "x" * 65, "enable\x00", "\x1b[2Jstop"),
    "args": ([], "stop", 1),
}
MISTYPED: tuple[Any, ...] = (None, [], [[]], {"v": 1}, True)
DEPTHS = (32, 1_000, 5_000)
HEADS = (b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc1")
"A map, an array, bytes and a text of 2^32-1, and what msgpack never means."


class Asked(NamedTuple):
    """Requests that were sent and answered, and how many of them were carried out."""

    sent: int
    answered: int
    done: int


class Pace:
    """Waits so that there are so many a second on average."""

    def __init__(self, per_s: float) -> None:
        self._per_s, self._start_s, self._count = per_s, time.monotonic(), 0

    def wait(self) -> None:
        """After each of them."""
        self._count += 1
        if self._count % PER_BURST == 0:
            time.sleep(max(0.0, self._start_s + self._count / self._per_s - time.monotonic()))


def hostile(random_: random.Random, valid: dict[str, Any], not_allowed: dict[str, tuple[Any, ...]]) -> Message:
    """One message that must not be taken, made of a valid one."""
    packed: bytes = msgpack.packb(valid)
    name, depth = random_.choice(list(not_allowed)), random_.choice(DEPTHS)
    lacking = random_.choice([field for field in valid if field != "args"])
    kinds: tuple[Callable[[], Message], ...] = (
        lambda: [b"\xc1" + random_.randbytes(random_.randrange(200))],
        lambda: [packed[: random_.randrange(len(packed))]],
        lambda: [packed + random_.randbytes(random_.randrange(1, 9))],
        lambda: [_packed({field: value for field, value in valid.items() if field != lacking})],
        lambda: [_packed(valid | {lacking: random_.choice(MISTYPED)})],
        lambda: [_packed(valid | {name: random_.choice(not_allowed[name])})],
        lambda: [random_.choice((b"\x91", b"\x81\xa1v")) * depth],
        lambda: [random_.choice(HEADS) + packed],
        lambda: [packed] * random_.randrange(2, 6),
    )
    return random_.choice(kinds)()


def _packed(fields: dict[str, Any]) -> bytes:
    data: bytes = msgpack.packb(fields)
    return data


def publish(endpoints: Endpoints, count: int, seed: int) -> None:
    """Hostile setpoints, at a pace at which all of them are read."""
    random_ = random.Random(seed)
    with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
        publisher.linger, publisher.sndhwm = round(PATIENCE_S * 1e3), 0
        publisher.connect(endpoints.setpoint)
        publisher.recv()  # the daemon listens
        pace = Pace(PACE * SETPOINTS_PER_S)
        for _ in range(count):
            publisher.send_multipart(hostile(random_, SETPOINT, NO_SETPOINT))
            pace.wait()


def publish_oversize(endpoints: Endpoints, count: int) -> None:
    """Setpoints that libzmq does not deliver."""
    with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
        publisher.linger = 0
        publisher.connect(endpoints.setpoint)
        for _ in range(count):
            publisher.send(bytes(MAX_MESSAGE_BYTES + 1))
            time.sleep(OVERSIZE_S)


def request(endpoints: Endpoints, count: int, seed: int) -> Asked:
    """Hostile requests of several clients, each of which has some unanswered at a time."""
    random_ = random.Random(seed)
    answered = done = 0
    with zmq.Context() as context:
        poller = zmq.Poller()
        for _ in range(CLIENTS):
            client = context.socket(zmq.DEALER)
            client.linger = 0
            client.connect(endpoints.control)
            poller.register(client, zmq.POLLIN)
            for _ in range(AT_ONCE):
                client.send_multipart(hostile(random_, REQUEST, NO_REQUEST))
        sent = CLIENTS * AT_ONCE
        while answered < sent and (ready := poller.poll(round(PATIENCE_S * 1e3))):
            for client, _ in ready:
                done += decode(client.recv(), Reply).ok
                answered += 1
                if sent < count:
                    client.send_multipart(hostile(random_, REQUEST, NO_REQUEST))
                    sent += 1
        context.destroy(linger=0)
    return Asked(sent, answered, done)


def subscribe(address: str, count: int, seed: int) -> None:
    """What a subscriber may not say, or nobody would: no subscriptions, and those to random topics."""
    random_ = random.Random(seed)
    with zmq.Context() as context, context.socket(zmq.XSUB) as subscriber:
        subscriber.linger = 0
        subscriber.connect(address)
        pace = Pace(SUBSCRIPTIONS_PER_S)
        for _ in range(count):
            subscriber.send(random_.choice((b"", b"\x00", b"\x01")) + random_.randbytes(random_.randrange(300)))
            pace.wait()


def measure(share: float) -> Line:
    """All endpoints at once. `share` of the messages."""
    setpoints, requests, subscriptions, oversize = (
        max(100, round(count * share)) for count in (SETPOINTS, REQUESTS, SUBSCRIPTIONS, OVERSIZE)
    )
    each = setpoints // PUBLISHERS
    with besieged(stand()) as daemon, ProcessPoolExecutor(PUBLISHERS + 4, mp_context=get_context("spawn")) as outside:
        endpoints = daemon.config.endpoints
        asking = outside.submit(request, endpoints, requests, 0)
        sending = [outside.submit(publish, endpoints, each, seed) for seed in range(1, PUBLISHERS + 1)]
        sending += [
            outside.submit(subscribe, address, subscriptions, seed)
            for seed, address in enumerate((endpoints.telemetry, endpoints.recording))
        ]
        sending.append(outside.submit(publish_oversize, endpoints, oversize))
        with tqdm(total=each * PUBLISHERS, desc="hostile setpoints", unit="message", disable=None) as progress:
            while not (asking.done() and all(each.done() for each in sending)):
                time.sleep(LOOK_S)
                progress.update(_read(daemon) - progress.n)
        for one in sending:
            one.result()
        until_s = time.monotonic() + PATIENCE_S
        while _read(daemon) < each * PUBLISHERS and time.monotonic() < until_s:
            time.sleep(LOOK_S)
        status, troubles = daemon.status(), daemon.troubles()
    return judged(each * PUBLISHERS, asking.result(), 2 * subscriptions, status, troubles)


def _read(daemon: Besieged) -> int:
    """How many setpoints the daemon has refused, or dropped unread because there were too many."""
    status = daemon.status()
    unread = sum(drop["count"] for drop in status["peers"]["drops"] if drop["endpoint"] == "setpoint")
    return int(status["setpoints"]["refused"]) + int(unread)


def judged(setpoints: int, asked: Asked, subscriptions: int, status: dict[str, Any], troubles: list[str]) -> Line:
    """The line's figures and what did not hold; `status` is the daemon's at the end."""
    found, failures = status["setpoints"], list(troubles)
    unread = sum(drop["count"] for drop in status["peers"]["drops"] if drop["endpoint"] == "setpoint")
    sources = [name for name in found["sources"] if name == SETPOINT["source"]]
    counted = found["refused"] + unread
    accepted = asked.done + len(sources)
    messages = setpoints + asked.sent + subscriptions
    if accepted:
        failures.append(f"{asked.done} requests were carried out, and {len(sources)} sources taken for one")
    if counted != setpoints:
        failures.append(f"{counted} of {setpoints} setpoints were refused or dropped")
    if asked.answered != asked.sent:
        failures.append(f"{asked.answered} of {asked.sent} requests were answered")
    # a fault has been told of already
    if status["operating_state"] != "ENABLED" and not any(trouble.startswith(FAULT) for trouble in troubles):
        failures.append(f"the device was {status['operating_state']} at the end")
    figures = {
        "messages": messages,
        "accepted": accepted,
        "setpoints": setpoints,
        "setpoints_refused": found["refused"],
        "setpoints_dropped_unread": unread,
        "oversize_counted": found["oversize"],
        "requests": asked._asdict(),
        "subscriptions": subscriptions,
    }
    says = (
        f"{messages:,} hostile messages over all endpoints: {accepted} accepted (allowed 0), "
        f"{setpoints - counted + asked.sent - asked.answered} neither refused, answered nor counted (allowed 0), "
        f"the device {status['operating_state']} to the end"
    )
    return Line(says, failures, figures)
