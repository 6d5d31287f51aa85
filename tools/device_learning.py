"""How soon and how well the controller knows a device: what is left of the force's error, in virtual time.

    device_learning.py [steps|creep|speeds|drift|pulse ...] [--draws N] [--drift-s S] [--tuning] [--json]

Forces are the simulated plant's at the roller; nothing is subtracted from an error. A step has *arrived* ARRIVES_S
after the device's ideal carriages (`tools/rendering/ideal_carriage.py`) would have brought the force. Devices are the
three samples and draws 40 to 79 of the plant card; but for sample 1 they only judge. `--tuning` takes those that
constants may be chosen on: sample 1 and draws 0 to 39. All devices are synthetic.
"""

import argparse
import concurrent.futures
import itertools
import json
import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from bound import HAND_MM_S, asked_of, no_delay_mm
from envelope import FIRST_DRAW, SCENE, armed, asked_at, device, open_gap_N
from force_tracking import PULSE_S, pulse, track
from rendering.ideal_carriage import brake_of, drive_of
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.governor import TimedSetpoint
from tormagd.control.plan import NOTHING_SHOWN, Shown
from tormagd.control.profile import profile_of
from tormagd.control.slow_friction import believable
from tormagd.safety.codes import Limit
from tormagd.simulation.parameters import PlantParameters

Array = npt.NDArray[np.float64]
Json = dict[str, Any]
Levels = list[tuple[float, float]]

DRAWS = 40
VALID_S = 0.25
HIGH_N, LOW_N, ABOVE_N = 2.0, 0.7, 0.1
"Steps begin at LOW_N, or ABOVE_N over what the open gap brakes where that is more."
ARRIVES_S, LATER_S = 0.25, 1.0
IDEAL_N = 0.01
"The ideal carriages have brought a force that is as close."
STEPS = (("up", "down"), ("up again", "down again"), ("up known", "down known"))
"Of a fresh device; the same after REST_S; and after it was started again with its profile."
STEP_S, REST_S = 3.0, 30.0
MEAN_S = 0.05
CREEP_MM_S, CREPT_MM = 1.0, 10.0
CREEP_N = (1.0, 2.0, 0.8)
SPEEDS_MM_S, SPEED_S, SLID_S = (1.0, 42.0, 100.0, 300.0), 4.0, 1.0
SPEEDS_N = (1.0, 2.0)
DRIFT_MN_MIN, DRIFT_S, DRIFT_N, TURN_S = 5.0, 3600.0, 1.0, 10.0
DRIFT_MEAN_S = 1.0
MODEL_HASH = "0" * 64


class Course(NamedTuple):
    """What a run showed, a row a millisecond: the time since it began, the true force along the motion less the one
    asked, N, and whether a learned value stood at its rail; and what the device had shown in the end."""

    time_s: Array
    error_N: Array
    is_railed: npt.NDArray[np.bool_]
    faults: tuple[str, ...]
    shown: Shown

    def mean_N(self, begins_s: float, lasts_s: float = MEAN_S) -> float:
        """The mean error over a while."""
        return float(self.error_N[(self.time_s >= begins_s) & (self.time_s < begins_s + lasts_s)].mean())

    def worst_N(self, begins_s: float, ends_s: float) -> float:
        """The greatest of the means over MEAN_S in between."""
        return max(abs(self.mean_N(at_s)) for at_s in np.arange(begins_s, ends_s - MEAN_S, MEAN_S))


def course(
    plant: PlantParameters, legs: list[tuple[float, float]], levels: Levels, shown: Shown = NOTHING_SHOWN
) -> Course:
    """One run: the hand along its legs (s, mm/s), the force along its levels (s, N), with a device that counts as
    having `shown` so much of itself."""
    config = Config(scene=SCENE)
    loop = armed(config, plant, legs, shown)
    begins_s, asked_N = loop.now_s, asked_at(levels)
    rows: list[tuple[float, float, bool]] = []
    faults: tuple[str, ...] = ()
    for sample in loop.run(
        sum(lasts_s for lasts_s, _ in levels), lambda now_s: TimedSetpoint(asked_N(now_s - begins_s), now_s, VALID_S)
    ):
        truth = sample.truth
        since_s = truth.time_s - begins_s
        along_N = truth.force_N if truth.handle_mm_s >= 0.0 else -truth.force_N
        rows.append((since_s, along_N - asked_N(since_s), is_railed(loop, config)))
        faults = tuple(map(str, sample.state.safety.faults))
        if faults:
            break
    time_s, error_N, railed = zip(*rows, strict=True)
    assert loop.plan_state is not None
    return Course(np.array(time_s), np.array(error_N), np.array(railed), faults, loop.plan_state.shown)


def is_railed(loop: ClosedLoop, config: Config) -> bool:
    """Whether a learned value stands at its bound."""
    assert loop.plan_state is not None
    shown = loop.plan_state.shown
    return shown.device.scale in (config.trim.least, config.trim.most) or (
        shown.slow.learned > 0.0 and shown.slow.factor in believable(shown.device, shown.slow.followed_N)
    )


# -- steps ---------------------------------------------------------------------------------------------------------


def low_N(plant: PlantParameters) -> float:
    """Where the steps of a device begin."""
    return max(LOW_N, open_gap_N(plant)(HAND_MM_S) + ABOVE_N)


def ideal_s(plant: PlantParameters) -> tuple[float, float]:
    """After how long the ideal carriages have brought the force up, and down again."""
    brake, rest, hold = brake_of(plant), 0.3, 2.0
    levels = asked_at([(rest, low_N(plant)), (hold, HIGH_N), (hold, low_N(plant))])
    time_s = 1e-3 * np.arange(round((rest + 2.0 * hold) * 1e3))
    asked = asked_of(
        brake, np.array([levels(at_s) for at_s in time_s.tolist()]), most_N=HIGH_N, hand_mm_s=HAND_MM_S, step_s=1e-3
    )
    reached_N = asked.rendered_N(brake, no_delay_mm(drive_of(plant), brake, asked, 1e-3))
    found = []
    for begins_s in (rest, rest + hold):
        on_way = (time_s >= begins_s) & (time_s < begins_s + hold)
        far = np.flatnonzero(np.abs(reached_N - asked.force_N)[on_way] > IDEAL_N)
        found.append(1e-3 * float(far[-1] + 1 if far.size else 0))
    return found[0], found[1]


def step_figures(found: Course, begins_s: float, ideal: float, direction: float) -> Json:
    """Of one step."""
    arrives_s = begins_s + ideal + ARRIVES_S
    held = (found.time_s >= begins_s + ideal) & (found.time_s < begins_s + STEP_S)
    return {
        "arrived_N": found.mean_N(arrives_s),
        "later_N": found.mean_N(arrives_s + LATER_S),
        "overshoot_N": float((direction * found.error_N[held]).max()),
    }


def steps(name: str) -> Json:
    """Up and down on a fresh device, the same after REST_S, and once it was started again with its profile."""
    plant = device(name)
    up_s, down_s = ideal_s(plant)
    low = low_N(plant)
    once = [(1.0, 0.0), (STEP_S, low), (STEP_S, HIGH_N)]
    fresh = course(plant, [(90.0, HAND_MM_S)], [*once, (REST_S, low), (STEP_S, HIGH_N), (STEP_S, low)])
    kept = profile_of(fresh.shown, serial_number=1, insert="MRE", model=MODEL_HASH, saved_ns=0)
    known = course(plant, [(90.0, HAND_MM_S)], [*once, (STEP_S, low)], kept.shown(3_600_000_000_000))
    first_s, again_s = 1.0 + STEP_S, 1.0 + 2.0 * STEP_S + REST_S
    courses = (fresh, first_s), (fresh, again_s), (known, first_s)
    result: Json = {"faults": [*fresh.faults, *known.faults]}
    for (up, down), (found, begins_s) in zip(STEPS, courses, strict=True):
        result[up] = step_figures(found, begins_s, up_s, 1.0)
        result[down] = step_figures(found, begins_s + STEP_S, down_s, -1.0)
    return result


# -- handles -------------------------------------------------------------------------------------------------------


def creep(name: str) -> Json:
    """A handle at CREEP_MM_S: of each force the error after CREPT_MM, from a handle that was faster before and from one
    that never was."""
    plant, result = device(name), {}
    hold_s = CREPT_MM / CREEP_MM_S + 2.0
    for key, lead_s in (("after speed", 3.0), ("only", 0.0)):
        levels = [(lead_s + hold_s, CREEP_N[0]), *((hold_s, force_N) for force_N in CREEP_N[1:])]
        found = course(plant, [*([(lead_s, HAND_MM_S)] if lead_s else []), (90.0, CREEP_MM_S)], levels)
        ends_s = [lead_s + hold_s * (1 + place) for place in range(len(CREEP_N))]
        result[key] = {
            "worst_N": [found.worst_N(end_s - 2.0, end_s) for end_s in ends_s],
            "railed": float(found.is_railed.mean()),
            "faults": found.faults,
        }
    return result


def tour() -> list[float]:
    """Speeds in an order in which every one follows every other."""
    found, left = [SPEEDS_MM_S[0]], set(itertools.permutations(SPEEDS_MM_S, 2))
    while left:
        # the fastest of those that have not followed it: so the slowest, the first, is always left to go on from
        after = max(fast for slow, fast in left if slow == found[-1])
        left.remove((found[-1], after))
        found.append(after)
    return found


def speeds(name: str) -> Json:
    """Every speed after every other: the worst error from SLID_S on."""
    plant, result = device(name), {}
    legs = [(SPEED_S, speed) for speed in tour()]
    for force_N in SPEEDS_N:
        found = course(plant, legs, [(SPEED_S * len(legs), force_N)])
        pairs = itertools.pairwise(speed for _, speed in legs)
        worst = {
            f"{before:g} to {after:g} mm/s": found.worst_N(SPEED_S * (place + 1) + SLID_S, SPEED_S * (place + 2))
            for place, (before, after) in enumerate(pairs)
        }
        result[f"{force_N:g} N"] = {"worst_N": worst, "railed": float(found.is_railed.mean()), "faults": found.faults}
    return result


# -- the sensor, and what the model knows alone ---------------------------------------------------------------------


def drift(name: str, lasts_s: float = DRIFT_S) -> Json:
    """A force sensor that drifts, with a handle that turns back every TURN_S, and one that never does: the worst error
    of a second's mean, and how far the force went from when OFFSET_UNKNOWN was first shown."""
    plant = device(name)
    sensor = msgspec.structs.replace(plant.force_sensor, drift_mN_min=DRIFT_MN_MIN)
    plant = msgspec.structs.replace(plant, force_sensor=sensor)
    turns = [(TURN_S, HAND_MM_S), (TURN_S, -HAND_MM_S)] * round(lasts_s / TURN_S / 2.0)
    result: Json = {}
    for key, legs in (("turning", turns), ("one_way", [(lasts_s, HAND_MM_S)])):
        loop = armed(Config(scene=SCENE), plant, legs)
        begins_s, means_N, unknown_s = loop.now_s, [], None
        second: list[float] = []
        for sample in loop.run(lasts_s, lambda now_s: TimedSetpoint(DRIFT_N, now_s, VALID_S)):
            if unknown_s is None and Limit.OFFSET_UNKNOWN in sample.plan.limits:
                unknown_s = sample.time_s - begins_s
            second.append(abs(sample.truth.force_N) - DRIFT_N)
            if len(second) == round(DRIFT_MEAN_S * 1e3):
                means_N.append(sum(second, 0.0) / len(second))
                second.clear()
        errors_N = np.array(means_N)
        # the second in which the handle turned says nothing, and the first ones arrive
        settled = np.array(
            [at >= 3 and at % round(TURN_S) not in (0, round(TURN_S) - 1) for at in range(len(errors_N))]
        )
        known_N = errors_N[: round(unknown_s)] if unknown_s is not None else errors_N
        result[key] = {
            "worst_N": float(np.abs(errors_N[settled]).max()),
            "unknown_after_s": unknown_s,
            "drifted_on_N": float(np.abs(errors_N[len(known_N) :] - known_N[-1]).max(initial=0.0)),
        }
    return result


def rendered_pulse(name: str) -> Json:
    """RMS error of the pulse of `make run`, N: by the model alone, with the device learned before and nothing more of
    it, and while it is learned."""
    plant, played = device(name), pulse(PULSE_S)
    learning = track(plant, played, "pulse", 0.0)
    learned = track(plant, played, "pulse", 0.0, is_learning=False, shown=learning.shown.replaced(read=-1, read_s=0.0))
    alone = track(plant, played, "pulse", 0.0, is_learning=False)
    return {
        key: found.since(0.0).rms_N
        for key, found in (("model alone", alone), ("learned before", learned), ("while learned", learning))
    }


# -- all of it -----------------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[str], Json]] = {
    "steps": steps,
    "creep": creep,
    "speeds": speeds,
    "drift": drift,
    "pulse": rendered_pulse,
}


def measure(parts: list[str], draws: int, drift_s: float, *, is_tuning: bool, jobs: int) -> Json:
    """The figures of every device, by part; drift and pulse only of the samples."""
    samples = ["sample_1"] if is_tuning else ["sample_1", "sample_2", "sample_3"]
    first = 0 if is_tuning else FIRST_DRAW
    drawn = [f"draw {number}" for number in range(first, first + draws)]
    runs = [(part, name) for part in parts for name in (samples if part in ("drift", "pulse") else [*samples, *drawn])]
    with concurrent.futures.ProcessPoolExecutor(max_workers=jobs) as pool:
        waiting = [
            pool.submit(drift, name, drift_s) if part == "drift" else pool.submit(PARTS[part], name)
            for part, name in runs
        ]
        bar = tqdm(waiting, desc="runs", unit="run", disable=not sys.stderr.isatty())
        result: Json = {part: {} for part in parts}
        for (part, name), future in zip(runs, bar, strict=True):
            result[part][name] = future.result()
    return result


def worst(found: dict[str, float]) -> str:
    """The worst of all devices in mN, which it is, and the median."""
    name = max(found, key=lambda name: found[name])
    return f"{found[name] * 1e3:4.0f} mN ({name}), median {np.median(list(found.values())) * 1e3:3.0f}"


def print_table(result: Json) -> None:
    """For a person."""
    steps, creep, speeds = (result.get(part, {}) for part in ("steps", "creep", "speeds"))
    for key in itertools.chain(*STEPS) if steps else ():
        of_devices = {name: row[key] for name, row in steps.items()}
        print(
            f"step {key:11s}"
            + "; ".join(
                f"{figure[:-2]} {worst({name: abs(row[figure]) for name, row in of_devices.items()})}"
                for figure in ("arrived_N", "later_N", "overshoot_N")
            )
        )
    for key in ("after speed", "only") if creep else ():
        for place, force_N in enumerate(CREEP_N):
            errors_N = {name: row[key]["worst_N"][place] for name, row in creep.items()}
            print(f"{CREEP_MM_S:g} mm/s, {key:11s} {force_N} N  {worst(errors_N)}")
        print(f"{CREEP_MM_S:g} mm/s, {key:11s} at a rail: {railed({name: row[key] for name, row in creep.items()})}")
    for force_N in SPEEDS_N if speeds else ():
        rows = {name: row[f"{force_N:g} N"] for name, row in speeds.items()}
        for pair in next(iter(rows.values()))["worst_N"]:
            print(f"{force_N:g} N, {pair:16s} {worst({name: row['worst_N'][pair] for name, row in rows.items()})}")
        print(f"{force_N:g} N, at a rail: {railed(rows)}")
    for name, row in result.get("drift", {}).items():
        for key, found in row.items():
            print(
                f"drift, {name}, {key}: worst {found['worst_N'] * 1e3:.0f} mN, OFFSET_UNKNOWN after "
                f"{found['unknown_after_s']} s, {found['drifted_on_N'] * 1e3:.0f} mN since"
            )
    for name, row in result.get("pulse", {}).items():
        print(f"pulse, {name}: " + ", ".join(f"{how} {rms_N * 1e3:.1f} mN" for how, rms_N in row.items()))
    faults = {name: row["faults"] for name, row in steps.items() if row["faults"]}
    if faults:
        print(f"FAULTS {faults}")


def railed(rows: dict[str, Json]) -> str:
    """Which devices had a learned value at its rail, and for which share of the time."""
    found = [f"{name} {row['railed']:.1%}" for name, row in rows.items() if row["railed"]]
    return ", ".join(found) or "none"


def main() -> int:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"any of {', '.join(PARTS)}; default: all")
    parser.add_argument("--draws", type=int, default=DRAWS, help=f"random devices ({DRAWS})")
    parser.add_argument("--tuning", action="store_true", help="the devices that constants may be chosen on")
    parser.add_argument("--drift-s", type=float, default=DRIFT_S, help=f"how long a sensor drifts ({DRIFT_S:g})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    options = parser.parse_args()
    unknown = [part for part in options.parts if part not in PARTS]
    if unknown:
        parser.error(f"{unknown[0]}: allowed are {', '.join(PARTS)}")
    parts = options.parts or list(PARTS)
    result = measure(parts, options.draws, options.drift_s, is_tuning=options.tuning, jobs=options.jobs)
    print(json.dumps(result)) if options.json else print_table(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
