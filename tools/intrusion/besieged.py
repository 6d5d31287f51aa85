"""A daemon that somebody troubles: on a simulated device, recorded, and asked afterwards what became of it."""

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zmq
from benchmarks.loop import LOG, Array, Running, Stand, collect, daemon, recording

from tormagd.config import Config, RealTime
from tormagd_client import Client

FIFO_PRIORITY = 50
DEVICE_PRIORITY, OTHERS_PRIORITY = FIFO_PRIORITY - 10, FIFO_PRIORITY - 20
THROTTLE = Path("/proc/sys/kernel/sched_rt_runtime_us")
UNTHROTTLED = "-1"
ANSWER_S = 10.0
"A client waits for its turn among those that trouble the daemon."
FAULT = "fault "
"What a failure begins with that the machine may have to answer for."
UNHANDLED = ("Traceback", "CRITICAL", "Exception ignored")


class Line(NamedTuple):
    """What one line of the issue came to: in a sentence, what did not hold, and all figures."""

    says: str
    failures: list[str]
    figures: dict[str, Any]
    held_against_machine: Sequence[str] = ()
    "Faults of a time in which it stood still."


class Besieged(NamedTuple):
    """The daemon's folder and processes, somebody who may ask it, and a subscriber of its ticks."""

    folder: Path
    running: Running
    client: Client
    recorder: "zmq.Socket[bytes]"

    @property
    def config(self) -> Config:
        """As the daemon was started with."""
        return self.running.config

    def status(self) -> dict[str, Any]:
        """The daemon's status. Raises ClientError where it does not answer."""
        return self.client.request("status")

    def lateness_us(self, seconds: float) -> Array:
        """How late each control tick of that time began."""
        return collect(self.recorder, seconds).lateness_us

    def troubles(self) -> list[str]:
        """What must not have become of it: faults, and what nobody has handled."""
        log = (self.folder / LOG).read_text(encoding="utf-8", errors="replace")
        found = [f"{FAULT}{fault}" for fault in self.status()["faults"]]
        return found + [line for line in log.splitlines() if any(sign in line for sign in UNHANDLED)]


def stand(**fields: Any) -> Stand:
    """A stand with the scheduling of the service; `fields` as of Stand."""
    realtime = RealTime(fifo_priority=FIFO_PRIORITY, lock_memory=True)
    return Stand(realtime, device_fifo=DEVICE_PRIORITY, **fields)


@contextlib.contextmanager
def elsewhere() -> Iterator[None]:
    """What this process does and begins meanwhile stands for other machines: it waits for no processor but for those
    that daemon and device take. Where that is not allowed, for all."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(OTHERS_PRIORITY))
    try:
        with unthrottled():
            yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def unthrottled() -> Iterator[None]:
    """Real-time threads may fill a processor. Else the kernel stops all of them there for 50 ms of each second, the
    daemon's as well, because what stands for other machines is among them."""
    before = THROTTLE.read_text()
    with contextlib.suppress(PermissionError):
        THROTTLE.write_text(UNTHROTTLED)
    try:
        yield
    finally:
        with contextlib.suppress(PermissionError):
            THROTTLE.write_text(before)


@contextlib.contextmanager
def besieged(stood: Stand) -> Iterator[Besieged]:
    """Starts it, enabled, with setpoints arriving; ends it."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as name, daemon(stood, Path(name)) as running, elsewhere():
        endpoints = running.config.endpoints
        with recording(endpoints) as recorder, Client(endpoints, ANSWER_S) as client:
            yield Besieged(Path(name), running, client, recorder)


def p99_us(values: Array) -> float:
    """The 99th percentile."""
    return round(float(np.percentile(values, 99.0)), 1)
