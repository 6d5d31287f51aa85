"""Hold a force on the synthetic tactile pad for an hour of virtual time, with relaxation and without.

The finger presses, and the device is learned for some seconds. From then on the error of the pad's true force counts,
as a share of the force asked; frozen runs learn no more. Only the plans run, fifty a second, and the gap is where they
lead: within 0.1 % of the force of the whole device. A fault ends its hold.
"""

import argparse
import random
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
from tormagd.control.records import Handle, Measured, TimedSetpoint
from tormagd.control.safety.codes import Fault
from tormagd.element.model.displacement import Turn
from tormagd.scenes.scene import load_scene
from tormagd.simulation.hand import PRESSES_AT_S, PRESSING_MM_S, PressingHand
from tormagd.simulation.parameters import PlantError, load_plant
from tormagd.simulation.plant import SimulatedSensor
from tormagd.simulation.pressed_pad import PressedPad

SCENE = "radial_pulse"
PLANTS = ("pad_1", "pad_2", "pad_3")
FORCE_N = 3.55
LEARN_S = 4.0
PLAN_S = 0.02
VALID_S = 0.1
MODES = ((True, False), (False, False), (True, True), (False, True))


class Case(NamedTuple):
    plant: str
    relaxation: bool
    is_learning: bool
    seconds: float = 3600.0


def hold(case: Case) -> dict[str, Any]:
    shares, fault = [], ""
    for force_N, fault in _held(case):
        if fault:
            break
        shares.append(force_N / FORCE_N - 1.0)
    if not shares:
        raise LabError(f"plant {case.plant}: {fault} ends the hold in its first second: allowed is one that is held")
    absolute = np.abs(shares)
    return case._asdict() | {
        "force_error": float(absolute.max()),
        "mean_force_error": float(absolute.mean()),
        "last_force_error": shares[-1],
        "held_s": len(shares),
        "fault": fault,
    }


def _held(case: Case) -> Iterator[tuple[float, str]]:
    """Yield once a second the pad's true force, N, and the fault that ends the hold."""
    stated, plant = load_scene(SCENE), load_plant(case.plant)
    assert stated.finger is not msgspec.UNSET, "a tactile scene has a finger"
    if plant.pad is None:
        raise PlantError(f"plant {case.plant}: allowed is one with a [pad]")
    terms = stated.terms if case.relaxation else stated.terms.without("memory")
    config = Config(scene=SCENE, rates=Rates(control_hz=500, inference_hz=stated.bandwidth.inference_hz))
    planner = build_core(config, msgspec.structs.replace(stated, terms=terms)).planner()
    hand, element = PressingHand(stated.finger.depth_mm), PressedPad(plant, planner.planned.gap_mm, PLAN_S)
    begins_s = PRESSES_AT_S + stated.finger.depth_mm / PRESSING_MM_S + LEARN_S
    sensor, depth_mm, each_s = SimulatedSensor(plant, random.Random(1)), 0.0, round(1.0 / PLAN_S)
    begins, ends = round(begins_s / PLAN_S), round((begins_s + case.seconds) / PLAN_S)
    for tick in range(1, ends + 1):
        now_s, before_mm, gap_mm = tick * PLAN_S, depth_mm, planner.planned.gap_mm
        depth_mm = hand.position_mm(now_s)
        rate_mm_s = (depth_mm - before_mm) / PLAN_S
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
            yield element.force_N, str(Fault.SENSOR) if is_doubted else ""


def add_options(parser: argparse.ArgumentParser) -> None:
    seconds = within(1.0, 1e6, "s")
    parser.add_argument("--seconds", type=seconds, default=3600.0, help="of each hold, virtual (default: 3600)")
    parser.add_argument("--plant", nargs="+", default=PLANTS, metavar="PLANT", help="default: pad_1 pad_2 pad_3")
    parser.add_argument("--workers", type=WORKERS, default=1, help="processes")


def run(options: argparse.Namespace) -> Found:
    cases = [Case(plant, *mode, options.seconds) for plant in options.plant for mode in MODES]
    with ProcessPoolExecutor(options.workers) as pool:
        holds = list(tqdm(pool.map(hold, cases), total=len(cases), desc="holds", disable=None))
    return Found({"synthetic": True, "force_N": FORCE_N, "holds": holds})
