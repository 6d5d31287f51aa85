"""`benchmark virtual-time`: how many times faster than real time the closed loop runs, and what limits it.

The full plant with its firmware and protocol bytes runs twice. Once it is under the whole core that follows 500
setpoints a second, once under the position loop alone. Each build of the core is a process of its own, and they take
turns in stretches of some milliseconds. What a shared machine gives at a time, it gives to both. Processor time of one
thread; the median over stretches, and of their ratios. `python -m cProfile` says where it goes, in the interpreted
build (`TORMAG_COMPILED=0`).
"""

import argparse
import contextlib
import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.step import START_MM, STEP_MM
from firmware_protocol.build import SWITCH, settle
from tormagd.assembly.build import build_core
from tormagd.closed_loop import ClosedLoop, stream
from tormagd.config import Config
from tormagd.lab.training.bench_sweep import gap_plan
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

SETPOINT_HZ = 500
MEAN_N, SWING_N, PULSE_HZ = 1.2, 0.3, 1.2
STRETCH_TICKS = 100
BUILDS = ("compiled", "interpreted")
LASTS_S = 600.0
"Of the pulse: longer than anybody measures."
TIMES_S = np.arange(0.0, LASTS_S, 1.0 / SETPOINT_HZ)
PULSE = stream(TIMES_S, MEAN_N + SWING_N * np.sin(2.0 * np.pi * PULSE_HZ * TIMES_S))


def whole_core(loop: ClosedLoop) -> None:
    """One tick, asked for a pulse without end."""
    loop.tick(PULSE(loop.now_s))


def position_loop(loop: ClosedLoop) -> None:
    """One tick without plans, asked for a step of the gap every 0.1 s."""
    gap_mm = START_MM + STEP_MM * (int(loop.now_s * 10.0) % 2)
    loop.tick(plan=gap_plan(gap_mm, loop.now_s))


LOOPS = {"whole_core": whole_core, "position_loop": position_loop}
ARMED: dict[str, ClosedLoop] = {}
"Of a process that is measured."
Build = tuple[bool, Callable[[str, int], float]]
"""Whether a build is compiled, and how it is asked for the processor time of a tick of a loop over so many, us."""


def arm_loops(plant: str) -> None:
    """In a process that is measured, before all else."""
    config = Config()
    core = build_core(config)
    for name in LOOPS:
        device = VirtualDevice(load_plant(plant), SteadyHand(), seed=1)
        ARMED[name] = ClosedLoop(config, core.stepper(), core.planner(), device)
        ARMED[name].arm()
    gc.collect()
    gc.freeze()  # what was imported is no garbage; a daemon does the same


def tick_us(name: str, ticks: int) -> float:
    """In a process that is measured: the processor time of a tick of a loop over so many, us."""
    loop, tick = ARMED[name], LOOPS[name]
    started_s = time.thread_time()
    for _ in range(ticks):
        tick(loop)
    return (time.thread_time() - started_s) / ticks * 1e6


@contextlib.contextmanager
def build(plant: str, switch: str | None = None) -> Iterator[Build]:
    """One build in a process of its own; `switch` is TORMAG_COMPILED. Raises BrokenProcessPool where its loops cannot
    be made."""
    switched = {} if switch is None else {SWITCH: switch}
    with ProcessPoolExecutor(1, get_context("spawn"), arm_loops, (plant,)) as process:
        with mock.patch.dict(os.environ, switched):  # what the process begins with
            is_compiled = process.submit(settle).result().is_compiled
        yield is_compiled, lambda loop, ticks: process.submit(tick_us, loop, ticks).result()


Stretches = dict[str, dict[str, list[float]]]
"""Processor times of a tick, us: a list for each build and loop; stretches of one number were run side by side."""


def compared(plant: str, ticks: int) -> Stretches:
    """Every build there is, `interpreted` always, `compiled` where there is one, taking turns.

    Raises RuntimeError where TORMAG_COMPILED=0 does not switch the compiled core off.
    """
    with contextlib.ExitStack() as stack:
        builds = {"interpreted": stack.enter_context(build(plant, switch="0"))}
        if builds["interpreted"][0]:
            raise RuntimeError("TORMAG_COMPILED=0 did not switch the compiled core off")
        ours = stack.enter_context(build(plant))
        if ours[0]:
            builds["compiled"] = ours
        return take_turns({name: tick for name, (_, tick) in builds.items()}, ticks)


def take_turns(builds: Mapping[str, Callable[[str, int], float]], ticks: int) -> Stretches:
    """`ticks` of each loop and build, in stretches; who begins changes from one to the next."""
    found: Stretches = {name: {loop: [] for loop in LOOPS} for name in builds}
    order = list(builds)
    for _ in range(1 + max(1, ticks // STRETCH_TICKS)):
        for loop in LOOPS:
            for name in order:
                found[name][loop].append(builds[name](loop, STRETCH_TICKS))
        order.append(order.pop(0))
    # the first is not counted: caches and branches are learned
    return {name: {loop: taken_us[1:] for loop, taken_us in loops.items()} for name, loops in found.items()}


def summary(found: Stretches, period_us: float) -> dict[str, Any]:
    """The contract's object, null for a build that is not there. `ratio` is one build's factor over the other's, the
    median over stretches; `tick_us` is the median."""
    result: dict[str, Any] = dict.fromkeys(BUILDS)
    for name, loops in found.items():
        tick_us = {loop: statistics.median(taken_us) for loop, taken_us in loops.items()}
        result[name] = {loop: round(period_us / taken_us, 2) for loop, taken_us in tick_us.items()}
        result[name]["tick_us"] = {loop: round(taken_us, 1) for loop, taken_us in tick_us.items()}
    if "compiled" in found:
        result["ratio"] = {
            loop: round(statistics.median(np.divide(slow_us, found["compiled"][loop]).tolist()), 3)
            for loop, slow_us in found["interpreted"].items()
        }
    return result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark virtual-time`."""
    parser.add_argument("--seconds", type=float, default=10.0, help="virtual time of each loop")
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The contract's object."""
    config = Config()
    found = compared(options.plant, round(options.seconds * config.rates.control_hz))
    about = {"plant": options.plant, "seconds": options.seconds}
    return about | summary(found, 1e6 / config.rates.control_hz)
