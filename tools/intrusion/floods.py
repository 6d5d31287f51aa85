"""Floods: one local process sends 10^5 messages a second to one endpoint of the daemon, valid ones and garbage.

Telemetry and recording take nothing but subscriptions, so there the flood is of those, each on and off again. What
counts is the control rate beside that of a bare timer that has the same sockets and bears the same flood, one right
after the other: the processors that sender and libzmq take are missing to both.
"""

import contextlib
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import zmq
from benchmarks.loop import WARM_UP_S, Block, as_block, collect, recording, stub_process
from tqdm import tqdm

from intrusion.besieged import Line, besieged, elsewhere, stand
from tormagd.config import ENDPOINTS, Endpoints
from tormagd_client.messages import VERSION, Request, Setpoint, encode

PER_S = 100_000
LEAST_PER_S = 99_000
BURST_S = 0.001
SECONDS = 10.0
MOST_LESS = 0.01
"Of the bare timer's rate."
SOCKETS = {"setpoint": zmq.PUB, "control": zmq.DEALER, "telemetry": zmq.XSUB, "recording": zmq.XSUB}
SOURCE = "flood"
PATIENCE_S = 60.0


class Flooded(NamedTuple):
    """What became of the daemon beside one flood, and of the bare timer beside the same."""

    daemon: Block
    bare: Block
    per_s: float
    "Messages that were handed to ZeroMQ, or that it did not take any more: the lesser of both floods."
    named: bool
    "Whether `status` names the process and the endpoint."
    troubles: list[str]
    late_ticks_by: Mapping[str, int] = MappingProxyType({})
    "What ran into how many of the daemon's ticks."


def messages(name: str) -> list[bytes]:
    """What is sent to an endpoint, over and over."""
    if name == "setpoint":
        force = {"v": VERSION, "source": SOURCE, "stamp_ns": time.time_ns(), "servo_cf": 1.0, "valid_for_ms": 50.0}
        return [encode(Setpoint(seq=seq, **force)) if seq % 2 else os.urandom(100) for seq in range(1_000)]  # type: ignore[arg-type]
    if name == "control":
        return [encode(Request(v=VERSION, id=number, command="status")) for number in range(1_000)]
    topics = [os.urandom(16) for _ in range(500)]
    return [sign + topic for topic in topics for sign in (b"\x01", b"\x00")]


def flood(name: str, endpoints: Endpoints, begun: Event, stop: Event, per_s: Any) -> None:
    """Sends until `stop`; `per_s`, a shared number, becomes how many a second."""
    data, burst = messages(name), round(PER_S * BURST_S)
    with zmq.Context() as context, context.socket(SOCKETS[name]) as socket:
        socket.linger = 0
        socket.connect(getattr(endpoints, name))
        start_s, sent = time.monotonic(), 0
        begun.set()
        while not stop.is_set():
            for number in range(sent, sent + burst):
                with contextlib.suppress(zmq.Again):
                    socket.send(data[number % len(data)], zmq.NOBLOCK)
            sent += burst
            time.sleep(max(0.0, start_s + sent / PER_S - time.monotonic()))
        per_s.value = sent / (time.monotonic() - start_s)


@contextlib.contextmanager
def flooding(name: str, endpoints: Endpoints) -> Iterator[tuple[int | None, Any]]:
    """A process that floods this endpoint: its id, and its rate once it has ended. Raises TimeoutError."""
    outside = multiprocessing.get_context("spawn")
    begun, stop, per_s = outside.Event(), outside.Event(), outside.Value("d", 0.0)
    sender = outside.Process(target=flood, args=(name, endpoints, begun, stop, per_s), daemon=True)
    sender.start()
    try:
        if not begun.wait(PATIENCE_S):
            raise TimeoutError(f"the flood did not begin within {PATIENCE_S:g} s")
        yield sender.pid, per_s
    finally:
        stop.set()
        sender.join(PATIENCE_S)


def flooded(name: str, seconds: float) -> Flooded:
    """The daemon beside a flood of this endpoint, then the bare timer beside the same."""
    with besieged(stand()) as daemon:
        with flooding(name, daemon.config.endpoints) as (pid, first_per_s):
            collect(daemon.recorder, WARM_UP_S)
            block = as_block(collect(daemon.recorder, seconds), daemon.config.rates.control_hz)
            status = daemon.status()
        troubles = daemon.troubles()
    with (
        tempfile.TemporaryDirectory(prefix="tormag-") as folder,
        partial(stub_process, stand().realtime)(Path(folder)) as stub,
        elsewhere(),
        recording(stub.config.endpoints) as recorder,
        flooding(name, stub.config.endpoints) as (_, second_per_s),
    ):
        collect(recorder, WARM_UP_S)
        bare = as_block(collect(recorder, seconds), stub.config.rates.control_hz)
    named = any(each["endpoint"] == name and f"process {pid} " in each["address"] for each in status["peers"]["drops"])
    per_s = min(first_per_s.value, second_per_s.value)
    return Flooded(block, bare, per_s, named, troubles, status["late_ticks_by"])


def measure(share: float) -> Line:
    """Every endpoint's flood. `share` of the time."""
    seconds = max(2.0, SECONDS * share)
    return judged({name: flooded(name, seconds) for name in tqdm(ENDPOINTS, desc="floods", unit="flood", disable=None)})


def judged(floods: dict[str, Flooded]) -> Line:
    """The line's figures and what did not hold."""
    failures: list[str] = []
    figures: dict[str, Any] = {}
    for name, found in floods.items():
        rate_hz, bare_hz = (block.ticks / block.seconds for block in (found.daemon, found.bare))
        figures[name] = {
            "per_s": round(found.per_s),
            "control_hz": round(rate_hz, 1),
            "bare_hz": round(bare_hz, 1),
            "ratio": round(rate_hz / bare_hz, 4),
            "named": found.named,
            "seconds": round(found.daemon.seconds, 1),
            "late_ticks_by": dict(found.late_ticks_by),
        }
        failures += [f"flood of {name}: {trouble}" for trouble in found.troubles]
        if found.per_s < LEAST_PER_S:
            failures.append(f"flood of {name}: only {found.per_s:.0f} messages a second, {LEAST_PER_S} are needed")
        if rate_hz < (1.0 - MOST_LESS) * bare_hz:
            failures.append(f"flood of {name}: control at {rate_hz:.1f} Hz, a bare timer at {bare_hz:.1f}")
        if not found.named:
            failures.append(f"flood of {name}: its source is not named")
    worst = min(figures.values(), key=lambda found: float(found["ratio"]))
    says = (
        f"floods of {min(found['per_s'] for found in figures.values()):,} messages a second on {', '.join(figures)}: "
        f"control at {worst['control_hz']} Hz beside the worst, a bare timer at {worst['bare_hz']} (allowed 1% less); "
        f"{sum(found['named'] for found in figures.values())} of {len(figures)} sources named, "
        f"{sum(bool(found.troubles) for found in floods.values())} with a fault (allowed 0)"
    )
    return Line(says, failures, figures)
