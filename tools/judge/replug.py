"""The device unplugged during motion and plugged in again, over and over.

The daemon must latch a fault, find the device again, never arm by itself, and keep no descriptor.
"""

import math
import random
import time
from contextlib import ExitStack
from typing import Any

from tqdm import tqdm

from judge.stand import Figures, Stand, used

CLOSING_MM = 85.0
DOWN_S = (0.2, 1.6)
"How long it is away: covers every wait between two attempts to open."


def run(transport: str, count: int, seed: int) -> Figures:
    draw = random.Random(seed)
    with ExitStack() as stack:
        stand = Stand(stack, transport)
        cycles = [
            _cycle(stand, transport, draw)
            for _ in tqdm(range(count), desc=f"replug, {transport}", unit="cycle", disable=None)
        ]
    first, last = cycles[min(1, count - 1)], cycles[-1]  # by then everything that is loaded late is loaded
    failures = [f"cycle {number}: {what}" for number, cycle in enumerate(cycles) for what in cycle["failures"]]
    if last["descriptors"] > first["descriptors"]:
        failures.append(f"{last['descriptors'] - first['descriptors']} more descriptors")
    return {
        "cycles": count,
        "lost_after_ms": max(cycle["lost_after_ms"] for cycle in cycles),
        "descriptors": [first["descriptors"], last["descriptors"]],
        "resident_kB": [first["resident_kB"], last["resident_kB"]],
        "failures": failures,
    }


def _cycle(stand: Stand, transport: str, draw: random.Random) -> dict[str, Any]:
    stand.arm()
    with stand.ticks() as read:
        stand.ask(draw.uniform(1.4, 1.8))
        stand.until(lambda _status: any(_gap_mm(tick) < CLOSING_MM for tick in read()), "the gap closes")
        pulled_s = time.monotonic()
        stand.device.kill()
        time.sleep(draw.uniform(*DOWN_S))
        stand.plug_in(transport)
        status = stand.until(lambda status: status["link"]["state"] == "RUNNING", "the device is back")
        ticks = [tick for tick in read() if tick["monotonic_s"] > pulled_s]
    lost_s = next(tick["monotonic_s"] for tick in ticks if tick["device_time_s"] is None)
    failures = [] if status["operating_state"] == "FAULT" else [f"{status['operating_state']} after a loss"]
    if any(tick["operating_state"] == "ENABLED" for tick in ticks if tick["monotonic_s"] > lost_s):
        failures.append("armed again by itself")
    descriptors, resident_kB = used(stand.daemon)
    return {
        "lost_after_ms": round(1e3 * (lost_s - pulled_s), 1),
        "descriptors": descriptors,
        "resident_kB": resident_kB,
        "failures": failures,
    }


def _gap_mm(tick: dict[str, Any]) -> float:
    return math.inf if tick["left_mm"] is None else float(tick["left_mm"] + tick["right_mm"])
