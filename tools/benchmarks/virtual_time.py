"""`benchmark virtual-time`: how many times faster than real time the closed loop runs, and what limits it.

The full plant with its firmware and protocol bytes runs under the whole core, which follows 500 setpoints a second, and
under the position loop alone. Each build of the core is a process of its own; they take turns in stretches of some
milliseconds, so that a shared machine's changes meet both. The figure is one thread's processor time, in the median
over stretches. `python -m cProfile` says where it goes, in the interpreted build (`TORMAG_COMPILED=0`).
"""

import argparse
import contextlib
import gc
import os
import statistics
import time
from collections.abc import Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.step import START_MM, STEP_MM
from firmware_protocol.build import SWITCH, settle
from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.simulation.closed_loop import ClosedLoop, gap_plan, stream
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

PLANT, SETPOINT_HZ = "sample_1", 500
MEAN_N, SWING_N, PULSE_HZ = 1.2, 0.3, 1.2
STRETCH_TICKS = 100
BUILDS = ("compiled", "interpreted")
LASTS_S = 600.0
TIMES_S = np.arange(0.0, LASTS_S, 1.0 / SETPOINT_HZ)
PULSE = stream(TIMES_S, MEAN_N + SWING_N * np.sin(2.0 * np.pi * PULSE_HZ * TIMES_S))


def whole_core(loop: ClosedLoop) -> None:
    loop.tick(PULSE(loop.now_s))


def position_loop(loop: ClosedLoop) -> None:
    """Run one tick without plans, asked for a step of the gap every 0.1 s."""
    gap_mm = START_MM + STEP_MM * (int(loop.now_s * 10.0) % 2)
    loop.tick(plan=gap_plan(gap_mm, loop.now_s))


LOOPS = {"whole_core": whole_core, "position_loop": position_loop}
ARMED: dict[str, ClosedLoop] = {}


def arm_loops() -> None:
    config = Config()
    core = build_core(config)
    for name in LOOPS:
        device = VirtualDevice(load_plant(PLANT), SteadyHand(), seed=1)
        ARMED[name] = ClosedLoop(config, core.stepper(), core.planner(), device)
        ARMED[name].arm()
    gc.collect()
    gc.freeze()  # what was imported is no garbage; a daemon does the same


def tick_us(name: str, ticks: int) -> float:
    loop, tick = ARMED[name], LOOPS[name]
    started_s = time.thread_time()
    for _ in range(ticks):
        tick(loop)
    return (time.thread_time() - started_s) / ticks * 1e6


Stretches = dict[str, dict[str, list[float]]]
"""Processor times of a tick, us, for each build and loop; stretches of one number ran side by side."""


def compared(ticks: int) -> Stretches:
    """Return every build, `interpreted` always, `compiled` if there is one, taking turns."""
    builds: dict[str, Executor] = {}
    with contextlib.ExitStack() as stack:
        for switch in ("0", "1"):
            process = stack.enter_context(ProcessPoolExecutor(1, get_context("spawn"), arm_loops))
            with mock.patch.dict(os.environ, {SWITCH: switch}):  # what the process begins with
                is_compiled = process.submit(settle).result().is_compiled
            # without a compiled build the second is interpreted, too
            builds.setdefault("compiled" if is_compiled else "interpreted", process)
        return take_turns(builds, ticks)


def take_turns(builds: Mapping[str, Executor], ticks: int) -> Stretches:
    found: Stretches = {name: {loop: [] for loop in LOOPS} for name in builds}
    order = list(builds)
    for _ in range(1 + max(1, ticks // STRETCH_TICKS)):
        for loop in LOOPS:
            for name in order:
                found[name][loop].append(builds[name].submit(tick_us, loop, STRETCH_TICKS).result())
        order.append(order.pop(0))
    # the first is not counted: it fills caches
    return {name: {loop: taken_us[1:] for loop, taken_us in loops.items()} for name, loops in found.items()}


def summary(found: Stretches, period_us: float) -> dict[str, Any]:
    """Return a period over the median tick; null for a missing build."""
    return dict.fromkeys(BUILDS) | {
        name: {loop: round(period_us / statistics.median(taken_us), 2) for loop, taken_us in loops.items()}
        for name, loops in found.items()
    }


OPTIONS = {"--seconds": {"type": float, "default": 10.0, "help": "virtual time of each loop"}}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    control_hz = Config().rates.control_hz
    found = compared(round(options.seconds * control_hz))
    return {"plant": PLANT, "seconds": options.seconds} | summary(found, 1e6 / control_hz)
