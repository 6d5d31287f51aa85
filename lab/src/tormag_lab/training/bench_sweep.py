"""Record bench sweeps of the simulated device through the protocol: the shipped model's training data. Synthetic.

As in figure 2.7 of the thesis, the gap goes down in steps and up again while the handle moves. It moves as hands do:
both ways, from 0.5 mm/s to 300 mm/s, with stops and reversals. Each sweep is a record (`cycle`) that begins after a
long rest at the open gap. Record 0 is a hold of the last insert, which shows relaxation.

Two kinds of rows are kept. Where the handle slides steadily, the displacement is that of full mobilisation. After a
turn, it counts from where the elastomer bears no force: counted from the turn, more field would at first mean less
force. The bench's stops are 2.5 mm beyond the stroke, so the model knows what lies behind the scenes' ends.
"""

import argparse
import concurrent.futures
import math
from collections.abc import Sequence
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from tqdm import tqdm

from tormag_lab.arrays import Array, Mask
from tormag_lab.main import SEED, Found
from tormag_lab.training.dataset import Dataset, write_csv
from tormagd.config import load_config
from tormagd.control.core import Stepper
from tormagd.control.nominal import FieldOfGap
from tormagd.element.model.displacement import MOBILISED_MM
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.inserts import insert
from tormagd.ground.files import in_place_of
from tormagd.scenes.scene import Scene, load_scene
from tormagd.simulation.closed_loop import ClosedLoop, gap_plan
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand
from tormagd.simulation.parameters import PlantParameters, changed, load_plant, with_insert

SWEEPS = 4
BEYOND_MM = 2.0
STOPS_MM = 2.5
"The bench's switches are this far beyond the scene's gaps."
BENCH_MOST_N = 20.0
"So great that no force of the closed gap is a fault."
GAP_STEP_MM = 3.0
HOLD_GAP_MM, HOLD_STROKES = 46.0, 100
BEGIN_S = 8.0
"Connecting, homing and enabling are over by then."
CREEP_MM_S, FASTEST_MM_S = 0.5, 310.0
EVEN_S, EVEN_MM = 0.3, 4.0
"Least time and travel at one speed: at a creep, friction takes millimetres to settle."
SPEEDS = 3
"Speeds of each way after its first."
STOP_S = 0.3
"Rest after each way, long enough for the gap to arrive."
RATE_TICKS = 50
"Half of the window of a rate: one count of the handle's encoder is 8 um."
STEADY_SHARE, STEADY_MM_S = 0.02, 0.2
SETTLED_MM, MOBILISED_AFTER_MM = 3.0, 6.0
"Travel needed after a change of speed or gap, and after a turn, which bends every bristle over."
LOADING_MM = 3.0
"Travel at a way's first speed: back to no force, and on through mobilisation."
LOADED_MM, LOADED_STEP_MM = 1.5, 0.15
"End and spacing of rows before mobilisation: from there to 2 mm the greatest forces still rise by a tenth."
RESTING_GAP_MM_S = 0.5
EVERY, LOADED_EVERY = 90, 7
"One in so many is kept, of steady ticks and of rows before mobilisation: neighbours are nearly equal."


class Course(NamedTuple):
    """One record to make: the insert, the gap of each stroke there and back, and the seed of hand and noise."""

    insert: str
    gaps_mm: tuple[float, ...]
    seed: int


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--scene", default="coronary", help="whose insert and gap range are swept")
    parser.add_argument("--insert", nargs="+", metavar="NAME", help="other inserts, one after the other")
    parser.add_argument("--out", type=Path, required=True, help="training CSV to write")
    parser.add_argument("--seed", type=SEED, default=1)


def run(options: argparse.Namespace) -> Found:
    data = record(options.plant, options.scene, options.insert, options.seed)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with in_place_of(options.out) as beside:
        write_csv(beside, data)
    return Found({"out": str(options.out), "rows": len(data), "synthetic": True})


def record(plant: str, scene_name: str, inserts: Sequence[str] | None, seed: int) -> Dataset:
    """Record a hold of the last insert and SWEEPS sweeps of each, in parallel."""
    scene = load_scene(scene_name)
    names = inserts or [scene.insert.name]
    courses = [Course(names[-1], (HOLD_GAP_MM,) * HOLD_STROKES, seed + SWEEPS)]  # the longest first
    courses += [sweep_course(scene, name, seed + number) for name in names for number in range(SWEEPS)]
    with concurrent.futures.ProcessPoolExecutor() as pool:
        made = pool.map(swept, repeat(plant), repeat(scene_name), courses)
        tables = list(tqdm(made, total=len(courses), desc="records", unit="record", disable=None))
    time_s, *features, force_N = np.concatenate(tables).T
    cycle = np.repeat(np.arange(len(tables)), [len(rows) for rows in tables])
    return Dataset(np.column_stack(features), force_N, cycle, time_s)


def sweep_course(scene: Scene, name: str, seed: int) -> Course:
    """Return a sweep from the open gap down and up again, in steps of GAP_STEP_MM."""
    closed_mm, open_mm = scene.insert.gap_closed_mm - BEYOND_MM, scene.insert.gap_open_mm + BEYOND_MM
    offset_mm = np.random.default_rng(seed).uniform(0.0, GAP_STEP_MM)
    between = np.arange(open_mm - offset_mm, closed_mm, -GAP_STEP_MM)
    down = (open_mm, *between.tolist(), closed_mm)
    return Course(name, (*down, *down[::-1]), seed)


def swept(plant: str, scene_name: str, course: Course) -> Array:
    """Record one course in virtual time, and return rows (n x 6): time_s, the features, force_N along the motion."""
    scene = bench_scene(load_scene(scene_name), course.insert)
    hand, ends_s = strokes(len(course.gaps_mm), course.seed)
    device = VirtualDevice(bench(with_insert(load_plant(plant), course.insert), scene), hand, seed=course.seed)
    config = load_config(None)
    loop = ClosedLoop(config, Stepper(config, scene), None, device)
    loop.arm(gap_plan(scene.insert.gap_open_mm))
    while loop.now_s < BEGIN_S:
        loop.tick(plan=gap_plan(scene.insert.gap_open_mm, loop.now_s))
    ticks = []
    for gap_mm, end_s in zip(course.gaps_mm, ends_s, strict=True):
        while loop.now_s < end_s:
            sample = loop.tick(plan=gap_plan(gap_mm, loop.now_s))
            estimate = sample.measured
            if estimate is None or sample.safety.faults:
                raise RuntimeError(f"the sweep ended at {gap_mm:.1f} mm: {sample.safety}")
            signed_N = estimate.force_N * estimate.handle.turn.direction
            ticks.append((loop.now_s, estimate.handle_mm, estimate.gap_mm, signed_N))
    return rows_of(np.array(ticks), scene)


def rows_of(ticks: Array, scene: Scene) -> Array:
    """Return the training rows (n x 6) of ticks (m x 4, 1 ms apart): time_s, handle_mm, gap_mm, signed force."""
    _, handle_mm, gap_mm, signed_N = ticks.T
    sliding_mm_s, slides = sliding(handle_mm, gap_mm)
    loading_mm_s, loading_mm = loading(handle_mm, gap_mm, signed_N)
    slid, loaded = np.flatnonzero(slides)[::EVERY], np.flatnonzero(~np.isnan(loading_mm))[::LOADED_EVERY]
    displacement_mm = np.concatenate((np.full(len(slid), MOBILISED_MM), loading_mm[loaded]))
    rate_mm_s = np.concatenate((sliding_mm_s[slid], loading_mm_s[loaded]))
    kept, fitted = np.concatenate((slid, loaded)), insert(scene.insert.name)
    field = FieldOfGap(PowerFieldLaw(), fitted.elastomer.relative_permeability, scene.insert.inner_radius_mm * 1e-3)
    field_mT = np.array([field.field_mT(gap) for gap in gap_mm[kept].tolist()])
    cip_percent = np.full(len(kept), 100.0 * fitted.cip_fraction)
    along_N = signed_N[kept] * np.sign(rate_mm_s)
    rows = np.column_stack((ticks[kept, 0], displacement_mm, np.abs(rate_mm_s), field_mT, cip_percent, along_N))
    return rows[np.argsort(kept, kind="stable")]


def loading(handle_mm: Array, gap_mm: Array, signed_N: Array) -> tuple[Array, Array]:
    """Return rate, mm/s, and travel since no force, mm (NaN where no row is due), at each 1 ms tick."""
    gap_mm_s, is_resting = _even(gap_mm, RESTING_GAP_MM_S)
    is_resting &= np.abs(gap_mm_s) <= RESTING_GAP_MM_S
    gone = (handle_mm[RATE_TICKS:] - handle_mm[:-RATE_TICKS]) / RATE_TICKS * 1e3
    rate_mm_s = np.concatenate((gone, np.zeros(RATE_TICKS)))
    later = np.concatenate((rate_mm_s[RATE_TICKS:], np.zeros(RATE_TICKS)))
    is_even = np.abs(later - rate_mm_s) <= STEADY_SHARE * np.abs(rate_mm_s) + STEADY_MM_S
    way = np.sign(rate_mm_s) * (np.abs(rate_mm_s) >= CREEP_MM_S / 2.0)
    due_mm = np.full(len(handle_mm), np.nan)
    # the ticks of each way, from a turn to a stop
    for ticks in np.split(np.arange(len(way)), np.flatnonzero(np.diff(way)) + 1):
        along_N = signed_N[ticks] * way[ticks[0]]
        borne = np.flatnonzero(along_N >= 0.0)
        if way[ticks[0]] == 0.0 or len(borne) == 0 or borne[0] == 0:
            continue
        first = int(borne[0])
        share = along_N[first] / (along_N[first] - along_N[first - 1])
        unloaded_mm = handle_mm[ticks[first]] - share * (handle_mm[ticks[first]] - handle_mm[ticks[first - 1]])
        rows = ticks[first:][(is_even & is_resting)[ticks[first:]]]
        far_mm = np.abs(handle_mm[rows] - unloaded_mm)
        is_due = np.diff(np.floor(far_mm / LOADED_STEP_MM), prepend=-1.0) > 0.0
        is_due &= far_mm <= LOADED_MM
        due_mm[rows[is_due]] = far_mm[is_due]
    return rate_mm_s, due_mm


def sliding(handle_mm: Array, gap_mm: Array) -> tuple[Array, Mask]:
    """Return the handle's signed rate, mm/s, and a mask of steady sliding, at each 1 ms tick."""
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


def _even(position_mm: Array, changes_mm_s: float = STEADY_MM_S) -> tuple[Array, Mask]:
    gone = (position_mm[RATE_TICKS:] - position_mm[:-RATE_TICKS]) / RATE_TICKS * 1e3
    edge = np.zeros(RATE_TICKS)
    before, after = np.concatenate((edge, gone)), np.concatenate((gone, edge))
    rate_mm_s = (before + after) / 2.0
    return rate_mm_s, np.abs(after - before) <= STEADY_SHARE * np.abs(rate_mm_s) + changes_mm_s


def bench_scene(scene: Scene, name: str) -> Scene:
    stroke = msgspec.structs.replace(
        scene.insert,
        name=name,
        gap_closed_mm=scene.insert.gap_closed_mm - BEYOND_MM,
        gap_open_mm=scene.insert.gap_open_mm + STOPS_MM,
    )
    # no force of these gaps is a fault on the bench
    return msgspec.structs.replace(
        scene, insert=stroke, force=msgspec.structs.replace(scene.force, most_N=BENCH_MOST_N)
    )


def bench(plant: PlantParameters, scene: Scene) -> PlantParameters:
    """Return `plant` with its switches at the gaps of a bench scene."""
    home_mm = scene.insert.gap_open_mm / 2.0
    closed_mm, start_mm = scene.insert.gap_closed_mm / 2.0 - 0.25, home_mm - 0.5
    return changed(
        plant, "assumed", home_mm=home_mm, closed_mm=closed_mm, start_left_mm=start_mm, start_right_mm=start_mm
    )


def strokes(count: int, seed: int) -> tuple[RecordedHand, list[float]]:
    """Return the hand's motion from BEGIN_S on, and the end of each of its `count` strokes, s."""
    random = np.random.default_rng(seed)
    times, positions, ends_s = [BEGIN_S], [0.0], []
    for _ in range(count):
        for direction in (1.0, -1.0):
            speeds = np.exp(random.uniform(np.log(CREEP_MM_S), np.log(FASTEST_MM_S), 1 + SPEEDS))
            speeds[1] = random.uniform((MOBILISED_AFTER_MM + SETTLED_MM) / EVEN_S, FASTEST_MM_S)
            for speed, least_mm in zip(speeds.tolist(), (LOADING_MM, *[EVEN_MM] * SPEEDS), strict=True):
                lasts_s = max(EVEN_S, least_mm / speed)
                times.append(times[-1] + lasts_s)
                positions.append(positions[-1] + direction * speed * lasts_s)
            ends_s.append(times[-1])
            times.append(times[-1] + STOP_S)
            positions.append(positions[-1])
    return RecordedHand(tuple(times), tuple(positions)), ends_s[1::2]
