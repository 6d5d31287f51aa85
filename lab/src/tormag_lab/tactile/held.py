"""Hold a force on the synthetic tactile pad for an hour of virtual time, with relaxation and without.

The finger presses, and the device is learned for some seconds. From then on the error of the pad's true force counts,
as a share of the force asked; frozen runs learn no more. With --coarse only the plans run, fifty a second, and the gap
is where they lead. That takes a tenth of the time and is within 0.1 % of the force. A fault ends its hold.
"""

import argparse
import math
import random
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import msgspec
import numpy as np
from tqdm import tqdm

from tormag_lab.errors import LabError
from tormag_lab.main import WORKERS, Found, within
from tormagd.config import Config, Rates
from tormagd.control.assembly.build import build_core
from tormagd.control.move.watch import SENSOR_FAULT_S
from tormagd.control.records import Handle, Measured, Plan, TimedSetpoint
from tormagd.control.safety.codes import Fault
from tormagd.element.model.displacement import Turn
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import PRESSES_AT_S, PRESSING_MM_S, PressingHand
from tormagd.simulation.parameters import PlantError, load_plant
from tormagd.simulation.plant import SimulatedSensor
from tormagd.simulation.pressed_pad import PressedPad

SCENE = "radial_pulse"
PLANTS = ("pad_1", "pad_2", "pad_3")
FORCE_N = 3.55
LEARN_S = 4.0
CONTROL_HZ = 500
COARSE_S = 0.02
VALID_S = 0.1
SHOWN_S = 10.0
MODES = ((True, False), (False, False), (True, True), (False, True))


class Case(NamedTuple):
    plant: str
    relaxation: bool
    is_learning: bool
    seconds: float = 3600.0
    coarse: bool = False


Moment = tuple[float, float, Plan, str]
"Once a second: the pad's true force, N, the gap, mm, the plan, and the fault that ends the hold."


def hold(case: Case) -> dict[str, Any]:
    shares, limits, last_mm, fault = [], Counter[str](), math.nan, ""
    for force_N, gap_mm, plan, fault in (_coarse if case.coarse else _whole)(case):
        if fault:
            break
        shares.append(force_N / FORCE_N - 1.0)
        last_mm = gap_mm
        limits.update(map(str, plan.limits))
    if not shares:
        raise LabError(f"plant {case.plant}: {fault} ends the hold in its first second: allowed is one that is held")
    absolute = np.abs(shares)
    return case._asdict() | {
        "force_error": float(absolute.max()),
        "mean_force_error": float(absolute.mean()),
        "last_force_error": shares[-1],
        "last_gap_mm": last_mm,
        "held_s": len(shares),
        "fault": fault,
        "limits": {name: count / len(shares) for name, count in limits.items()},
        "every_s": SHOWN_S,
        "shares": shares[:: round(SHOWN_S)],
    }


class _Prepared:
    """What both ways to hold need; learning is over at `begins_s`."""

    def __init__(self, case: Case) -> None:
        stated = load_scene(SCENE)
        assert stated.finger is not msgspec.UNSET, "a tactile scene has a finger"
        self.inference_hz = stated.bandwidth.inference_hz
        self.config = Config(scene=SCENE, rates=Rates(control_hz=CONTROL_HZ, inference_hz=self.inference_hz))
        terms = stated.terms if case.relaxation else stated.terms.without("memory")
        self.core = build_core(self.config, msgspec.structs.replace(stated, terms=terms))
        self.hand, self.plant = PressingHand(stated.finger.depth_mm), load_plant(case.plant)
        if self.plant.pad is None:
            raise PlantError(f"plant {case.plant}: allowed is one with a [pad]")
        self.begins_s = PRESSES_AT_S + stated.finger.depth_mm / PRESSING_MM_S + LEARN_S


def _whole(case: Case) -> Iterator[Moment]:
    made = _Prepared(case)
    planner, device = made.core.planner(), VirtualDevice(made.plant, made.hand, seed=1)
    loop = ClosedLoop(made.config, made.core.stepper(), planner, device)
    loop.arm()

    def asked(now_s: float) -> TimedSetpoint:
        return TimedSetpoint(FORCE_N, math.floor(now_s * made.inference_hz) / made.inference_hz, VALID_S)

    for _ in loop.run(made.begins_s - loop.now_s, asked):
        pass
    planner.believe.learns = case.is_learning
    for _ in range(round(case.seconds)):
        for _ in loop.run(1.0, asked):
            pass
        truth = loop.device.truth
        yield truth.force_N, truth.gap_mm, planner.planned, ", ".join(map(str, loop.stepper.safety.faults))


def _coarse(case: Case) -> Iterator[Moment]:
    """Yield a hold by the plans alone, one each COARSE_S."""
    made = _Prepared(case)
    planner = made.core.planner()
    element = PressedPad(made.plant, planner.planned.gap_mm, COARSE_S)
    sensor, depth_mm, each_s = SimulatedSensor(made.plant, random.Random(1)), 0.0, round(1.0 / COARSE_S)
    begins, ends = round(made.begins_s / COARSE_S), round((made.begins_s + case.seconds) / COARSE_S)
    for tick in range(1, ends + 1):
        now_s, before_mm, gap_mm = tick * COARSE_S, depth_mm, planner.planned.gap_mm
        depth_mm = made.hand.position_mm(now_s)
        rate_mm_s = (depth_mm - before_mm) / COARSE_S
        element.advance(now_s, gap_mm, depth_mm, rate_mm_s)
        sensor.advance(now_s, element.force_N)
        handle, half_mm = Handle(depth_mm, rate_mm_s, Turn(1.0, 0.0, depth_mm)), gap_mm / 2.0
        measured = Measured(
            tick, True, now_s, half_mm, half_mm, 0.0, 0.0, sensor.reading_N, handle, depth_mm, now_s, now_s
        )
        plan = planner.plan(now_s, TimedSetpoint(FORCE_N, now_s, VALID_S), measured)
        if tick == begins:
            planner.believe.learns = case.is_learning
        elif tick > begins and tick % each_s == 0:
            is_doubted = plan.sensor_doubted_s > SENSOR_FAULT_S
            yield element.force_N, gap_mm, plan, str(Fault.SENSOR) if is_doubted else ""


def add_options(parser: argparse.ArgumentParser) -> None:
    seconds = within(1.0, 1e6, "s")
    parser.add_argument("--seconds", type=seconds, default=3600.0, help="of each hold, virtual (default: 3600)")
    parser.add_argument("--plant", nargs="+", default=PLANTS, metavar="PLANT", help="default: pad_1 pad_2 pad_3")
    parser.add_argument("--coarse", action="store_true", help="the plans alone, fifty a second")
    parser.add_argument("--workers", type=WORKERS, default=1, help="processes")


def run(options: argparse.Namespace) -> Found:
    cases = [Case(plant, *mode, options.seconds, options.coarse) for plant in options.plant for mode in MODES]
    with ProcessPoolExecutor(options.workers) as pool:
        holds = list(tqdm(pool.map(hold, cases), total=len(cases), desc="holds", disable=None))
    return Found({"synthetic": True, "force_N": FORCE_N, "holds": holds})
