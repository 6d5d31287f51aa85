"""`benchmark virtual-time`: how many times faster than real time the closed loop runs, and what limits it.

The full plant with its firmware and protocol bytes, once under the whole core that follows 500 setpoints a second, once
under the position loop alone. Processor time of one thread; the median over stretches, because a shared machine is slow
at times. Profiled shares charge each function with its own time, calls excluded; profiling makes short functions look
longer than they are.
"""

import argparse
import cProfile
import gc
import pstats
import statistics
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_step import START_MM, STEP_MM, hold

import firmware_protocol
import tormagd
from tormagd.closed_loop import ClosedLoop, stream
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

SETPOINT_HZ = 500
MEAN_N, SWING_N, PULSE_HZ = 1.2, 0.3, 1.2
STRETCH_TICKS = 100
SHOWN = 12
"Functions in the profile."

Run = Callable[[int], None]


def force_loop(config: Config, plant: str) -> Run:
    """Runs so many ticks of the whole core, asked for a pulse without end."""
    loop = armed_loop(config, plant)
    times_s = np.arange(0.0, 600.0, 1.0 / SETPOINT_HZ)
    setpoint = stream(times_s, MEAN_N + SWING_N * np.sin(2.0 * np.pi * PULSE_HZ * times_s))

    def run(ticks: int) -> None:
        for _ in range(ticks):
            loop.tick(setpoint(loop.now_s))

    return run


def gap_loop(config: Config, plant: str) -> Run:
    """Runs so many ticks of the position loop alone, asked for a step of the gap every 0.1 s."""
    loop = armed_loop(config, plant)

    def run(ticks: int) -> None:
        for _ in range(ticks):
            gap_mm = START_MM + STEP_MM * (int(loop.now_s * 10.0) % 2)
            loop.tick(plan=hold(gap_mm, loop.now_s))

    return run


def armed_loop(config: Config, plant: str) -> ClosedLoop:
    """Homed and enabled."""
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(load_plant(plant), SteadyHand(), seed=1))
    loop.arm()
    return loop


def measured_us(run: Run, ticks: int) -> list[float]:
    """Processor time of a tick, us, in each stretch."""
    gc.collect()
    gc.freeze()  # what was imported is no garbage; a daemon does the same
    run(STRETCH_TICKS)
    stretches = []
    for _ in range(max(1, ticks // STRETCH_TICKS)):
        started_s = time.thread_time()
        run(STRETCH_TICKS)
        stretches.append((time.thread_time() - started_s) / STRETCH_TICKS * 1e6)
    gc.unfreeze()
    return stretches


def profiled(run: Run, ticks: int) -> dict[str, Any]:
    """Share of each room in the time, the functions that take most, and how many calls a tick all of them are."""
    profile = cProfile.Profile()
    profile.runcall(run, ticks)
    rooms: Counter[str] = Counter()
    functions: Counter[str] = Counter()
    total_calls = 0
    # the stubs do not know of `stats`: (file, line, name) to (calls, primitive calls, own time, cumulative time, ...)
    for (file, _, name), (_, calls, own_s, _, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        rooms[_room(file)] += own_s
        total_calls += calls
        functions[f"{_room(file)}: {Path(file).stem}.{name}, {calls / ticks:.3g} a tick"] += own_s
    total_s = rooms.total()
    return {
        "calls_per_tick": round(total_calls / ticks),
        "rooms": {room: round(own_s / total_s, 3) for room, own_s in rooms.most_common()},
        "functions": {name: round(own_s / total_s, 3) for name, own_s in functions.most_common(SHOWN)},
    }


def _room(file: str) -> str:
    for package in (tormagd, firmware_protocol):
        # by where the packages are, whatever the folders above them are called
        folder = Path(package.__path__[0])
        if Path(file).is_relative_to(folder):
            inside = Path(file).relative_to(folder).parts[0].removesuffix(".py")
            return inside if package is tormagd else package.__name__
    return "Python and NumPy"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark virtual-time`."""
    parser.add_argument("--seconds", type=float, default=10.0, help="virtual time of each loop")
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--profile", action="store_true", help="also say where the time goes")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """`factor` and `tick_us` (median, and the fastest tenth) of both loops; `profile` of the whole core."""
    config = Config()
    ticks = round(options.seconds * config.rates.control_hz)
    result: dict[str, Any] = {"plant": options.plant, "seconds": options.seconds}
    runs = {"whole_core": force_loop(config, options.plant), "position_loop": gap_loop(config, options.plant)}
    for name, run in runs.items():
        stretches = measured_us(run, ticks)
        typical_us, best_us = statistics.median(stretches), float(np.percentile(stretches, 10.0))
        result[name] = {
            "factor": round(1e6 / config.rates.control_hz / typical_us, 2),
            "tick_us": {"p50": round(typical_us, 1), "p10": round(best_us, 1)},
        }
    if options.profile:
        result["profile"] = profiled(runs["whole_core"], ticks)
    return result


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    for name, says in (("whole_core", "whole core"), ("position_loop", "position loop")):
        found = result[name]
        print(
            f"{says:16s}{found['factor']:6.2f} times real time, a tick {found['tick_us']['p50']:.0f} us "
            f"(fastest tenth {found['tick_us']['p10']:.0f})"
        )
    if "profile" in result:
        print(f"the whole core calls {result['profile']['calls_per_tick']} functions a tick; its time goes into")
        for part in ("rooms", "functions"):
            for name, share in result["profile"][part].items():
                print(f"{share:7.1%}  {name}")
