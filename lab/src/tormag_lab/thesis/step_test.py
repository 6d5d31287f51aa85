"""Figure 2.7: the gap goes down in steps while the handle turns at 20 rpm, on the simulated device in virtual time.

Force and gap are what the host measures through the protocol. The device is plant sample 1 with the insert's modulus,
permeability and friction.
"""

from typing import NamedTuple

import msgspec
import numpy as np

from tormag_lab.arrays import Array
from tormag_lab.training.bench_sweep import BENCH_MOST_N
from tormagd.config import load_config
from tormagd.control.core import Stepper
from tormagd.element.physics.inserts import Insert
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop, gap_plan
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

GAPS_MM = (94.5, 85.0, 75.0, 65.0, 55.0, 45.5)
"The thesis's steps, half a millimetre clear of the end stops."
HOLD_S = 5.0
SETTLED_S = 1.0
"The last second of each step is its level."
EVERY = 10


class StepTest(NamedTuple):
    """One insert's record, thinned, and the settled gap and force of each step."""

    insert: str
    time_s: Array
    force_N: Array
    level_gap_mm: Array
    level_force_N: Array
    rise_s: float
    "Median time from 10 to 90% of a step."

    @property
    def gap_speed_mm_s(self) -> float:
        return 0.8 * float(np.median(-np.diff(self.level_gap_mm))) / self.rise_s


def step_test(fitted: Insert, seed: int) -> StepTest:
    config, scene = load_config(None), load_scene("coronary")
    scene = msgspec.structs.replace(scene, force=msgspec.structs.replace(scene.force, most_N=BENCH_MOST_N))
    plant = load_plant("sample_1")
    elastomer = msgspec.structs.replace(
        plant.elastomer,
        shear_modulus_kPa=1e-3 * fitted.elastomer.shear_modulus_Pa,
        relative_permeability=fitted.elastomer.relative_permeability,
        kinetic_friction=fitted.elastomer.friction_coefficient,
    )
    device = VirtualDevice(msgspec.structs.replace(plant, elastomer=elastomer), SteadyHand(), seed=seed)
    loop = ClosedLoop(config, Stepper(config, scene), None, device)
    loop.arm(gap_plan(GAPS_MM[0], 0.0))
    began_s = loop.now_s
    rows = []
    for gap_mm in GAPS_MM:
        for _ in range(round(HOLD_S / 1e-3)):
            sample = loop.tick(plan=gap_plan(gap_mm, loop.now_s))
            estimate = sample.measured
            if estimate is None or sample.safety.faults:
                raise RuntimeError(f"{fitted.name}: the test ended at {gap_mm:g} mm: {sample.safety}")
            rows.append((sample.time_s - began_s, estimate.gap_mm, estimate.force_N))
    record = np.array(rows)
    settled = record.reshape(len(GAPS_MM), -1, 3)[:, -round(SETTLED_S / 1e-3) :].mean(axis=1)
    time_s, _, force_N = record[::EVERY].T
    gaps_mm, levels_mm = record.reshape(len(GAPS_MM), -1, 3)[1:, :, 1], settled[:, 1]
    done = (levels_mm[:-1, None] - gaps_mm) / (levels_mm[:-1] - levels_mm[1:])[:, None]
    rises_s = 1e-3 * ((done < 0.9).sum(axis=1) - (done < 0.1).sum(axis=1))
    return StepTest(fitted.name, time_s, force_N, levels_mm, settled[:, 2], float(np.median(rises_s)))
