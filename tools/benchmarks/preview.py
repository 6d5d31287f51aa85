"""`benchmark preview`: what a plan costs that knows what follows, beside one that does not.

The pulse of `make run`, live and with what follows it, in virtual time; then every plan is made once more, in rounds
over all of them. Of each the least counts, which is what it takes where nobody else takes the processor.
"""

import argparse
import gc
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from rendering.human_pulse import pulse_profile
from rendering.publisher import PREVIEW_S, RATE_HZ, publisher

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.control.plan import PlanState
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

Array = npt.NDArray[np.float64]
Call = Callable[[], PlanState]

AHEAD_S = {"live": 0.0, "preview_70_ms": PREVIEW_S, "preview_400_ms": 0.4}
PULSE_N = 1.4, 1.7
LEARNS_S = 5.0
"After which a live pulse is foreseen, and plans count."
ROUNDS = 9
ALLOWED = 1.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is played, and how long."""
    parser.add_argument(
        "--scene", default="radial_pulse", help="whose plans (radial_pulse: among the cheapest without)"
    )
    parser.add_argument("--seconds", type=float, default=5.0, help=f"of the pulse, behind {LEARNS_S:g} (5)")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """`{live, preview_70_ms, preview_400_ms: {mean_us, p99_us, max_us}, ratio: {NAME: {mean, p99}}, allowed}`: ratios
    over `live`."""
    taken = least_us({name: plans(options.scene, ahead_s, options.seconds) for name, ahead_s in AHEAD_S.items()})
    found: dict[str, dict[str, float]] = {
        name: {"mean_us": float(us.mean()), "p99_us": float(np.percentile(us, 99.0)), "max_us": float(us.max())}
        for name, us in taken.items()
    }
    live = found["live"]
    ratio = {
        name: {kind: round(one[f"{kind}_us"] / live[f"{kind}_us"], 2) for kind in ("mean", "p99")}
        for name, one in found.items()
        if name != "live"
    }
    rounded = {name: {kind: round(us, 2) for kind, us in one.items()} for name, one in found.items()}
    return rounded | {"ratio": ratio, "allowed": ALLOWED}


def plans(scene: str, ahead_s: float, seconds: float) -> list[Call]:
    """Each plan of the pulse on sample 1 after LEARNS_S, to be made again."""
    config = Config(scene=scene)
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(load_plant("sample_1"), SteadyHand()))
    loop.arm()
    times_s, forces_N = pulse_profile(LEARNS_S + seconds, *PULSE_N, RATE_HZ)
    begins_s = loop.now_s
    publish = publisher(times_s + begins_s, forces_N, ahead_s, 0.1)
    calls: list[Call] = []
    before = loop.plan_state
    assert before is not None, "a loop with a planner has a state of it"
    while loop.now_s < begins_s + float(times_s[-1]):
        setpoint = publish(loop.now_s)
        loop.tick(setpoint)
        planned = loop.plan_state
        assert planned is not None
        if planned is not before and loop.now_s > begins_s + LEARNS_S:
            calls.append(partial(core.planner.plan, before, loop.now_s, setpoint, loop.step_state.estimate))
        before = planned
    return calls


def least_us(runs: dict[str, list[Call]]) -> dict[str, Array]:
    """The least time that each call of each run takes in ROUNDS, in which the runs take turns."""
    least = {name: np.full(len(calls), np.inf) for name, calls in runs.items()}
    gc.collect()
    gc.disable()
    for _ in range(ROUNDS):
        for name, calls in runs.items():
            spent = []
            for call in calls:
                start_ns = time.perf_counter_ns()
                call()
                spent.append((time.perf_counter_ns() - start_ns) * 1e-3)
            least[name] = np.minimum(least[name], spent)
    gc.enable()
    return least


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    for name in AHEAD_S:
        one, ratio = result[name], result["ratio"].get(name, {"mean": 1.0, "p99": 1.0})
        print(
            f"{name.replace('_', ' '):16s}mean {one['mean_us']:6.2f} us ({ratio['mean']:.2f} of live), "
            f"p99 {one['p99_us']:6.2f} us ({ratio['p99']:.2f}), max {one['max_us']:6.2f} us"
        )
    print(f"allowed: {result['allowed']:g} of live")
