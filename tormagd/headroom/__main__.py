"""`python -m tormagd.headroom [--config FILE]`: what this machine holds, as one JSON object.

`tormagctl doctor --measure` judges it. It is a process of its own, because what it measures must not share an
interpreter with the one who asks.

What `plan` and `step` cost: the scene in virtual time, then both once more, each call timed. Both are deterministic, so
they can be called again with what they were given in the closed loop. They are called at the control period's pace: a
processor that sleeps between two ticks finds colder caches, and a step takes two or three times as long. Figures are
processor time, us.
"""

import argparse
import asyncio
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import uvloop

from firmware_protocol.build import settle
from tormagd.config import Config, load_config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.realtime import Heartbeat
from tormagd.ground.machine_loop import machine_us
from tormagd.ground.terminal import write_line
from tormagd.headroom.bare_timer import NS, Lateness, beat, lateness
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import printable

TIMER_S = 2.0
CORE_S = 0.7
"In virtual time; repeating the calls takes as long again in real time."
PLANT = "sample_1"
SWING_SHARE, PULSE_HZ = 0.2, 1.2
"A share of the middle of the scene's range, as often as a heart beats."
SHARES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}

Call = Callable[[], object]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tormagd.headroom", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, metavar="FILE", help="the daemon's configuration")
    options = parser.parse_args(arguments)
    try:
        result = measured(load_config(options.config), TIMER_S, CORE_S)
    except ConfigError as error:
        write_line(printable(str(error)), sys.stderr)
        return 2
    return 0 if write_line(json.dumps(result), sys.stdout) is None else 1


def measured(config: Config, timer_s: float, core_s: float) -> dict[str, Any]:
    machine = machine_us()
    steps, plans = calls(config, build_core(config), core_s)  # before the timer takes the daemon's priority
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        late, (step_us, plan_us) = runner.run(_in_real_time(config, timer_s, steps, plans))
    return {
        "machine_us": round(machine, 1),
        "build": str(settle()),
        "step_us": quantiles(step_us),
        "plan_us": quantiles(plan_us),
        "bare": {
            "rate_hz": config.rates.control_hz,
            "lateness_us": quantiles(late.beats_us),
            "missed_share": round(late.missed / (len(late.beats_us) + late.missed), 5),
            "not_granted": late.not_granted,
        },
    }


async def _in_real_time(
    config: Config, timer_s: float, steps: list[Call], plans: list[Call]
) -> tuple[Lateness, tuple[list[float], list[float]]]:
    rate_hz = config.rates.control_hz
    return await lateness(config.realtime, rate_hz, timer_s), await core_cost(steps, plans, rate_hz)


def quantiles(values: list[float]) -> dict[str, float]:
    return {"mean": round(float(np.mean(values)), 1)} | {
        name: round(float(np.percentile(values, share)), 1) for name, share in SHARES.items()
    }


def calls(config: Config, core: Core, seconds: float) -> tuple[list[Call], list[Call]]:
    """Run `core` in virtual time on a pulse, and return its calls of `step` and `plan`."""
    period_s = 1.0 / config.rates.control_hz
    # stages change in place: the calls are repeated on another loop's, which have come as far
    loop, again = _armed(config, core), _armed(config, core)
    stepper, planner = again.stepper, again.planner
    assert planner is not None, "this loop plans"
    force = core.scene.force
    middle_N = 0.5 * (force.least_N + force.most_N)
    steps: list[Call] = []
    plans: list[Call] = []
    for _ in range(round(seconds / period_s)):
        now_s = loop.now_s + period_s
        force_N = middle_N * (1.0 + SWING_SHARE * math.sin(math.tau * PULSE_HZ * now_s))
        setpoint = TimedSetpoint(force_N, now_s, 0.1)  # new for every tick, so that every tick plans
        measured = loop.stepper.measured
        sample = loop.tick(setpoint)
        steps.append(partial(stepper.step, sample.time_s, sample.measurement, sample.plan))
        plans.append(partial(planner.plan, sample.time_s, setpoint, measured))
    return steps, plans


def _armed(config: Config, core: Core) -> ClosedLoop:
    loop = ClosedLoop(config, core.stepper(), core.planner(), VirtualDevice(load_plant(PLANT), SteadyHand(), seed=1))
    loop.arm()
    return loop


async def core_cost(steps: Sequence[Call], plans: Sequence[Call], rate_hz: int) -> tuple[list[float], list[float]]:
    step_us: list[float] = []
    plan_us: list[float] = []
    ended = asyncio.Event()

    def on_beat(_heartbeat: Heartbeat, _beats: int, _now_ns: int) -> None:
        number = len(step_us)
        if number == len(steps):
            ended.set()
            return
        start_ns = time.thread_time_ns()
        plans[number]()
        planned_ns = time.thread_time_ns()
        steps[number]()
        plan_us.append((planned_ns - start_ns) * 1e-3)
        step_us.append((time.thread_time_ns() - planned_ns) * 1e-3)

    await beat(NS // rate_hz, on_beat, ended)
    return step_us, plan_us


if __name__ == "__main__":
    sys.exit(main())
