"""Records a bench sweep of the simulated device through the backend: the training data of the shipped model.

Like figure 2.7 of the thesis: the gap goes down in steps and up again, at each step the handle turns to and fro at
several speeds. Every figure in the file passed the wire as protocol bytes: gap from the encoders, force from the force
sensor, motion from the handle's encoder. Synthetic data: the device is the simulator's.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import load_config
from tormagd.control.estimate import Estimate
from tormagd.control.plan import Plan
from tormagd.control.portrait import FieldOfGap
from tormagd.control.step import Stepper
from tormagd.learning.dataset import Dataset, write_csv
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.inserts import insert
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand
from tormagd.simulation.parameters import load_plant

GAP_STEP_MM = 2.5
SETTLE_S = 1.2
"Longer than a 2.5 mm step and what the elastomer relaxes at once after it."
SPEEDS_MM_S = (42.0, 42.0, 20.0, 8.0, 55.0, 42.0)
"Handle speeds at each gap; mostly the thesis's 20 rpm, which is 42 mm/s at the roller."
TRAVEL_MM = 12.0
"Handle travel between reversals: far beyond break-away."
STOP_S = 0.05
EVERY = 4
"Every fourth tick is kept: 250 Hz, because neighbouring ticks say nearly the same."


def main() -> int:
    """Writes the training CSV; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--scene", default="coronary", help="whose insert and gap range are swept")
    parser.add_argument("--out", type=Path, required=True, help="training CSV to write")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    data = sweep(options.plant, options.scene, options.seed)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_csv(options.out, data)
    print(f"{len(data.force_N)} rows in {options.out} (synthetic: plant {options.plant}, seed {options.seed})")
    return 0


def sweep(plant: str, scene_name: str, seed: int) -> Dataset:
    """The data of one sweep, down and up again."""
    config, scene = load_config(None), load_scene(scene_name)
    fitted = insert(scene.insert.name)
    field = FieldOfGap(PowerFieldLaw(), fitted.elastomer.relative_permeability, scene.insert.inner_radius_mm * 1e-3)
    closed, opened = scene.insert.gap_closed_mm + 0.5, scene.insert.gap_open_mm - 0.5
    down = np.arange(opened, closed - 1e-9, -GAP_STEP_MM)
    gaps = [float(gap) for gap in (*down, *down[::-1])]
    hand = ToAndFro()
    device = VirtualDevice(load_plant(plant), hand, seed=seed)
    loop = ClosedLoop(config, Stepper(config, scene), None, device)
    loop.arm(_plan(opened, 0.0))
    rows, forces = [], []
    for gap in tqdm(gaps, desc="gap steps", unit="step", disable=not sys.stderr.isatty()):
        for tick, estimate in enumerate(_hold(loop, gap, SETTLE_S + hand.period_s)):
            if tick * 1e-3 >= SETTLE_S and tick % EVERY == 0:
                handle = estimate.handle
                rows.append((handle.displacement_mm, abs(handle.rate_mm_s), field.field_mT(estimate.gap_mm)))
                forces.append(estimate.force_N)
    features = np.column_stack([np.array(rows), np.full(len(rows), 100.0 * fitted.cip_fraction)])
    return Dataset(features, np.array(forces))


def _hold(loop: ClosedLoop, gap_mm: float, duration_s: float) -> Iterator[Estimate]:
    for _ in range(round(duration_s * 1e3)):
        sample = loop.tick(plan=_plan(gap_mm, loop.now_s))
        if sample.state.estimate is None or sample.state.safety.faults:
            raise RuntimeError(f"the sweep ended at {gap_mm:.1f} mm: {sample.state.safety}")
        yield sample.state.estimate


def _plan(gap_mm: float, now_s: float) -> Plan:
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())


class ToAndFro:
    """A hand that goes to and fro at each speed, with a short stop at every reversal, and begins again."""

    def __init__(self) -> None:
        times, positions = [0.0], [0.0]
        for speed in SPEEDS_MM_S:
            for position in (TRAVEL_MM, 0.0):
                times += [times[-1] + TRAVEL_MM / speed, times[-1] + TRAVEL_MM / speed + STOP_S]
                positions += [position, position]
        self._round = RecordedHand(tuple(times), tuple(positions))
        self.period_s = times[-1]

    def position_mm(self, time_s: float) -> float:
        """Travel of the roller surface, mm."""
        return self._round.position_mm(math.fmod(time_s, self.period_s))


if __name__ == "__main__":
    sys.exit(main())
