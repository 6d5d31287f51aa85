"""A start that takes seconds is no stall: the loops are graded from their first period on. All time is virtual."""

import asyncio
import gc
import logging
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest

from tormagd.config import Config, Endpoints
from tormagd.control.core import build_core
from tormagd.daemon import daemon as daemon_module
from tormagd.daemon.daemon import Daemon
from tormagd.hardware.backend import Backend, BackendError

SLOW_NS = 3_000_000_000
TICKS = 200


class Clock:
    """CLOCK_MONOTONIC, standing still but for what the test says."""

    def __init__(self) -> None:
        self.now_ns = time.monotonic_ns()

    def slow(self, _record: object = None) -> bool:
        """Three seconds that the start takes."""
        self.now_ns += SLOW_NS
        return True


class Heartbeat:
    """Beats as the kernel's timer does, when they are asked for."""

    made: ClassVar["list[Heartbeat]"] = []

    def __init__(self, period_ns: int) -> None:
        self.period_ns, self.due_ns = period_ns, time.monotonic_ns()
        self._fd = os.eventfd(0)
        self.made.append(self)

    def fileno(self) -> int:
        return self._fd

    def beats(self) -> int:
        beats = (time.monotonic_ns() - self.due_ns) // self.period_ns
        self.due_ns += beats * self.period_ns
        return beats

    def close(self) -> None:
        os.close(self._fd)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    made = Clock()
    monkeypatch.setattr(time, "monotonic_ns", lambda: made.now_ns)
    monkeypatch.setattr(time, "monotonic", lambda: made.now_ns * 1e-9)
    monkeypatch.setattr(daemon_module, "Heartbeat", Heartbeat)
    logging.getLogger(daemon_module.__name__).addFilter(made.slow)
    yield made
    logging.getLogger(daemon_module.__name__).removeFilter(made.slow)
    Heartbeat.made.clear()
    gc.unfreeze()  # the daemon takes what lives out of the collector's reach


def test_a_slow_start_is_graded_as_a_fast_one(clock: Clock, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    addresses = {name: f"ipc://{tmp_path}/{name}" for name in ("setpoint", "telemetry", "control", "recording")}

    def no_device() -> Backend:
        if not Heartbeat.made:
            clock.slow()
        raise BackendError("no such port", "plug it in")

    async def start() -> Daemon:
        config = Config(endpoints=Endpoints(**addresses))
        started = Daemon(config, build_core(config), no_device, [])
        started._inference._clock_ns = time.monotonic_ns  # its own was bound before the clock was made
        clock.slow()
        running = asyncio.create_task(started.run())
        while not Heartbeat.made:
            await asyncio.sleep(0)
        (heartbeat,) = Heartbeat.made
        for _ in range(TICKS):
            clock.now_ns += heartbeat.period_ns
            started._beat(heartbeat)
        signal.raise_signal(signal.SIGTERM)
        await running
        return started

    with caplog.at_level(logging.INFO):
        begun_ns = clock.now_ns
        daemon = asyncio.run(start())
    assert clock.now_ns - begun_ns > 3 * SLOW_NS
    groups = (daemon._control.timing, daemon._inference.timing, daemon._telemetry.timing)
    for group in groups:
        group.refresh()
    assert [group.report.grade for group in groups] == ["good"] * 3
    assert (daemon._control.timing.runs, daemon._control.timing.merged) == (TICKS, 0)
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]
