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
import numpy as np
from machines.host import HOST_SHARE, HostWatch
from mcap.reader import make_reader
from tqdm import tqdm

from judge import fuzz, siege
from judge.stand import FIFO_PRIORITY, PATIENCE_S, Figures, Stand, is_at_rest, used
from tormag_lab.main import whole
from tormagd.ctl.processes import end
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


FORCE_N, ALLOWED_N = 1.5, 0.1
PAUSES_MS = (5.0, 15.0, 25.0, 35.0, 45.0, 60.0, 83.0, 400.0)
SURVIVED_MS, OPENS_MS = 48.0, 52.0
"The device's timeout, with a period on either side."
OPEN_MM = 94.0
SETTLED_S, WATCHED_S = 0.7, 0.6
TOLD = {"daemon": "HOST_STALL", "device": "MEASUREMENT_STALE"}
"Name of the one fault after a long stop."


class Stop(NamedTuple):
    process: str
    took_ms: float
    faults: tuple[str, ...]
    began_ns: int
    rest_ns: int

    def failure(self, worst_N: float, gap_mm: float) -> str:
        if self.took_ms <= SURVIVED_MS and self.faults:
            return f"fault {', '.join(self.faults)}"
        if self.took_ms <= SURVIVED_MS and worst_N > ALLOWED_N:
            return f"force off by {worst_N:.3f} N, allowed {ALLOWED_N:g}"
        if self.took_ms >= OPENS_MS and self.faults != (TOLD[self.process],):
            return f"told as {', '.join(self.faults) or 'nothing'}"
        if self.faults and gap_mm < OPEN_MM:
            return f"gap {gap_mm:.1f} mm, not open"
        return ""


def stalled(stand: Stand, count: int, seed: int) -> Figures:
    """Stop daemon or device for some milliseconds while force is held.

    A stop's measured length decides. Below the device's timeout of 50 ms nothing may latch, and the force must stay
    within 0.1 N. From 60 ms on the gap must be open in the end, and one fault must say what happened.
    """
    draw = random.Random(seed)
    stops: list[Stop] = []
    for number in tqdm(range(count), desc="stalls", unit="stop", disable=None):
        _hold(stand)
        time.sleep(draw.uniform(0.0, 0.02))
        stops.append(_stop(stand, ("daemon", "device")[number % 2], draw.choice(PAUSES_MS)))
    truth = stand.truth()
    failures: list[str] = []
    worst_N = 0.0
    for stop in stops:
        seen = truth[(truth[:, 0] >= stop.began_ns) & (truth[:, 0] <= stop.rest_ns)]
        error_N = float(np.abs(seen[:, 1] - FORCE_N).max())
        if failure := stop.failure(error_N, float(seen[-1, 2])):
            failures.append(f"{stop.process} stopped for {stop.took_ms:.1f} ms: {failure}")
        worst_N = max(worst_N, 0.0 if stop.faults else error_N)
    faulted = sum(bool(stop.faults) for stop in stops)
    return {"stops": count, "faulted": faulted, "worst_N": round(worst_N, 4), "failures": failures}


def _hold(stand: Stand) -> None:
    while True:
        stand.arm()
        since_s = time.monotonic()
        stand.ask(FORCE_N)
        stand.until(
            lambda status: bool(status["faults"]) or abs((status["measured_cf"] or 0.0) - FORCE_N) < ALLOWED_N,
            f"{FORCE_N} N",
        )
        time.sleep(SETTLED_S)
        if not stand.see_faults(since_s):
            return


def _stop(stand: Stand, process: str, pause_ms: float) -> Stop:
    child = stand.daemon if process == "daemon" else stand.device
    began_ns = time.time_ns()
    child.send_signal(signal.SIGSTOP)
    # a sleep may end late, which a stop must not: the last stretch is waited for awake
    time.sleep(max(0.0, pause_ms * 1e-3 - 1e-3))
    while time.time_ns() - began_ns < pause_ms * 1e6:
        pass
    child.send_signal(signal.SIGCONT)
    took_ms = (time.time_ns() - began_ns) * 1e-6
    time.sleep(WATCHED_S)
    status = stand.until(lambda status: not status["faults"] or is_at_rest(status), "at rest")
    return Stop(process, took_ms, tuple(status["faults"]), began_ns, time.time_ns())


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
    "stalls": Case(stalled, 400, "stops", on_stand=True),
    "soak": Case(soaked, 3_600, "half seconds", on_stand=True),
    "siege": Case(siege.run, 200, "stops beside each attack", on_stand=True),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    counts = ", ".join(f"{name} {case.in_full:,} {case.of}" for name, case in CASES.items())
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--count", type=whole(1, 10**9), help=f"default: {counts}")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn (1)")


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
