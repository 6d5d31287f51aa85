"""What the whole path does at the corners: handles x devices x forces x what setpoints may say, in virtual time.

Forces are the simulated plant's while the handle slides. *Asked* is the greater of the force asked and what this device
brakes with its gap open at this speed; *arrived* is 0.2 s after an ideal carriage would have. Devices are the three
samples and random draws around sample 1 (plant card). Constants were chosen on sample 1 and draws 0 to 39; samples 2
and 3 and draws from 40 on only judge. The second plant has another structure; it is shown apart and keeps no bound.
"""

import argparse
import math
from collections.abc import Callable, Iterable, Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from devices import SAMPLES, SECOND, device, judging

from judge.following import VALID_S, Followed, Levels, armed_at_rest, asked_at, follow
from judge.frame import each
from judge.hands import HANDS
from tormag_lab.arrays import Array, Json, Mask
from tormag_lab.ideal_carriage import TURNED_MM_S, brake_of
from tormag_lab.pages import stamp, subplots
from tormag_lab.told import lines
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.codes import Limit

DRAWS = 40
SETPOINT_S = 0.002
ARRIVED_S = 0.2
OVER_S = 0.05
SETTLED_S = 2.0
SLIDING_MM, SLIDING_MM_S = 2.0, 0.4
SLOWEST_MM_S = 4.9
"Slower handles are counted apart: their friction is partly static."
STILL_MM_S = 1e-6
GAP_MM_S, GAP_MM_S2, STROKE_MM = 38.0, 1600.0, 30.0
"An ideal carriage goes from 0.7 to 2 N, the longest way asked at once, with the configured speed."
BOUNDS = {"over_N": 0.25, "over_sample_1_N": 0.15, "peak_N": 2.6, "settled_N": 0.1, "low_hold_faults": 0}
"""Bounds of the excess over what was asked, on any device and on sample 1."""
LOW_HOLD_S = 600.0
LOW_N = (0.2, 0.5)
HELD_DRAWS = 20
FORCES: dict[str, Levels] = {
    "steps": [(1.0, 0.0), (3.0, 0.7), (3.0, 2.0), (3.0, 0.7), (3.0, 2.0), (3.0, 1.5)],
    "1 N": [(1.0, 0.0), (12.0, 1.0)],
    "ladder": [(1.0, 0.0), (41.0, 1.5)],
    "ladder at 0.8 N": [(1.0, 0.0), (41.0, 0.8)],
}
FORCES_OF_HANDS = {"ladder": ("ladder", "ladder at 0.8 N"), "1 mm/s": ("1 N",)}
"The other hands get the steps."
SAID: tuple[tuple[float | None, float | None], ...] = (
    (0.0, None),
    (0.3, None),
    (1.5, 42.0),
    (None, 0.0),
    (None, 100.0),
    (None, -300.0),
)
"Handle motions that a setpoint may state: displacement_mm, rate_mm_s."


class Case(NamedTuple):
    device: str
    hand: str
    forces: str
    displacement_mm: float | None = None
    rate_mm_s: float | None = None


def cases() -> Iterator[Case]:
    for name in judging(DRAWS):
        for hand in HANDS:
            for forces in FORCES_OF_HANDS.get(hand, ("steps",)):
                yield Case(name, hand, forces)
    for name in SAMPLES:
        for hand in ("42 mm/s", "300 mm/s", "creep"):
            for said in SAID:
                yield Case(name, hand, "1 N", *said)


def run(case: Case) -> Json:
    plant, legs, levels = device(case.device), HANDS[case.hand](), FORCES[case.forces]
    loop, force_N = armed_at_rest(plant, legs), asked_at(levels)
    start_s = loop.now_s
    newest: list[TimedSetpoint] = []

    def publish(now_s: float) -> TimedSetpoint:
        if not newest or now_s - newest[-1].stamp_s >= SETPOINT_S:
            newest[:] = [TimedSetpoint(force_N(now_s - start_s), now_s, VALID_S, case.displacement_mm, case.rate_mm_s)]
        return newest[-1]

    lasts_s = min(sum(lasts for lasts, _ in levels), sum(lasts for lasts, _ in legs))
    followed = follow(loop, publish, lasts_s, start_s)
    is_of_steps = (case.hand, case.forces) == ("42 mm/s", "steps")
    return judged(followed, brake_of(plant).open_N) | {"steps_N": step_figures(followed) if is_of_steps else None}


def step_figures(found: Followed) -> tuple[float, float, float] | None:
    along_N, asked_N = found.along_N, found.asked_N
    begins = np.flatnonzero((np.diff(asked_N) > 1.0) & (asked_N[1:] == 2.0)) + 1
    if len(begins) < 2 or len(along_N) < begins[1] + 1000:
        return None
    first, again = (float(along_N[at + 950 : at + 1000].mean() - 2.0) for at in begins[:2])
    return first, again, float(along_N[begins[0] : begins[0] + 3000].max() - 2.0)


def judged(found: Followed, open_N: Callable[[float], float]) -> Json:
    asked_N, speed_mm_s = found.asked_N, found.handle_mm_s
    floor_N = np.array([open_N(speed) for speed in np.abs(speed_mm_s).round(1).tolist()])
    error_N = found.along_N - np.maximum(asked_N, floor_N)
    waited_s = lasted_s(asked_N[1:] == asked_N[:-1])
    # the distance is the gap's way from where it was when the force changed to where it comes to rest
    travel_s = STROKE_MM / GAP_MM_S + GAP_MM_S / GAP_MM_S2
    slides = sliding(found.handle_mm, speed_mm_s)
    arrived = slides & (waited_s > ARRIVED_S + travel_s)
    # below what the open gap brakes nothing can fall short
    is_reached = asked_N > floor_N
    even_s = lasted_s(np.abs(np.diff(speed_mm_s)) < 0.01 * np.abs(speed_mm_s[1:]) + 1e-3)
    steady = np.flatnonzero(slides & is_reached & (waited_s > SETTLED_S) & (even_s > SETTLED_S))[::100]
    points = np.abs(speed_mm_s[steady]).tolist(), asked_N[steady].tolist(), error_N[steady].tolist()
    settled = list(zip(*points, strict=True))
    return {
        "over_N": lasting_N(np.where(arrived, error_N, -np.inf)),
        "under_N": lasting_N(np.where(arrived & is_reached, -error_N, -np.inf)),
        "peak_N": float(np.abs(found.rendered_N[np.abs(speed_mm_s) > SLIDING_MM_S]).max(initial=0.0)),
        "settled": tuple(point for point in settled if point[0] >= SLOWEST_MM_S),
        "slow_N": tuple(error for speed, _, error in settled if speed < SLOWEST_MM_S),
        "faults": found.faults,
        "limits": found.limits,
    }


def lasting_N(excess_N: Array) -> float:
    """Return the greatest excess that lasted for OVER_S."""
    window = round(OVER_S * 1e3)
    if len(excess_N) <= window:
        return -math.inf
    return float(np.lib.stride_tricks.sliding_window_view(excess_N, window).min(axis=1).max())


def lasted_s(is_same: Iterable[bool]) -> Array:
    """Return for how many milliseconds nothing has changed."""
    lasted = [0.0]
    for same in is_same:
        lasted.append(lasted[-1] + 1e-3 if same else 0.0)
    return np.array(lasted)


def sliding(handle_mm: Array, speed_mm_s: Array) -> Mask:
    """Return where the handle has gone SLIDING_MM since it turned, and moves."""
    found, turned_mm, direction = np.zeros(len(handle_mm), dtype=np.bool_), float(handle_mm[0]), 0.0
    for index, (position, speed) in enumerate(zip(handle_mm.tolist(), speed_mm_s.tolist(), strict=True)):
        if abs(speed) > STILL_MM_S and math.copysign(1.0, speed) != direction:
            direction, turned_mm = math.copysign(1.0, speed), position
        found[index] = abs(position - turned_mm) >= SLIDING_MM and abs(speed) > SLIDING_MM_S
    return found


def low_hold(name: str, asked_N: float) -> tuple[str, ...]:
    """Return what is wrong with a long hold below F_min: its faults, or that F_MIN was not shown."""
    loop = armed_at_rest(device(name), [(60.0, TURNED_MM_S)] * 11)
    is_shown = False
    for sample in loop.run(LOW_HOLD_S, lambda now_s: TimedSetpoint(asked_N, now_s, VALID_S)):
        is_shown = is_shown or Limit.F_MIN in sample.plan.limits
        if sample.safety.faults:
            return tuple(map(str, sample.safety.faults))
    return () if is_shown else ("F_MIN was not shown",)


def measure(options: argparse.Namespace) -> Json:
    asked, holds = list(cases()), list(product(judging(HELD_DRAWS), LOW_N))
    every = list(zip(asked, each(run, "runs", asked), strict=True))
    low = each(low_hold, "low holds", *zip(*holds, strict=True))
    faults = [(*hold, wrong) for hold, wrong in zip(holds, low, strict=True)]
    second = [(case, figures) for case, figures in every if case.device == SECOND]
    found = [(case, figures) for case, figures in every if case.device != SECOND]
    stepped = [of["steps_N"] for case, of in found if of["steps_N"] and case.device.startswith("draw")]
    first, again, overshoot = (np.array(part) for part in zip(*stepped, strict=True))
    result: Json = {
        **worst(found),
        "over_sample_1_N": max(of["over_N"] for case, of in found if case.device == "sample_1"),
        "low_hold_faults": sum(bool(wrong) for *_, wrong in faults),
        "step_error_at_1s_N": {"median": float(np.median(np.abs(first))), "worst": float(np.abs(first).max())},
        "step_again_N": float(np.abs(again).max()),
        "overshoot_N": float(overshoot.max()),
        "slow_error_N": max(abs(error) for case, of in found if case.hand == "1 mm/s" for error in of["slow_N"]),
        "cases": len(every) + len(holds),
        "second": {name: figure for name, figure in worst(second).items() if name != "peak_N"},
        "low_holds": [f"{name} at {force} N: {', '.join(wrong)}" for name, force, wrong in faults if wrong],
        "draws": DRAWS,
        "rows": [
            case._asdict() | {name: of[name] for name in ("over_N", "under_N", "peak_N", "limits")}
            for case, of in every
        ],
    }
    if options.picture is not None:
        picture(options.picture, result, found)
    result["missed"] = missed(result)
    return result | {"passed": not (result["missed"] or result["faults"])}


def worst(found: list[tuple[Case, Json]]) -> Json:
    return {
        **{name: max(of[name] for _, of in found) for name in ("over_N", "under_N", "peak_N")},
        "settled_N": max(abs(error) for _, _, error in settled(found)),
        "faults": [
            f"{case.device}, {case.hand}, {case.forces}: {', '.join(of['faults'])}"
            for case, of in found
            if of["faults"]
        ],
    }


def settled(found: list[tuple[Case, Json]]) -> list[tuple[float, float, float]]:
    as_it_is = [of for case, of in found if case.displacement_mm is None and case.rate_mm_s is None]
    return [point for of in as_it_is for point in of["settled"]]


def missed(result: Json) -> list[str]:
    return [f"{name} = {result[name]:.3f}: allowed is {most}" for name, most in BOUNDS.items() if result[name] > most]


def picture(path: Path, result: Json, found: list[tuple[Case, Json]]) -> None:
    figure, (own, others) = subplots((11.0, 5.0), 1, 2, sharex=True, sharey=True)
    for axes, title, is_own in ((own, "sample 1", True), (others, "samples 2, 3 and draws", False)):
        points = settled([(case, figures) for case, figures in found if (case.device == "sample_1") is is_own])
        speeds, forces, errors = np.array(points).T
        jitter = np.random.default_rng(0).uniform(0.94, 1.06, (2, len(points)))
        shown = axes.scatter(
            speeds * jitter[0], forces * jitter[1], c=1e3 * errors, cmap="coolwarm", vmin=-100.0, vmax=100.0, s=9
        )
        axes.set(xscale="log", xlabel="handle speed, mm/s", title=f"{title}: worst {1e3 * np.abs(errors).max():.0f} mN")
        axes.grid(alpha=0.3)
    own.set_ylabel("force asked, N")
    figure.colorbar(shown, ax=[own, others], label=f"rendered less asked after {SETTLED_S:g} s of sliding, mN")
    figure.savefig(path, dpi=130, metadata=stamp(result))


OPTIONS = {"--picture": {"type": Path, "help": "PNG of the force error over handle speed and asked force"}}


def shown(figures: Json) -> Iterator[str]:
    return lines(figures | {"rows": sorted(figures["rows"], key=lambda row: -row["over_N"])[:6]})
