"""How well a force is followed: the true force of simulated devices less what was asked, in virtual time.

How soon a device is known: `steps`, `creep` and `speeds`, of samples, second plant and draws of the plant card. How
well a signal is followed, at 500 setpoints a second: the `pulse` of `make run` on all of these, with a preview of 70 ms
and live; on the samples the recorded `signals` of the folder TORMAG_DATA, with a preview of 400 ms, as for a file that
is played, and live, beside what ideal carriages miss (`tormag-lab bound`). Draws 40 to 79, samples 2 and 3 and the
second plant only judge. Errors are as they are, without any mean or delay taken out. A step has *arrived* ARRIVES_S
after the device's ideal carriages would have brought the force.
"""

import argparse
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from devices import SAMPLES, device, judging

from judge.following import (
    FILE_PREVIEW_S,
    PREVIEW_S,
    PULSE_N,
    RATE_HZ,
    VALID_S,
    Followed,
    Levels,
    armed,
    armed_at_rest,
    asked_at,
    follow,
    played,
    with_approach,
)
from judge.frame import each
from judge.hands import Legs
from judge.signals import recorded_signals
from tormag_lab.arrays import Array, Json
from tormag_lab.human_pulse import pulse_profile
from tormag_lab.ideal_carriage import TURNED_MM_S, asked_of, bound, brake_of, drive_of, no_delay_mm
from tormag_lab.told import lines
from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.control.believe.believe import NOTHING_LEARNED, Learned
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.profiles import profile_of
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters

DRAWS = 40
HIGH_N, LOW_N, ABOVE_N = 2.0, 0.7, 0.1
"Steps begin at LOW_N, or ABOVE_N over what the open gap brakes if that is more."
ARRIVES_S, LATER_S = 0.25, 1.0
IDEAL_N = 0.01
STEPS = (("up", "down"), ("up again", "down again"), ("up known", "down known"))
"Of a fresh device, after REST_S, and after a restart with its profile."
STEP_S, REST_S = 3.0, 30.0
RUNS_ON_S = 90.0
CREEP_MM_S, CREPT_MM = 1.0, 10.0
CREEP_N = (1.0, 2.0, 0.8)
SPEEDS_MM_S = (1.0, 300.0, 100.0, 300.0, 42.0, 300.0, 1.0, 100.0, 42.0, 100.0, 1.0, 42.0, 1.0)
SPEED_S, SLID_S = 4.0, 1.0
SPEEDS_N = (1.0, 2.0)
START_N, RAMP_S, HOLD_S = 0.6, 1.0, 1.0
PULSE_S = 15.0
TRIM_S = 10.0
"The trim learns for this time before the figures of other devices than sample 1 begin."


# -- how soon and how well a device is known ------------------------------------------------------------------------


def course(plant: PlantParameters, legs: Legs, levels: Levels, shown: Learned = NOTHING_LEARNED) -> Followed:
    """Run the hand along its legs and the force along its levels, with a device that has `shown` so much of itself."""
    loop, force_N = armed_at_rest(plant, legs, shown), asked_at(levels)
    begins_s = loop.now_s
    found = follow(
        loop,
        lambda now_s: TimedSetpoint(force_N(now_s - begins_s), now_s, VALID_S),
        sum(lasts_s for lasts_s, _ in levels),
        begins_s,
    )
    return found._replace(asked_N=np.array([force_N(time_s) for time_s in found.time_s.tolist()]))


def ideal_s(plant: PlantParameters, low_N: float) -> tuple[float, float]:
    """Return the time in which the ideal carriages bring the force up to HIGH_N, and down again."""
    brake, rest, hold = brake_of(plant), 0.3, 2.0
    levels = asked_at([(rest, low_N), (hold, HIGH_N), (hold, low_N)])
    time_s = 1e-3 * np.arange(round((rest + 2.0 * hold) * 1e3))
    wanted_N = np.array([levels(at_s) for at_s in time_s.tolist()])
    asked = asked_of(brake, wanted_N, most_N=HIGH_N, hand_mm_s=TURNED_MM_S, step_s=1e-3)
    reached_N = asked.rendered_N(brake, no_delay_mm(drive_of(plant), brake, asked, 1e-3))
    is_far = np.abs(reached_N - asked.force_N) > IDEAL_N
    up, down = (
        np.flatnonzero(is_far[(time_s >= begins_s) & (time_s < begins_s + hold)]) for begins_s in (rest, rest + hold)
    )
    return 1e-3 * float(up.max(initial=-1) + 1), 1e-3 * float(down.max(initial=-1) + 1)


def step_figures(found: Followed, begins_s: float, ideal: float, direction: float) -> Json:
    arrives_s = begins_s + ideal + ARRIVES_S
    held = (found.time_s >= begins_s + ideal) & (found.time_s < begins_s + STEP_S)
    return {
        "arrived_N": found.mean_N(arrives_s),
        "later_N": found.mean_N(arrives_s + LATER_S),
        "overshoot_N": float((direction * found.error_N[held]).max()),
    }


def steps(name: str) -> Json:
    plant = device(name)
    low_N = max(LOW_N, brake_of(plant).open_N(TURNED_MM_S) + ABOVE_N)
    up_s, down_s = ideal_s(plant, low_N)
    legs, once = [(RUNS_ON_S, TURNED_MM_S)], [(1.0, 0.0), (STEP_S, low_N), (STEP_S, HIGH_N)]
    fresh = course(plant, legs, [*once, (REST_S, low_N), (STEP_S, HIGH_N), (STEP_S, low_N)])
    kept = profile_of(fresh.shown, serial_number=1, insert="MRE", model="0" * 64, saved_ns=0)
    known = course(plant, legs, [*once, (STEP_S, low_N)], kept.learned(3_600_000_000_000))
    first_s, again_s = 1.0 + STEP_S, 1.0 + 2.0 * STEP_S + REST_S
    courses = (fresh, first_s), (fresh, again_s), (known, first_s)
    result: Json = {"faults": [*fresh.faults, *known.faults]}
    for (up, down), (found, begins_s) in zip(STEPS, courses, strict=True):
        result[up] = step_figures(found, begins_s, up_s, 1.0)
        result[down] = step_figures(found, begins_s + STEP_S, down_s, -1.0)
    return result


def creep(name: str) -> Json:
    """Return the error of each force after CREPT_MM at CREEP_MM_S, from a handle that was faster before and from one
    that never was.
    """
    plant, result = device(name), {}
    hold_s = CREPT_MM / CREEP_MM_S + 2.0
    for key, lead in (("after speed", [(3.0, TURNED_MM_S)]), ("only", [])):
        lead_s = sum(lasts_s for lasts_s, _ in lead)
        levels = [(lead_s + hold_s, CREEP_N[0]), *((hold_s, force_N) for force_N in CREEP_N[1:])]
        found = course(plant, [*lead, (RUNS_ON_S, CREEP_MM_S)], levels)
        ends_s = [lead_s + hold_s * (1 + place) for place in range(len(CREEP_N))]
        result[key] = {"worst_N": [found.worst_N(end_s - 2.0, end_s) for end_s in ends_s], "faults": found.faults}
    return result


def speeds(name: str) -> Json:
    """Return the worst error from SLID_S on, for every speed after every other."""
    plant, result = device(name), {}
    legs = [(SPEED_S, speed) for speed in SPEEDS_MM_S]
    for force_N in SPEEDS_N:
        found = course(plant, legs, [(SPEED_S * len(legs), force_N)])
        worst_N = {
            f"{before:g} to {after:g} mm/s": found.worst_N(SPEED_S * place + SLID_S, SPEED_S * (place + 1))
            for place, (before, after) in enumerate(pairwise(SPEEDS_MM_S), 1)
        }
        result[f"{force_N:g} N"] = {"worst_N": worst_N, "faults": found.faults}
    return result


# -- how well a signal is followed ----------------------------------------------------------------------------------


def track(plant: PlantParameters, times_s: Array, forces_N: Array, preview_s: float, scene: str = "pulse") -> Followed:
    loop = armed(build_core(Config(scene=scene)), plant, SteadyHand())
    approached = with_approach(times_s, forces_N, START_N, RAMP_S, HOLD_S)
    found = played(loop, *approached, preview_s, lead_s=RAMP_S + HOLD_S)
    return found._replace(asked_N=np.interp(found.time_s, times_s, forces_N))


def pulse(name: str) -> Json:
    signal, previews_s = pulse_profile(PULSE_S, *PULSE_N, RATE_HZ), {"with preview": PREVIEW_S, "live": 0.0}
    runs = {key: track(device(name), *signal, preview_s) for key, preview_s in previews_s.items()}
    return {key: found.since(TRIM_S).rms_N for key, found in runs.items()}


def signals(name: str) -> Json:
    """Return what the core misses of each recorded signal, beside its bounds; nothing without TORMAG_DATA."""
    plant = device(name)
    return {
        signal: {
            "with_preview_rms_N": track(plant, *forces, FILE_PREVIEW_S, "coronary").since(0.0).rms_N,
            "live_rms_N": track(plant, *forces, 0.0, "coronary").since(0.0).rms_N,
        }
        | {bounding: bound(plant, *forces).figures()[bounding] for bounding in ("no_delay_rms_N", "foresight_rms_N")}
        for signal, forces in recorded_signals().items()
    }


CASES = {"steps": steps, "creep": creep, "speeds": speeds, "pulse": pulse, "signals": signals}


OPTIONS = {"cases": {"nargs": "*", "choices": (*CASES, "all"), "default": "all", "help": "default: all"}}


def measure(options: argparse.Namespace) -> Json:
    return {case: of_case(case) for case in CASES if case in options.cases or "all" in options.cases}


def of_case(case: str) -> Json:
    names = SAMPLES if case == "signals" else judging(DRAWS)
    return dict(zip(names, each(CASES[case], case, names), strict=True))


def shown(figures: Json) -> Iterator[str]:
    return lines({case: worst(found) for case, found in figures.items()})


def worst(devices: dict[str, Json]) -> list[Json]:
    """Return the greatest of each figure that devices have in common, whose it is, and the median."""
    sizes = {device: dict(_sizes(found)) for device, found in devices.items()}
    rows = []
    for figure in next(iter(sizes.values())):
        of_devices = {device: found[figure] for device, found in sizes.items() if figure in found}
        device = max(of_devices, key=lambda device: of_devices[device])
        median = float(np.median(list(of_devices.values())))
        rows.append({"figure": figure, "worst": of_devices[device], "device": device, "median": median})
    return rows


def _sizes(found: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the size of every number in plain data."""
    if isinstance(found, dict | list | tuple):
        for key, value in found.items() if isinstance(found, dict) else enumerate(found, 1):
            yield from _sizes(value, f"{name}, {key}".removeprefix(", "))
    elif isinstance(found, int | float):
        yield name, abs(found)
