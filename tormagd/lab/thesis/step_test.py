"""Figure 2.7: the gap goes down in steps while the handle turns at 20 rpm, on the simulated device in virtual time.

Force and gap are what the host measures through the protocol. Synthetic data: the device is the simulator's plant
sample 1, with the insert's modulus, permeability and friction in place of its own.
"""

from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from tormagd.closed_loop import ClosedLoop
from tormagd.config import load_config
from tormagd.control.core import Stepper
from tormagd.control.records import Plan
from tormagd.physics.inserts import Insert
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

Array = npt.NDArray[np.float64]

GAPS_MM = (94.5, 85.0, 75.0, 65.0, 55.0, 45.5)
"The thesis's steps; the first and the last stay half a millimetre clear of the end stops."
HOLD_S = 5.0
SETTLED_S = 1.0
"The last second of each step is its level."
EVERY = 10


class StepTest(NamedTuple):
    """The record of one insert, and the settled gap and force of each step."""

    insert: str
    time_s: Array
    gap_mm: Array
    force_N: Array
    level_gap_mm: Array
    level_force_N: Array


MOST_N = 20.0
"On a bench no force that the closed gap gives is a fault."


def step_test(fitted: Insert, seed: int) -> StepTest:
    """One insert through all gaps. Raises RuntimeError where the device faults."""
    config, scene = load_config(None), load_scene("coronary")
    scene = msgspec.structs.replace(scene, force=msgspec.structs.replace(scene.force, most_N=MOST_N))
    plant = load_plant("sample_1")
    elastomer = msgspec.structs.replace(
        plant.elastomer,
        shear_modulus_kPa=1e-3 * fitted.elastomer.shear_modulus_Pa,
        relative_permeability=fitted.elastomer.relative_permeability,
        kinetic_friction=fitted.elastomer.friction_coefficient,
    )
    device = VirtualDevice(msgspec.structs.replace(plant, elastomer=elastomer), SteadyHand(), seed=seed)
    loop = ClosedLoop(config, Stepper(config, scene), None, device)
    loop.arm(_plan(GAPS_MM[0], 0.0))
    began_s = loop.now_s
    rows = []
    for gap_mm in GAPS_MM:
        for _ in range(round(HOLD_S / 1e-3)):
            sample = loop.tick(plan=_plan(gap_mm, loop.now_s))
            measured = sample.measured
            if measured is None or sample.safety.faults:
                raise RuntimeError(f"{fitted.name}: the test ended at {gap_mm:g} mm: {sample.safety}")
            rows.append((sample.time_s - began_s, measured.gap_mm, measured.force_N))
    record = np.array(rows)
    settled = record.reshape(len(GAPS_MM), -1, 3)[:, -round(SETTLED_S / 1e-3) :].mean(axis=1)
    time_s, gap_mm, force_N = record[::EVERY].T
    return StepTest(fitted.name, time_s, gap_mm, force_N, settled[:, 1], settled[:, 2])


def _plan(gap_mm: float, now_s: float) -> Plan:
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())
