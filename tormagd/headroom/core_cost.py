"""What `plan` and `step` cost on this machine: the scene in virtual time, then both once more, each call timed.

Both are deterministic, so they can be called again with what they were given in the closed loop. They are called at the
control period's pace: a processor that sleeps between two ticks finds colder caches, and a step takes two or three
times as long. Figures are processor time, us.
"""

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from functools import partial

from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.realtime import Heartbeat
from tormagd.headroom.bare_timer import NS, beat
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

PLANT = "sample_1"
SWING_SHARE, PULSE_HZ = 0.2, 1.2
"A share of the middle of the scene's range, as often as a heart beats."

Call = Callable[[], object]


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
