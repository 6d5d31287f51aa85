"""Records bench sweeps of the simulated device through the protocol: the training data of the shipped model.

Like figure 2.7 of the thesis: the gap goes down in steps and up again while the handle moves. It moves as hands do:
both ways, from a creep of 0.5 mm/s to 300 mm/s, with stops and reversals. Each sweep is a record of its own, from a
long rest at the open gap on, and has a number (`cycle`); record 0 is a hold, which shows how the elastomer relaxes.
Every figure in the file passed the wire as protocol bytes: gap from the encoders, force from the force sensor, motion
from the handle's encoder. Kept are the rows in which the handle slides steadily: what friction does before break-away
is the hand's choice and no force law. Synthetic data: the device is the simulator's, on a bench whose stops stand
2.5 mm beyond the stroke at either end, so that the model knows what lies behind the ends of the scenes.
"""

import argparse
import concurrent.futures
import math
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import load_config
from tormagd.control.core import Stepper
from tormagd.control.field_of_gap import FieldOfGap
from tormagd.control.records import Plan
from tormagd.lab.main import Found
from tormagd.lab.training.dataset import Array, Dataset, write_csv
from tormagd.model.displacement import MOBILISED_MM
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.inserts import insert
from tormagd.scenes.scene import Scene, load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand
from tormagd.simulation.parameters import PlantParameters, load_plant, with_insert

SWEEPS = 4
BEYOND_MM = 2.0
"The sweeps go so far beyond the scene's gaps."
STOPS_MM = 2.5
"The bench's switches stand so far beyond the scene's gaps."
BENCH_MOST_N = 20.0
GAP_STEP_MM = 3.0
HOLD_GAP_MM, HOLD_STROKES = 46.0, 150
BEGIN_S = 8.0
"Connecting, homing and enabling are over by then, and the handle begins to move."
CREEP_MM_S, FASTEST_MM_S = 0.5, 310.0
EVEN_S, EVEN_MM = 0.3, 4.0
"The handle keeps a speed for so long, and for so much travel: at a creep friction takes millimetres to settle."
SPEEDS = 3
"Of each stroke, there and back."
STOP_S = 0.1
RATE_TICKS = 50
"On either side, over which a rate is taken: one count of the handle's encoder is 8 um."
STEADY_SHARE, STEADY_MM_S = 0.02, 0.2
SETTLED_MM, MOBILISED_AFTER_MM = 3.0, 6.0
"Travel after the speed or the gap has changed; and after the handle has turned, which bends every bristle over."
RESTING_GAP_MM_S = 0.5
EVERY = 20
"Every twentieth tick is kept: 50 Hz, because neighbouring ticks say nearly the same."


class Course(NamedTuple):
    """One record: the gaps, mm, one for each stroke of the handle, there and back, and the seed of hand and noise."""

    gaps_mm: tuple[float, ...]
    seed: int


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of `tormag-lab bench-sweep`."""
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--scene", default="coronary", help="whose insert and gap range are swept")
    parser.add_argument("--out", type=Path, required=True, help="training CSV to write")
    parser.add_argument("--seed", type=int, default=1)


def run(options: argparse.Namespace) -> Found:
    """Writes the training CSV."""
    data = record(options.plant, options.scene, options.seed)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_csv(options.out, data)
    told = f"{len(data)} rows in {options.out} (synthetic: plant {options.plant}, seed {options.seed})"
    return Found({"out": str(options.out), "rows": len(data), "synthetic": True}, [told])


def record(plant: str, scene_name: str, seed: int) -> Dataset:
    """SWEEPS sweeps and a hold; `cycle` is the number of the record, `time_s` counts from its rest."""
    scene = load_scene(scene_name)
    courses = [Course((HOLD_GAP_MM,) * HOLD_STROKES, seed + SWEEPS)]  # the longest first
    courses += [sweep_course(scene, seed + number) for number in range(SWEEPS)]
    with concurrent.futures.ProcessPoolExecutor() as pool:
        waiting = [pool.submit(swept, plant, scene_name, course) for course in courses]
        bar = tqdm(waiting, desc="records", unit="record", disable=None)
        tables = [future.result() for future in bar]
    time_s, rate_mm_s, field_mT, force_N = np.concatenate(tables).T
    cycle = np.repeat(np.arange(len(tables)), [len(rows) for rows in tables])
    cip_percent = np.full_like(rate_mm_s, 100.0 * insert(scene.insert.name).cip_fraction)
    features = np.column_stack((np.full_like(rate_mm_s, MOBILISED_MM), rate_mm_s, field_mT, cip_percent))
    return Dataset(features, force_N, cycle, time_s)


def sweep_course(scene: Scene, seed: int) -> Course:
    """Down and up, the steps of each sweep at gaps of its own; both ends are reached."""
    closed_mm, open_mm = scene.insert.gap_closed_mm - BEYOND_MM, scene.insert.gap_open_mm + BEYOND_MM
    offset_mm = np.random.default_rng(seed).uniform(0.0, GAP_STEP_MM)
    between = np.arange(open_mm - offset_mm, closed_mm, -GAP_STEP_MM)
    down = (open_mm, *between.tolist(), closed_mm)
    return Course((*down, *down[::-1]), seed)


def swept(plant: str, scene_name: str, course: Course) -> Array:
    """The rows of one record (n x 4): time_s, rate_mm_s, field_mT, force_N along the motion."""
    config, scene = load_config(None), bench_scene(load_scene(scene_name))
    fitted = insert(scene.insert.name)
    field = FieldOfGap(PowerFieldLaw(), fitted.elastomer.relative_permeability, scene.insert.inner_radius_mm * 1e-3)
    hand, ends_s = strokes(len(course.gaps_mm), course.seed)
    device = VirtualDevice(bench(with_insert(load_plant(plant), scene.insert.name), scene), hand, seed=course.seed)
    loop = ClosedLoop(config, Stepper(config, scene), None, device)
    loop.arm(_plan(scene.insert.gap_open_mm, 0.0))
    while loop.now_s < BEGIN_S:
        loop.tick(plan=_plan(scene.insert.gap_open_mm, loop.now_s))
    rows = []
    for gap_mm, end_s in zip(course.gaps_mm, ends_s, strict=True):
        while loop.now_s < end_s:
            sample = loop.tick(plan=_plan(gap_mm, loop.now_s))
            measured = sample.measured
            if measured is None or sample.safety.faults:
                raise RuntimeError(f"the sweep ended at {gap_mm:.1f} mm: {sample.safety}")
            signed_N = measured.force_N * measured.handle.turn.direction
            rows.append((loop.now_s, measured.handle_mm, measured.gap_mm, signed_N))
    time_s, handle_mm, gap_mm, signed_N = np.array(rows).T
    rate_mm_s, slides = sliding(handle_mm, gap_mm)
    kept = np.flatnonzero(slides)[::EVERY]
    field_mT = np.array([field.field_mT(gap) for gap in gap_mm[kept].tolist()])
    along_N = signed_N[kept] * np.sign(rate_mm_s[kept])
    return np.column_stack((time_s[kept], np.abs(rate_mm_s[kept]), field_mT, along_N))


def sliding(handle_mm: Array, gap_mm: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """The handle's rate, mm/s, at each tick, and where it has slid steadily, at a steady gap, for long enough."""
    rate_mm_s, is_even = _even(handle_mm)
    _, is_resting = _even(gap_mm, RESTING_GAP_MM_S)
    slides = np.zeros(len(handle_mm), dtype=np.bool_)
    direction, changed_mm, turned_mm = 0.0, 0.0, 0.0
    for tick, (position_mm, rate, is_steady) in enumerate(
        zip(handle_mm.tolist(), rate_mm_s.tolist(), (is_even & is_resting).tolist(), strict=True)
    ):
        if abs(rate) < CREEP_MM_S / 2.0 or not is_steady:
            changed_mm = position_mm
        elif math.copysign(1.0, rate) != direction:
            direction, changed_mm, turned_mm = math.copysign(1.0, rate), position_mm, position_mm
        slides[tick] = (
            abs(position_mm - changed_mm) >= SETTLED_MM and abs(position_mm - turned_mm) >= MOBILISED_AFTER_MM
        )
    return rate_mm_s, slides


def _even(position_mm: Array, changes_mm_s: float = STEADY_MM_S) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Rate over a window around each tick, mm/s, and whether it is the same in both halves of the window."""
    gone = (position_mm[RATE_TICKS:] - position_mm[:-RATE_TICKS]) / RATE_TICKS * 1e3
    edge = np.zeros(RATE_TICKS)
    before, after = np.concatenate((edge, gone)), np.concatenate((gone, edge))
    rate_mm_s = (before + after) / 2.0
    return rate_mm_s, np.abs(after - before) <= STEADY_SHARE * np.abs(rate_mm_s) + changes_mm_s


def bench_scene(scene: Scene) -> Scene:
    """The scene with the gaps that the bench's switches allow."""
    stroke = msgspec.structs.replace(
        scene.insert,
        gap_closed_mm=scene.insert.gap_closed_mm - BEYOND_MM,
        gap_open_mm=scene.insert.gap_open_mm + STOPS_MM,
    )
    # and no force that they give is a fault there
    return msgspec.structs.replace(
        scene, insert=stroke, force=msgspec.structs.replace(scene.force, most_N=BENCH_MOST_N)
    )


def bench(plant: PlantParameters, scene: Scene) -> PlantParameters:
    """The device on the bench: switches further apart, and at rest at the open gap for long."""
    home_mm = scene.insert.gap_open_mm / 2.0
    stops = msgspec.structs.replace(
        plant.assumed,
        home_mm=home_mm,
        closed_mm=scene.insert.gap_closed_mm / 2.0 - 0.25,
        start_left_mm=home_mm - 0.5,
        start_right_mm=home_mm - 0.5,
    )
    return msgspec.structs.replace(plant, assumed=stops)


def _plan(gap_mm: float, now_s: float) -> Plan:
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())


def strokes(count: int, seed: int) -> tuple[RecordedHand, list[float]]:
    """The hand from BEGIN_S on, and when each of its `count` strokes ends. A stroke goes there and back at speeds drawn
    evenly over their logarithm; the first of either way is fast enough to mobilise friction before a creep."""
    random = np.random.default_rng(seed)
    times, positions, ends_s = [BEGIN_S], [0.0], []
    for _ in range(count):
        for direction in (1.0, -1.0):
            speeds = np.exp(random.uniform(np.log(CREEP_MM_S), np.log(FASTEST_MM_S), SPEEDS))
            speeds[0] = random.uniform((MOBILISED_AFTER_MM + SETTLED_MM) / EVEN_S, FASTEST_MM_S)
            for speed in speeds.tolist():
                lasts_s = max(EVEN_S, EVEN_MM / speed)
                times.append(times[-1] + lasts_s)
                positions.append(positions[-1] + direction * speed * lasts_s)
            times.append(times[-1] + STOP_S)
            positions.append(positions[-1])
        ends_s.append(times[-1])
    return RecordedHand(tuple(times), tuple(positions)), ends_s
