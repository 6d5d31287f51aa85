"""Attackers get nowhere with the daemon, and `stop` is heard beside them.

Each attack is a process of its own: a hundred clients that ask without pause; hostile messages, each a valid one with
one change that must be refused; strangers with no key, a wrong or an unlisted one, or one for something else; and 10^5
messages a second to one endpoint. Meanwhile force is held and stopped, over and over. Only the stop may latch, nothing
hostile may be taken, and what was refused or dropped must be counted.
"""

import contextlib
import math
import os
import random
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import msgspec
import zmq
from tqdm import tqdm

from judge.stand import LOOK_S, Figures, Stand
from tormagd.daemon.endpoint import SETPOINTS_PER_S
from tormagd.hardware.measurement import DeviceRequest
from tormagd_client.endpoints import Endpoints
from tormagd_client.keys import PUBLIC, SECRET, SERVER, load_pair, load_public
from tormagd_client.messages import VERSION, Reply, Request, decode, encode

CLIENTS = 100
FLOOD_PER_S, STRANGERS_PER_S = 100_000.0, 600.0
PACE = 0.95
"Share of what a publisher may send: the excess is dropped unread, and would show nothing here."
PER_BURST = 20
LIVES_S = 0.5
FORCE_N, HELD_S = 1.5, (0.2, 0.8)
PATIENCE_S = 20.0
SETPOINT: dict[str, Any] = {
    "v": 1,
    "source": "hostile",
    "seq": 7,
    "stamp_ns": time.time_ns(),
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
    "servo_cf": (*NO_NUMBERS, -0.006, -1.0, 1_001.0, 1e308),
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
HEADS = (b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc1")
"A map, an array, bytes and a text of 2^32-1, and what msgpack never means."

Attack = Callable[[Endpoints, Path, Event, Any], None]
"Runs until the event, at a daemon with keys in this folder; counts in the shared number."


def hostile(draw: random.Random, valid: dict[str, Any], not_allowed: dict[str, tuple[Any, ...]]) -> list[bytes]:
    """Return variants of one valid message that must not be taken."""
    packed = msgspec.msgpack.encode(valid)
    name, lacking = draw.choice(list(not_allowed)), draw.choice([field for field in valid if field != "args"])
    ways = (
        [b"\xc1" + draw.randbytes(draw.randrange(200))],
        [packed[: draw.randrange(len(packed))]],
        [packed + draw.randbytes(draw.randrange(1, 9))],
        [msgspec.msgpack.encode({field: value for field, value in valid.items() if field != lacking})],
        [msgspec.msgpack.encode(valid | {lacking: draw.choice(MISTYPED)})],
        [msgspec.msgpack.encode(valid | {name: draw.choice(not_allowed[name])})],
        [draw.choice((b"\x91", b"\x81\xa1v")) * draw.choice((32, 1_000, 5_000))],
        [draw.choice(HEADS) + packed],
        [packed] * draw.randrange(2, 6),
    )
    return draw.choice(ways)


def paced(per_s: float, stop: Event) -> Iterator[int]:
    start_s, number = time.monotonic(), 0
    while not stop.is_set():
        yield number
        number += 1
        if number % PER_BURST == 0:
            time.sleep(max(0.0, start_s + number / per_s - time.monotonic()))


def busy_clients(endpoints: Endpoints, _keys: Path, stop: Event, times: Any) -> None:
    request = encode(Request(v=VERSION, id=0, command="status"))
    with zmq.Context() as context:
        clients = [_peer(context, zmq.DEALER, endpoints.control) for _ in range(CLIENTS)]
        for client in clients:
            client.send(request)
        while not stop.is_set():
            for client in clients:
                client.recv()
                client.send(request)
                times.value += 1
        context.destroy(linger=0)


def flood(name: str, endpoints: Endpoints, _keys: Path, stop: Event, times: Any) -> None:
    kind, data = {
        "setpoint": (zmq.PUB, [msgspec.msgpack.encode(SETPOINT), os.urandom(100)]),
        "control": (zmq.DEALER, [encode(Request(v=VERSION, id=0, command="status"))]),
        "recording": (zmq.XSUB, [sign + os.urandom(16) for sign in (b"\x01", b"\x00")]),
    }[name]
    with zmq.Context() as context:
        peer = _peer(context, kind, getattr(endpoints, name))
        for number in paced(FLOOD_PER_S, stop):
            with contextlib.suppress(zmq.Again):
                peer.send(data[number % len(data)], zmq.NOBLOCK)
            times.value = number + 1
        context.destroy(linger=0)


def messages(endpoints: Endpoints, _keys: Path, stop: Event, times: Any) -> None:
    draw = random.Random(1)
    with zmq.Context() as context:
        publisher = _peer(context, zmq.XPUB, endpoints.setpoint)
        publisher.recv()  # the daemon listens
        client = _peer(context, zmq.DEALER, endpoints.control)
        for number in paced(PACE * SETPOINTS_PER_S, stop):
            publisher.send_multipart(hostile(draw, SETPOINT, NO_SETPOINT))
            if number % PER_BURST == 0:
                client.send_multipart(hostile(draw, REQUEST, NO_REQUEST))
                if not client.poll(round(PATIENCE_S * 1e3)) or decode(client.recv(), Reply).ok:
                    raise RuntimeError("a hostile request was carried out, or not answered")
            times.value = number + 1
        context.destroy(linger=0)


def strangers(endpoints: Endpoints, keys: Path, stop: Event, times: Any) -> None:
    server, publisher = load_public(keys / f"{SERVER}{PUBLIC}"), load_pair(keys / f"publish{SECRET}")
    with zmq.Context() as context:
        alive: list[tuple[float, zmq.Socket[bytes]]] = []
        for number in paced(STRANGERS_PER_S, stop):
            kind = number % 4
            pair = publisher if kind == 3 else zmq.curve_keypair()
            shown = (*pair, zmq.curve_keypair()[0] if kind == 1 else server) if kind else ()
            peer = _peer(context, zmq.SUB, endpoints.telemetry, shown)
            alive.append((time.monotonic(), peer))
            while alive[0][0] < time.monotonic() - LIVES_S:
                alive.pop(0)[1].close()
            times.value = number + 1
        context.destroy(linger=0)


def _peer(context: "zmq.Context[Any]", kind: int, address: str, keys: tuple[bytes, ...] = ()) -> "zmq.Socket[bytes]":
    peer: zmq.Socket[bytes] = context.socket(kind)
    peer.linger = 0
    if keys:
        peer.curve_publickey, peer.curve_secretkey, peer.curve_serverkey = keys
    peer.connect(address)
    return peer


ATTACKS: dict[str, Attack] = {
    "clients": busy_clients,
    "messages": messages,
    "strangers": strangers,
    "flood of setpoint": partial(flood, "setpoint"),
    "flood of control": partial(flood, "control"),
    "flood of recording": partial(flood, "recording"),
}


def run(stand: Stand, count: int, seed: int) -> Figures:
    draw, spawn = random.Random(seed), get_context("spawn")
    failures: list[str] = []
    figures: Figures = {}
    for name, attack in ATTACKS.items():
        stop, times = spawn.Event(), spawn.Value("Q", 0)
        attacker = spawn.Process(target=attack, args=(stand.endpoints, stand.keys, stop, times), daemon=True)
        attacker.start()
        stand.until(lambda _status, times=times: times.value > 0, f"{name} has begun")  # type: ignore[misc]
        took_ms = sorted(_stop(stand, draw) for _ in tqdm(range(count), desc=name, unit="stop", disable=None))
        status = stand.status()
        stop.set()
        attacker.join(PATIENCE_S)
        figures[name] = {"times": times.value, "retract_ms": [round(took_ms[i], 2) for i in (count // 2, -1)]}
        failures += [f"{name}: {what}" for what in judged(name, times.value, took_ms, status, attacker.exitcode)]
    return figures | {"failures": failures}


def judged(name: str, times: int, took_ms: Sequence[float], status: dict[str, Any], code: int | None) -> list[str]:
    drops = {drop["endpoint"] for drop in status["peers"]["drops"]}
    refused = {"messages": status["setpoints"]["refused"], "strangers": status["peers"]["refused"]}.get(name, 1)
    checks = {
        f"ended with {code} after {times} times": code == 0 and times > 0,
        "a stop was not heard": max(took_ms) < math.inf,
        "taken for a source": SETPOINT["source"] not in status["setpoints"]["sources"] or name.startswith("flood"),
        "not counted as refused": refused > 0,
        "its source is not named": not name.startswith("flood") or name.removeprefix("flood of ") in drops,
    }
    return [what for what, is_so in checks.items() if not is_so]


def _stop(stand: Stand, draw: random.Random) -> float:
    stand.arm()
    since_s = time.monotonic()
    stand.ask(FORCE_N)
    time.sleep(draw.uniform(*HELD_S))
    stand.see_faults(since_s)
    with stand.ticks() as read:
        until_s = time.monotonic() + PATIENCE_S
        while not read() and time.monotonic() < until_s:  # the daemon takes its time for who subscribes
            time.sleep(LOOK_S)
        sent_s = time.monotonic()
        stand.client.request("stop")
        told: list[float] = []
        while not told and time.monotonic() < sent_s + PATIENCE_S:
            asked = [tick for tick in read() if tick["request"] == DeviceRequest.RETRACT]
            told = [tick["monotonic_s"] + tick["exec_us"] * 1e-6 for tick in asked if tick["monotonic_s"] > sent_s]
    return 1e3 * (min(told, default=math.inf) - sent_s)
