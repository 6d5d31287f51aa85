"""A bare timer: what this machine gives a thread that only asks to be woken in every control period.

It has the daemon's heartbeat, event loop and scheduling, but no controller and no device.
"""

import asyncio
import time
from collections.abc import Callable
from typing import NamedTuple

from tormagd.config import RealTime
from tormagd.daemon.realtime import Heartbeat, freeze_garbage, prepare

NS = 1_000_000_000
WARM_UP_BEATS = 20

OnBeat = Callable[[Heartbeat, int, int], None]
"Called with the heartbeat, the beats that this one stands for, and CLOCK_MONOTONIC in ns."


class Lateness(NamedTuple):
    """How late each beat was, how many were missed, and what the kernel refused."""

    beats_us: list[float]
    missed: int
    not_granted: list[str]


async def beat(period_ns: int, on_beat: OnBeat, ended: asyncio.Event) -> None:
    """Call `on_beat` in every period until `ended` is set."""
    heartbeat = Heartbeat(period_ns)

    def woken() -> None:
        beats = heartbeat.beats()
        if beats:
            on_beat(heartbeat, beats, time.monotonic_ns())

    freeze_garbage()
    loop = asyncio.get_running_loop()
    loop.add_reader(heartbeat.fileno(), woken)
    await ended.wait()
    loop.remove_reader(heartbeat.fileno())
    heartbeat.close()


async def lateness(realtime: RealTime, rate_hz: int, seconds: float) -> Lateness:
    not_granted = prepare(realtime)
    late_us: list[float] = []
    missed = -WARM_UP_BEATS
    ended = asyncio.Event()

    def on_beat(heartbeat: Heartbeat, beats: int, now_ns: int) -> None:
        nonlocal missed
        if missed < 0:  # the first beats come while the loop itself begins
            missed = min(missed + beats, 0)
            return
        missed += beats - 1
        late_us.append((now_ns - heartbeat.due_ns) * 1e-3)
        if len(late_us) + missed >= seconds * rate_hz:
            ended.set()

    await beat(NS // rate_hz, on_beat, ended)
    return Lateness(late_us, missed, not_granted)
