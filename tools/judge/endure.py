"""Runs long, destructive cases, one at a time: does it hold?

The tests run the same cases with smaller counts. A case in real time reports what its host took meanwhile. An
unexpected fault is blamed on the host if a bare timer, too, stood still for half of the time that a device waits.
"""

import argparse
import math
import random
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from machines.host import HOST_SHARE, HostWatch
from mcap.reader import make_reader
from stand import FIFO_PRIORITY, PATIENCE_S, Figures, Stand, used
from tqdm import tqdm

from judge import fuzz
from tormagd.ctl.processes import end
from tormagd.ground.command_line import Within
from tormagd.record.writer import TICKS_TOPIC
from tormagd_client import Client

DEVICE_WAITS_MS = 50.0
"For a command, before it opens by itself."

CLOSING_MM = 85.0
DOWN_S = (0.2, 1.6)
"How long it is away: covers every wait between two attempts to open."


def unplugged(transport: str, count: int, seed: int) -> Figures:
    """Unplug the device in motion and plug it in again: a fault is latched, nothing arms by itself."""
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


MEAN_N, SWING_N, SWING_HZ = 1.5, 0.3, 0.2
SAMPLE_S, GROWS_S = 0.5, 120.0
ALLOWED_KB = {"daemon": 2_048, "recorder": 16_384}
"The recorder keeps the index, which is written last: two entries a second."


def soaked(stand: Stand, count: int, _seed: int) -> Figures:
    """Render force, record, and ask for the status every half second: nothing grows, every tick is recorded.

    Growth counts after two minutes, or a quarter of a shorter time, when everything that is made once exists.
    """
    path = stand.folder / "soak.mcap"
    ctl = ("-m", "tormagd.ctl.main", "--config", str(stand.folder / "tormagd.toml"))
    processes = {"daemon": stand.daemon, "recorder": stand.begin(*ctl, "record", str(path))}
    stand.until(lambda _status: path.exists(), "recorded")
    stand.arm()
    samples: dict[str, list[tuple[int, int]]] = {name: [] for name in processes}
    for _ in tqdm(range(count), desc="soak", unit="sample", disable=None):
        since_s = time.monotonic()
        stand.ask(MEAN_N + SWING_N * math.sin(math.tau * SWING_HZ * since_s))
        time.sleep(SAMPLE_S)
        with Client(stand.endpoints, PATIENCE_S) as client:
            client.request("status")
        if stand.see_faults(since_s):
            stand.arm()
        for name, process in processes.items():
            samples[name].append(used(process))
    end(processes["recorder"])
    grown_kB = {name: growth([kB for _, kB in values]) for name, values in samples.items()}
    stayed = {name: staying([descriptors for descriptors, _ in values]) for name, values in samples.items()}
    ticks = recorded(path)
    return {
        "minutes": round(count * SAMPLE_S / 60.0, 2),
        "growth_kB": grown_kB,
        "memory_kB": {name: values[-1][1] for name, values in samples.items()},
        "descriptor_growth": stayed,
        "ticks": len(ticks),
        "failures": failures(grown_kB, stayed, ticks),
    }


def failures(grown_kB: dict[str, int], stayed: dict[str, int], ticks: list[int]) -> list[str]:
    found = [
        f"{name}: memory grew by {grown} kB, allowed {ALLOWED_KB[name]}"
        for name, grown in grown_kB.items()
        if grown > ALLOWED_KB[name]
    ]
    found += [f"{name}: {more} more descriptors" for name, more in stayed.items() if more > 0]
    if not ticks or ticks[-1] - ticks[0] + 1 != len(ticks):
        found.append(f"recording: {len(ticks)} ticks, not all of {ticks[:1]} to {ticks[-1:]}")
    return found


def recorded(path: Path) -> list[int]:
    with path.open("rb") as file:
        messages: Any = make_reader(file).iter_messages(topics=[TICKS_TOPIC])
        return [int(msgspec.json.decode(message.data)["tick"]) for _, _, message in messages]


def staying(values: list[int]) -> int:
    """Return the increase from the second to the last quarter, whatever comes and goes."""
    quarter = len(values) // 4
    return min(values[-quarter:]) - min(values[quarter : 2 * quarter])


def growth(values: list[int]) -> int:
    """Return the growth of the largest once everything that is made once exists."""
    settled = min(len(values) // 4, round(GROWS_S / SAMPLE_S))
    return max(values[settled:]) - values[settled]


class Case(NamedTuple):
    """What is run, how much of it `in_full`; one `on_stand` needs a daemon and a device."""

    run: Callable[..., Figures]
    in_full: int
    of: str
    on_stand: bool = False


CASES = {
    "fuzz": Case(fuzz.run, 1_800, "seconds of bytes"),
    "replug-serial": Case(partial(unplugged, "serial"), 200, "cycles"),
    "replug-can": Case(partial(unplugged, "can"), 200, "cycles"),
    "soak": Case(soaked, 3_600, "half seconds", on_stand=True),
}


OPTIONS = {
    "case": {"choices": CASES},
    "--count": {
        "type": Within(1, 10**9, is_whole=True),
        "help": "default: " + ", ".join(f"{name} {case.in_full:,} {case.of}" for name, case in CASES.items()),
    },
    "--seed": {"type": int, "default": 1, "help": "of what is drawn (1)"},
}


def measure(options: argparse.Namespace) -> Figures:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what was begun is ended
    return measured(options.case, options.count or CASES[options.case].in_full, options.seed)


def measured(name: str, times: int, seed: int) -> Figures:
    case = CASES[name]
    figures = _watched(case.run, times, seed) if case.on_stand else case.run(times, seed)
    return {"case": name, "count": times, "seed": seed, "passed": not figures["failures"]} | figures


def _watched(run: Callable[..., Figures], times: int, seed: int) -> Figures:
    with HostWatch(FIFO_PRIORITY + 10, sys.stderr) as watch:
        with ExitStack() as stack:
            stand = Stand(stack)
            start_s = time.monotonic()
            figures = run(stand, times, seed)
            figures["failures"] += stand.unhandled()
        watch.end()
    figures["host"] = str(watch.between(start_s, time.monotonic()))
    figures["held_against_host"] = []
    for fault, from_s, to_s in stand.latched:
        stood_ms = watch.between(from_s, to_s).bare_worst_ms
        is_hosts = stood_ms >= HOST_SHARE * DEVICE_WAITS_MS
        figures["held_against_host" if is_hosts else "failures"].append(
            f"fault {fault}, while a bare timer stood still for {stood_ms:.0f} ms"
        )
    return figures
