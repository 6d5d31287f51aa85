"""A force held on the tactile pad for an hour, by the daemon's own loop in virtual time: with relaxation and without.

    tactile_hold.py [--seconds 3600] [--plant pad_1 ...] [--workers N] [--json]

A constant force is asked for; the finger presses, and the device is learned for some seconds. From then on the error of
the pad's true force counts, as a share of the force asked, and frozen runs learn no more. The loop runs at the scene's
own rates; `--control-hz 1000` shows that faster ones change nothing. All pads are synthetic.
"""

import argparse
import json
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import msgspec
import numpy as np

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config, Rates
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.output import write_line
from tormagd.scenes.scene import load_scene, terms_of
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import PRESSES_AT_S, PRESSING_MM_S, PressingHand
from tormagd.simulation.parameters import load_plant

SCENE = "radial_pulse"
PLANTS = ("pad_1", "pad_2", "pad_3")
FORCE_N = 3.55
LEARN_S = 4.0
TEN_MINUTES_S = 600.0
VALID_S = 0.1


class Case(NamedTuple):
    """One hold."""

    plant: str
    relaxation: bool
    is_learning: bool
    seconds: float
    control_hz: int


def hold(case: Case) -> dict[str, Any]:
    """The greatest and the mean error of the true force, as shares of the force asked, and for how long each limit was
    there. A fault is an error of the whole."""
    stated = load_scene(SCENE)
    inference_hz = stated.bandwidth.inference_hz
    config = Config(scene=SCENE, rates=Rates(control_hz=case.control_hz, inference_hz=inference_hz))
    terms = terms_of(stated) if case.relaxation else terms_of(stated).without("relaxation")
    core = build_core(config, msgspec.structs.replace(stated, terms=terms))
    frozen = build_core(config, msgspec.structs.replace(stated, terms=msgspec.structs.replace(terms, learning=False)))
    assert stated.finger is not msgspec.UNSET, "a tactile scene has a finger"
    depth_mm = stated.finger.depth_mm
    device = VirtualDevice(load_plant(case.plant), PressingHand(depth_mm), seed=1)
    loop = ClosedLoop(config, core.stepper, core.planner, device)
    loop.arm()

    def asked(now_s: float) -> TimedSetpoint:
        return TimedSetpoint(FORCE_N, math.floor(now_s * inference_hz) / inference_hz, VALID_S)

    for _ in loop.run(PRESSES_AT_S + depth_mm / PRESSING_MM_S + LEARN_S - loop.now_s, asked):
        pass
    if not case.is_learning:
        loop.plan_with(frozen.planner)
    errors, limits, began_s = [], dict[str, int](), loop.now_s
    ticks = round(case.seconds * case.control_hz)
    for tick in range(ticks):
        loop.tick(asked(loop.now_s))
        if tick % case.control_hz:
            continue
        if loop.step_state.safety.faults:
            return case._asdict() | {"force_error": 1.0, "faults": [str(it) for it in loop.step_state.safety.faults]}
        errors.append(loop.device.truth.force_N / FORCE_N - 1.0)
        plan_state = loop.plan_state
        assert plan_state is not None, "this loop plans"
        for limit in plan_state.plan.limits:
            limits[str(limit)] = limits.get(str(limit), 0) + 1
    absolute = np.abs(errors)
    return case._asdict() | {
        "force_error": float(absolute.max()),
        "force_error_10min": float(absolute[: round(TEN_MINUTES_S)].max()),
        "mean_force_error": float(absolute.mean()),
        "last_force_error": float(errors[-1]),
        "gap_mm": loop.device.truth.gap_mm,
        "limits": {name: count / len(errors) for name, count in limits.items()},
        "held_from_s": began_s,
    }


def main() -> int:
    """Holds and prints; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600.0, help="of each hold, virtual (default: 3600)")
    parser.add_argument("--plant", nargs="+", default=PLANTS, metavar="PLANT", help="default: pad_1 pad_2 pad_3")
    parser.add_argument("--control-hz", type=int, default=500, help="default: 500, the scene's own")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    modes = ((True, False), (False, False), (True, True), (False, True))
    cases = [Case(plant, *mode, options.seconds, options.control_hz) for plant in options.plant for mode in modes]
    with ProcessPoolExecutor(options.workers) as pool:
        holds = list(pool.map(hold, cases))
    if options.json:
        write_line(json.dumps({"synthetic": True, "force_N": FORCE_N, "holds": holds}), sys.stdout)
        return 0
    for held in holds:
        write_line(
            f"{held['plant']}  {'with' if held['relaxation'] else 'without':8}relaxation, "
            f"{'learning' if held['is_learning'] else 'frozen':9} worst {held['force_error']:6.2%}, "
            f"mean {held.get('mean_force_error', 1.0):6.2%}, last {held.get('last_force_error', 1.0):+6.2%}",
            sys.stdout,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
