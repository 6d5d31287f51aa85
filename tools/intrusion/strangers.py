"""Peers that are not let in: plain, with another server's key, with a key that is not listed, or not for this endpoint.

Each try is a ZeroMQ socket of its own that connects to an endpoint of the daemon in turn, through a relay that keeps
what the daemon says to it. They come in rounds: in each there is a while without anybody, then as many knock at a door
next to the daemon's, then at the daemon's. A kind's lateness of control is held against that of its whiles without
anybody; that of those next door says how much of it a machine so busy does by itself. Of each the median of the 99th
percentiles counts, because a round in which the machine itself was slow says nothing about strangers.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import uvloop
import zmq
from benchmarks.keys import OBSERVER, PUBLISHER
from benchmarks.loop import WARM_UP_S, Array
from tqdm import trange

from intrusion.besieged import Besieged, Line, besieged, p99_us, stand
from intrusion.next_door import next_door
from tormagd.config import ENDPOINTS
from tormagd_client.keys import PUBLIC, SECRET, SERVER, KeyPair, load_pair, load_public

TRIES = 10_000
LEAST_PER_S, PER_S = 500.0, 600.0
ROUNDS = 10
UNDISTURBED_S = 2.0
"Before each round."
MOST_RATIO, MOST_MORE_US = 1.3, 20.0
LIVES_S = 0.5
"A try is given up after this time, where the daemon has not ended it before."
COUNTED_S = 5.0
GREETING_BYTES = 64
LONG, COMMAND = 2, 4
"Flags of a ZMTP frame (RFC 37)."
OF_MECHANISM = (b"\x07WELCOME", b"\x05ERROR")
"What CURVE says to a peer that it has not let in (RFC 26)."
SOCKETS = {"setpoint": zmq.PUB, "control": zmq.DEALER, "telemetry": zmq.SUB, "recording": zmq.SUB}


class Keys(NamedTuple):
    """What a stranger shows, and the daemon that it believes; None where it shows nothing."""

    pair: KeyPair
    server: bytes


Shows = Callable[[Path, str], Keys | None]
"""What is shown at an endpoint, given the folder of the daemon's keys."""


_pair, _public = cache(load_pair), cache(load_public)


def _plain(folder: Path, endpoint: str) -> Keys | None:
    return None


def _wrong_key(folder: Path, endpoint: str) -> Keys:
    return Keys(KeyPair(*zmq.curve_keypair()), zmq.curve_keypair()[0])


def _unlisted(folder: Path, endpoint: str) -> Keys:
    return Keys(KeyPair(*zmq.curve_keypair()), _public(folder / f"{SERVER}{PUBLIC}"))


def _wrong_role(folder: Path, endpoint: str) -> Keys:
    name = OBSERVER if endpoint == "setpoint" else PUBLISHER
    return Keys(_pair(folder / f"{name}{SECRET}"), _public(folder / f"{SERVER}{PUBLIC}"))


KINDS: dict[str, Shows] = {"plain": _plain, "wrong key": _wrong_key, "unlisted": _unlisted, "wrong role": _wrong_role}


class Heard(NamedTuple):
    """What a round of strangers heard in all its tries."""

    tries: int
    seconds: float
    most_bytes: int
    beyond: int
    "Tries in which the daemon said more than ZMTP's greeting and its mechanism."


class Round(NamedTuple):
    """How late control was, 99th percentiles in us."""

    without_us: float
    "While nobody knocked,"
    next_door_us: float
    "while strangers did next door,"
    at_the_daemon_us: float
    "and here."


class _Half(asyncio.Protocol):
    """One end of a relayed connection: keeps what it hears, and passes it on."""

    def __init__(self) -> None:
        self.heard = b""
        self.transport: asyncio.Transport | None = None
        self.other: _Half | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # a stream's always is one
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.heard += data
        if self.other is not None and self.other.transport is not None:
            self.other.transport.write(data)

    def connection_lost(self, _error: Exception | None) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.close()


class Relay:
    """A way to one port of this machine; `said` has what was heard from there, an entry for each connection."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._ends: list[_Half] = []
        self._connecting: set[asyncio.Task[None]] = set()

    async def open(self) -> str:
        """The address of its near end."""
        server = await asyncio.get_running_loop().create_server(self._near, "127.0.0.1", 0)
        return f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"

    def said(self) -> list[bytes]:
        """What was heard from the far end."""
        return [end.heard for end in self._ends]

    def _near(self) -> _Half:
        near = _Half()
        joining = asyncio.get_running_loop().create_task(self._join(near))
        self._connecting.add(joining)
        joining.add_done_callback(self._connecting.discard)
        return near

    async def _join(self, near: _Half) -> None:
        far = _Half()
        far.other = near
        await asyncio.get_running_loop().create_connection(lambda: far, self._host, self._port)
        assert far.transport is not None
        self._ends.append(far)  # one that did not get through has not been at the daemon
        far.transport.write(near.heard)  # what came meanwhile
        near.other = far
        if near.transport is not None and near.transport.is_closing():
            far.transport.close()


def beyond_mechanism(said: bytes) -> bytes:
    """What somebody was told after ZMTP's greeting and the mechanism's own commands; empty where there was nothing."""
    rest = said[GREETING_BYTES:]
    while rest:
        flags, head = rest[0], 9 if rest[0] & LONG else 2
        size = int.from_bytes(rest[1:head], "big")
        if not flags & COMMAND or not rest[head:].startswith(OF_MECHANISM):
            return rest
        rest = rest[head + size :]
    return b""


def knock(kind: str, folder: Path, addresses: dict[str, str], tries: int) -> Heard:
    """Tries of one kind, at the daemon's endpoints in turn."""
    return uvloop.run(_knock(kind, folder, addresses, tries))


async def _knock(kind: str, folder: Path, addresses: dict[str, str], tries: int) -> Heard:
    relays = {}
    for name, address in addresses.items():
        host, port = address.removeprefix("tcp://").split(":")
        relays[name] = Relay(host, int(port))
    near = {name: await relay.open() for name, relay in relays.items()}
    alive: deque[tuple[float, zmq.Socket[bytes]]] = deque()
    start_s = time.monotonic()
    with zmq.Context() as context:
        for number in range(tries):
            name = ENDPOINTS[number % len(ENDPOINTS)]
            alive.append((time.monotonic(), _stranger(context, name, near[name], KINDS[kind](folder, name))))
            while alive[0][0] < time.monotonic() - LIVES_S:
                alive.popleft()[1].close()
            await asyncio.sleep(max(0.0, start_s + (number + 1) / PER_S - time.monotonic()))
        seconds = time.monotonic() - start_s
        await asyncio.sleep(LIVES_S)
        context.destroy(linger=0)
    await asyncio.sleep(LIVES_S)
    said = [each for relay in relays.values() for each in relay.said()]
    return Heard(len(said), seconds, max(map(len, said)), sum(bool(beyond_mechanism(each)) for each in said))


def _stranger(context: "zmq.Context[Any]", endpoint: str, address: str, keys: Keys | None) -> "zmq.Socket[bytes]":
    peer: zmq.Socket[bytes] = context.socket(SOCKETS[endpoint])
    peer.linger, peer.reconnect_ivl = 0, -1  # each is one try
    if keys is not None:
        peer.curve_publickey, peer.curve_secretkey = keys.pair
        peer.curve_serverkey = keys.server
    if SOCKETS[endpoint] == zmq.SUB:
        peer.subscribe(b"")
    peer.connect(address)
    if SOCKETS[endpoint] != zmq.SUB:
        with contextlib.suppress(zmq.Again):
            peer.send(b"anything", zmq.NOBLOCK)
    return peer


def measure(share: float) -> Line:
    """All kinds one after the other. `share` of the tries."""
    tries = max(len(ENDPOINTS), round(TRIES * share / ROUNDS))
    figures: dict[str, Any] = {}
    with (
        besieged(stand(guarded=ENDPOINTS)) as daemon,
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as outside,
        next_door(daemon.config.endpoints) as beside,
    ):
        addresses = {name: getattr(daemon.config.endpoints, name) for name in ENDPOINTS}
        daemon.lateness_us(WARM_UP_S)
        for kind in KINDS:
            refused = daemon.status()["peers"]["refused"]
            heard: list[Heard] = []
            rounds: list[Round] = []
            for _ in trange(ROUNDS, desc=kind, unit="round", disable=None):
                without_us = p99_us(daemon.lateness_us(max(0.5, UNDISTURBED_S * share)))
                late_us = []
                for doors in (beside, addresses):
                    knocking = outside.submit(knock, kind, daemon.folder / "keys", doors, tries)
                    late_us.append(p99_us(_until(knocking, daemon)))
                heard.append(knocking.result())
                rounds.append(Round(without_us, *late_us))
            counted = _counted(daemon, refused, sum(each.tries for each in heard))
            figures[kind] = _of_kind(heard, rounds) | {"counted": counted}
        troubles = daemon.troubles()
    return judged(figures, troubles)


def _of_kind(heard: list[Heard], rounds: list[Round]) -> dict[str, Any]:
    """A kind's figures."""
    tries = sum(each.tries for each in heard)
    without_us, next_door_us, late_us = zip(*rounds, strict=True)
    return {
        "tries": tries,
        "per_s": round(tries / sum(each.seconds for each in heard), 1),
        "most_bytes": max(each.most_bytes for each in heard),
        "beyond": sum(each.beyond for each in heard),
        "without_p99_us": median(without_us),
        "next_door_p99_us": median(next_door_us),
        "late_p99_us": median(late_us),
        "rounds_p99_us": rounds,
    }


def _until(knocking: "Future[Heard]", daemon: Besieged) -> Array:
    late = []
    while not knocking.done():
        late.append(daemon.lateness_us(0.5))
    return np.concatenate(late)


def _counted(daemon: Besieged, before: int, expected: int) -> int:
    """How many more were refused, once that does not change any more."""
    until_s = time.monotonic() + COUNTED_S
    while (counted := int(daemon.status()["peers"]["refused"]) - before) < expected and time.monotonic() < until_s:
        time.sleep(0.1)
    return counted


def judged(figures: dict[str, Any], troubles: list[str]) -> Line:
    """The line's figures and what did not hold."""
    failures = list(troubles)
    for kind, found in figures.items():
        found["allowed_p99_us"] = round(MOST_RATIO * found["without_p99_us"] + MOST_MORE_US, 1)
        if found["beyond"]:
            failures.append(f"{kind}: {found['beyond']} were told more than ZMTP's greeting and mechanism")
        if found["counted"] != found["tries"]:
            failures.append(f"{kind}: {found['counted']} of {found['tries']} counted")
        if found["per_s"] < LEAST_PER_S:
            failures.append(f"{kind}: only {found['per_s']:g} tries a second, {LEAST_PER_S:g} are needed")
        if found["late_p99_us"] > found["allowed_p99_us"]:
            failures.append(
                f"{kind}: control late by {found['late_p99_us']:g} us (p99), allowed {found['allowed_p99_us']:g}"
            )
    tries, counted = (sum(found[name] for found in figures.values()) for name in ("tries", "counted"))
    late = "; ".join(
        f"{kind} {found['late_p99_us']:.0f} us, {found['without_p99_us']:.0f} without (allowed "
        f"{found['allowed_p99_us']:.0f}), {found['next_door_p99_us']:.0f} with them next door"
        for kind, found in figures.items()
    )
    says = (
        f"{tries:,} strangers over tcp at {min(found['per_s'] for found in figures.values()):.0f} a second: "
        f"{sum(found['beyond'] for found in figures.values())} heard more than greeting and mechanism (allowed 0), "
        f"{counted:,} counted (all); control late (p99): {late}"
    )
    return Line(says, failures, {"kinds": figures})
