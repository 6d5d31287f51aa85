"""What the whole path does at the corners: handles x devices x forces x what setpoints may say, in virtual time.

    envelope.py [--quick] [--json] [--picture FILE.png]

Forces are the simulated plant's while the handle slides. *Asked* is the greater of the force asked and what this
device brakes with its gap open at this speed; *arrived* is 0.2 s after an ideal carriage would have. Devices are the
three samples and random draws around sample 1 (plant card). Sample 1 and draws 0 to 39 were looked at while constants
were chosen; samples 2 and 3 and the draws from 40 on only judge. All devices are synthetic.
"""

import argparse
import concurrent.futures
import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pictures.stamp import stamp
from rendering.device_draws import drawn_device
from rendering.ideal_carriage import brake_of
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.control.plan import NOTHING_SHOWN, Shown
from tormagd.model.displacement import MOBILISED_MM
from tormagd.model.model_file import load_model
from tormagd.model.shipped import model_path
from tormagd.physics.field import PowerFieldLaw, flux_density_T
from tormagd.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.physics.inserts import insert
from tormagd.safety.codes import Fault, Limit
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import Hand, RecordedHand
from tormagd.simulation.parameters import PlantParameters, load_plant

Array = npt.NDArray[np.float64]
Json = dict[str, Any]

SCENE = "coronary"
SAMPLES = ("sample_1", "sample_2", "sample_3")
DRAWS, QUICK_DRAWS = 40, 2
FIRST_DRAW = 40
"Earlier ones were seen."
SETPOINT_S = 0.002
VALID_S = 0.25
ARRIVED_S = 0.2
OVER_S = 0.05
SETTLED_S = 2.0
"Of sliding at one speed and one force: what is left then is an error, not a transition."
SLIDING_MM, SLIDING_MM_S = 2.0, 0.4
SLOWEST_MM_S = 4.9
"Slower handles are counted apart: their friction is partly static."
STILL_MM_S = 1e-6
GAP_MM_S, GAP_MM_S2, STROKE_MM = 38.0, 1600.0, 30.0
"An ideal carriage takes the way from 0.7 to 2 N, the longest asked for at once, with the configured speed."
BOUNDS = {"over_N": 0.25, "over_sample_1_N": 0.15, "peak_N": 2.6, "settled_N": 0.1, "low_hold_faults": 0}
"""What has to hold: excess over what was asked on any device and on sample 1, the greatest force at all (1.25 times the
scene's and 0.1 N), the error after SETTLED_S of sliding, and no fault below F_min."""
LOW_HOLD_S, QUICK_LOW_HOLD_S = 600.0, 20.0
LOW_N = (0.2, 0.5)
"Forces under F_min."


@dataclass(frozen=True)
class Case:
    """One run: a device, a hand, the forces asked over time, and what the setpoints say besides."""

    device: str
    hand: str
    forces: str
    displacement_mm: float | None = None
    rate_mm_s: float | None = None


class Figures(NamedTuple):
    """Of one run. `over_N`: greatest excess over what was asked for more than OVER_S, arrived; `peak_N`: the greatest
    force at all while the handle moves; `settled`: error by speed and force after SETTLED_S of sliding (mm/s, N, N);
    `slow_N`: the same at slower handles; `steps_N`: of a steady hand, the error 1 s after the step to 2 N, the same
    after the next such step, and the most that the first overshoots."""

    over_N: float
    under_N: float
    peak_N: float
    settled: tuple[tuple[float, float, float], ...]
    slow_N: tuple[float, ...]
    steps_N: tuple[float, float, float] | None
    faults: tuple[str, ...]
    limits: dict[str, float]


def device(name: str) -> PlantParameters:
    """A sample by its name, or `draw N`."""
    return drawn_device(int(name.split()[1])) if name.startswith("draw") else load_plant(name)


# -- hands ---------------------------------------------------------------------------------------------------------


def even(speed_mm_s: float) -> list[tuple[float, float]]:
    """Turned steadily: pairs of (seconds, mm/s)."""
    return [(60.0, speed_mm_s)]


def flicks() -> list[tuple[float, float]]:
    """42 mm/s, and up to 200 mm/s and down again within half a second each, both ways."""
    legs: list[tuple[float, float]] = []
    for direction in (1.0, -1.0, 1.0, -1.0):
        rise = [(0.02, direction * (42.0 + 158.0 * step / 25.0)) for step in range(26)]
        legs += [(1.0, direction * 42.0), *rise, (0.3, direction * 200.0), *rise[::-1]]
    return legs * 3


def reversals(seed: int) -> list[tuple[float, float]]:
    """Turns and stops every 1..4 s, at speeds from a creep to 300 mm/s."""
    random = np.random.default_rng(seed)
    legs, direction = [], 1.0
    for _ in range(20):
        legs.append((random.uniform(1.0, 4.0), direction * math.exp(random.uniform(math.log(0.5), math.log(300.0)))))
        if random.random() < 0.4:
            legs.append((random.uniform(0.1, 1.0), 0.0))
        direction = -direction
    return legs


def ladder() -> list[tuple[float, float]]:
    """From 5 to 300 mm/s and back again, three seconds each."""
    speeds = (5.0, 8.0, 15.0, 42.0, 100.0, 200.0, 300.0)
    return [(3.0, speed) for speed in (*speeds, *(-speed for speed in speeds[::-1]))]


HANDS: dict[str, Callable[[], list[tuple[float, float]]]] = {
    "creep": lambda: [(3.0, 42.0), (30.0, 0.5)],
    "1 mm/s": lambda: [(3.0, 42.0), (30.0, 1.0)],
    "5 mm/s": lambda: even(5.0),
    "42 mm/s": lambda: even(42.0),
    "100 mm/s": lambda: even(-100.0),
    "300 mm/s": lambda: even(300.0),
    "ladder": ladder,
    "flicks": flicks,
    "reversals": lambda: reversals(1),
    "other reversals": lambda: reversals(2),
}


def moved(legs: list[tuple[float, float]], start_s: float) -> RecordedHand:
    """The hand that stands until `start_s` and then goes along `legs`."""
    times, positions = [start_s], [0.0]
    for duration_s, speed_mm_s in legs:
        times.append(times[-1] + duration_s)
        positions.append(positions[-1] + duration_s * speed_mm_s)
    return RecordedHand(tuple(times), tuple(positions))


# -- forces ---------------------------------------------------------------------------------------------------------

FORCES: dict[str, list[tuple[float, float]]] = {
    "steps": [(1.0, 0.0), (3.0, 0.7), (3.0, 2.0), (3.0, 0.7), (3.0, 2.0), (3.0, 1.5)],
    "2 N": [(1.0, 0.0), (12.0, 2.0)],
    "1 N": [(1.0, 0.0), (12.0, 1.0)],
    "0.2 N": [(8.0, 0.2)],
    "ladder": [(1.0, 0.0), (41.0, 1.5)],
    "ladder at 0.8 N": [(1.0, 0.0), (41.0, 0.8)],
}


def asked_at(levels: list[tuple[float, float]]) -> Callable[[float], float]:
    """The force asked at a time."""
    ends = np.cumsum([duration_s for duration_s, _ in levels]).tolist()

    def force_N(time_s: float) -> float:
        return next((level for end, (_, level) in zip(ends, levels, strict=True) if time_s < end), levels[-1][1])

    return force_N


SAID: tuple[tuple[float | None, float | None], ...] = (
    (0.0, None),
    (0.3, None),
    (1.5, 42.0),
    (None, 0.0),
    (None, 100.0),
    (None, -300.0),
)
"Handle motions that a setpoint may say it is meant for: displacement_mm, rate_mm_s."


def drawn(draws: int) -> list[str]:
    """The names of so many draws that only judge."""
    return [f"draw {number}" for number in range(FIRST_DRAW, FIRST_DRAW + draws)]


def cases(draws: int) -> Iterator[Case]:
    """Every run."""
    for name in (*SAMPLES, *drawn(draws)):
        for hand in HANDS:
            if hand == "ladder":
                yield Case(name, hand, "ladder")
                yield Case(name, hand, "ladder at 0.8 N")
            elif hand == "1 mm/s":
                yield Case(name, hand, "1 N")
            else:
                yield Case(name, hand, "steps")
    for name in SAMPLES:
        for hand in ("42 mm/s", "300 mm/s", "creep"):
            for said in SAID:
                yield Case(name, hand, "1 N", *said)


# -- running --------------------------------------------------------------------------------------------------------


def armed(
    config: Config, plant: PlantParameters, legs: list[tuple[float, float]], shown: Shown = NOTHING_SHOWN
) -> ClosedLoop:
    """A device that was homed and enabled with the handle at rest; the hand begins at the loop's time then. The device
    counts as having `shown` so much of itself."""
    core = build_core(config)
    start: list[Hand] = []

    class Waiting:
        def position_mm(self, time_s: float) -> float:
            return start[0].position_mm(time_s) if start else 0.0

    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(plant, Waiting(), seed=1))
    loop.plan_state = core.planner.start(loop.now_s).replaced(shown=shown)
    loop.arm()
    start.append(moved(legs, loop.now_s))
    return loop


def open_gap_N(plant: PlantParameters) -> Callable[[float], float]:
    """What a device brakes with its gap open and its elastomer fresh, over the speed."""
    brake = brake_of(plant)
    fresh_N = brake.fresh_at_N(float(brake.moment_Tm[-1]))
    return lambda speed_mm_s: brake.sliding_N(fresh_N, speed_mm_s)


def run(case: Case) -> Figures:
    """One case in virtual time."""
    config = Config(scene=SCENE)
    plant, legs, levels = device(case.device), HANDS[case.hand](), FORCES[case.forces]
    loop = armed(config, plant, legs)
    start_s, force_N = loop.now_s, asked_at(levels)
    duration_s = min(sum(lasts for lasts, _ in levels), sum(lasts for lasts, _ in legs))
    newest: list[TimedSetpoint] = []

    def publisher(now_s: float) -> TimedSetpoint:
        if not newest or now_s - newest[-1].stamp_s >= SETPOINT_S:
            newest[:] = [TimedSetpoint(force_N(now_s - start_s), now_s, VALID_S, case.displacement_mm, case.rate_mm_s)]
        return newest[-1]

    faults: tuple[Fault, ...] = ()
    rows, held = [], dict[str, int]()
    for sample in loop.run(duration_s, publisher):
        truth, faults = sample.truth, sample.state.safety.faults
        rows.append((truth.force_N, truth.handle_mm, truth.handle_mm_s, newest[-1].force_N))
        for limit in dict.fromkeys((*sample.plan.limits, *sample.output.limits)):
            held[limit] = held.get(limit, 0) + 1
        if faults:
            break
    table = np.array(rows)
    shares = {str(limit): count / len(table) for limit, count in sorted(held.items())}
    found = judged(table, open_gap_N(plant), shares, tuple(map(str, faults)))
    return found._replace(steps_N=step_figures(table)) if (case.hand, case.forces) == ("42 mm/s", "steps") else found


def step_figures(table: Array) -> tuple[float, float, float] | None:
    """Of the steps from 0.7 to 2 N; None where a fault ended the run before."""
    along_N, asked_N = table[:, 0] * np.sign(table[:, 2]), table[:, 3]
    begins = np.flatnonzero((np.diff(asked_N) > 1.0) & (asked_N[1:] == 2.0)) + 1
    if len(begins) < 2 or len(table) < begins[1] + 1000:
        return None
    first, again = (float(along_N[at + 950 : at + 1000].mean() - 2.0) for at in begins[:2])
    return first, again, float(along_N[begins[0] : begins[0] + 3000].max() - 2.0)


def judged(
    table: Array, open_N: Callable[[float], float], limits: dict[str, float], faults: tuple[str, ...]
) -> Figures:
    """The figures of a run (n x 4, a row a millisecond: force N, handle mm and mm/s, asked N)."""
    signed_N, handle_mm, speed_mm_s, asked_N = table.T
    slides, along_N = sliding(handle_mm, speed_mm_s), signed_N * np.sign(speed_mm_s)
    floor_N = np.array([open_N(speed) for speed in np.abs(speed_mm_s).round(1).tolist()])
    wanted_N = np.maximum(asked_N, floor_N)
    waited = np.zeros(len(table))
    for index in range(1, len(table)):
        changed = asked_N[index] != asked_N[index - 1]
        waited[index] = 0.0 if changed else waited[index - 1] + 1e-3
    # what has to be travelled is the gap's way between where it was when the force changed and where it comes to rest
    travel_s = STROKE_MM / GAP_MM_S + GAP_MM_S / GAP_MM_S2
    arrived = slides & (waited > ARRIVED_S + travel_s)
    excess = np.where(arrived, along_N - wanted_N, -np.inf)
    window = round(OVER_S * 1e3)
    lasting = -np.inf
    if len(excess) > window:
        lasting = float(np.lib.stride_tricks.sliding_window_view(excess, window).min(axis=1).max())
    # below what the open gap brakes there is nothing to fall short of
    is_reached = asked_N > floor_N
    short = np.where(arrived & is_reached, wanted_N - along_N, -np.inf)
    under = float(np.lib.stride_tricks.sliding_window_view(short, window).min(axis=1).max())
    steady = np.flatnonzero(slides & is_reached & (waited > SETTLED_S) & even_for(speed_mm_s, SETTLED_S))[::100]
    errors = zip(np.abs(speed_mm_s[steady]), asked_N[steady], (along_N - wanted_N)[steady], strict=True)
    found = [(float(speed), float(asked), float(error)) for speed, asked, error in errors]
    settled = tuple(point for point in found if point[0] >= SLOWEST_MM_S)
    slow = tuple(error for speed, _, error in found if speed < SLOWEST_MM_S)
    moving = np.abs(speed_mm_s) > SLIDING_MM_S
    peak = float(np.abs(signed_N[moving]).max()) if moving.any() else 0.0
    return Figures(lasting, under, peak, settled, slow, None, faults, limits)


def sliding(handle_mm: Array, speed_mm_s: Array) -> npt.NDArray[np.bool_]:
    """Where the handle has gone SLIDING_MM since it turned, and moves."""
    found, turned_mm, direction = np.zeros(len(handle_mm), dtype=np.bool_), float(handle_mm[0]), 0.0
    for index, (position, speed) in enumerate(zip(handle_mm.tolist(), speed_mm_s.tolist(), strict=True)):
        if abs(speed) > STILL_MM_S and math.copysign(1.0, speed) != direction:
            direction, turned_mm = math.copysign(1.0, speed), position
        found[index] = abs(position - turned_mm) >= SLIDING_MM and abs(speed) > SLIDING_MM_S
    return found


def even_for(speed_mm_s: Array, lasts_s: float) -> npt.NDArray[np.bool_]:
    """Where the speed has been the same for so long."""
    lasted = np.zeros(len(speed_mm_s))
    for index in range(1, len(speed_mm_s)):
        same = abs(speed_mm_s[index] - speed_mm_s[index - 1]) < 0.01 * abs(speed_mm_s[index]) + 1e-3
        lasted[index] = lasted[index - 1] + 1e-3 if same else 0.0
    result: npt.NDArray[np.bool_] = lasted > lasts_s
    return result


def low_hold(name: str, asked_N: float, lasts_s: float) -> tuple[str, ...]:
    """What is wrong with a force below F_min that is held for long: its faults, or that F_MIN was not shown."""
    loop = armed(Config(scene=SCENE), device(name), even(42.0) * 11)
    is_shown = False
    for sample in loop.run(lasts_s, lambda now_s: TimedSetpoint(asked_N, now_s, VALID_S)):
        is_shown = is_shown or Limit.F_MIN in sample.plan.limits
        if sample.state.safety.faults:
            return tuple(map(str, sample.state.safety.faults))
    return () if is_shown else ("F_MIN was not shown",)


def model_on_plant() -> Json:
    """The shipped model on sample 1 without memory, friction mobilised, over the gaps of the scene and 5..300 mm/s."""
    plant, scene = load_plant("sample_1"), load_scene(SCENE)
    model = load_model(model_path(scene.insert.model, Path()), element="torque")
    fitted, open_mm, closed_mm = insert(scene.insert.name), scene.insert.gap_open_mm, scene.insert.gap_closed_mm
    gaps_mm, rates_mm_s = np.linspace(closed_mm, open_mm, 101), np.linspace(5.0, 300.0, 119)
    moments_Tm = PowerFieldLaw(plant.field.coefficient, plant.field.exponent).radial_moment_Tm(gaps_mm)
    elastomer = Elastomer(
        plant.elastomer.shear_modulus_kPa * 1e3,
        plant.elastomer.relative_permeability,
        plant.elastomer.kinetic_friction,
    )
    fields_mT = 1e3 * np.asarray(
        flux_density_T(moments_Tm, fitted.elastomer.relative_permeability, 1e-3 * scene.insert.inner_radius_mm)
    )
    friction, rates = plant.friction, rates_mm_s[:, np.newaxis]
    over = 1.0 + (friction.static_to_kinetic - 1.0) * np.exp(-((rates / friction.stribeck_speed_mm_s) ** 2))
    true_N = brake_force_N(moments_Tm, elastomer, TORMAG) * over + friction.viscous_N_s_mm * rates
    rows = np.array(
        [[MOBILISED_MM, rate, field, 100.0 * fitted.cip_fraction] for rate in rates_mm_s for field in fields_mT]
    )
    error_N = np.abs(model.predict(rows).reshape(true_N.shape) - true_N)
    return {
        "mean_N": float(error_N.mean()),
        "worst_N": float(error_N.max()),
        "not_rising_share": float((model.field_slope_N_per_mT(rows) <= 0.0).mean()),
    }


def measure(options: argparse.Namespace) -> tuple[Json, list[tuple[Case, Figures]]]:
    """Everything; the keys are those of the public contract, and `model`, `peak_N`, `settled_N`, `rows`."""
    draws = QUICK_DRAWS if options.quick else options.draws
    asked = list(cases(draws))
    holds = [(name, force) for name in held_devices(draws) for force in LOW_N]
    lasts_s = QUICK_LOW_HOLD_S if options.quick else options.hold_s
    with concurrent.futures.ProcessPoolExecutor(max_workers=options.jobs) as pool:
        waiting = [pool.submit(run, case) for case in asked]
        low = [pool.submit(low_hold, name, force, lasts_s) for name, force in holds]
        bar = tqdm(total=len(waiting) + len(low), desc="runs", unit="run", disable=not sys.stderr.isatty())
        pending: list[concurrent.futures.Future[Any]] = [*waiting, *low]
        for future in pending:
            future.add_done_callback(lambda _: bar.update())
        found = [(case, future.result()) for case, future in zip(asked, waiting, strict=True)]
        faults = [(*hold, future.result()) for hold, future in zip(holds, low, strict=True)]
        bar.close()
    stepped = [figures.steps_N for case, figures in found if figures.steps_N and case.device.startswith("draw")]
    slow = [abs(error) for case, figures in found if case.hand == "1 mm/s" for error in figures.slow_N]
    # where a publisher says another motion than the handle's, it gets the force for that
    as_it_is = [figures for case, figures in found if case.displacement_mm is None and case.rate_mm_s is None]
    settled = [abs(error) for figures in as_it_is for _, _, error in figures.settled]
    first, again, overshoot = (np.array(part) for part in zip(*stepped, strict=True))
    result: Json = {
        "over_N": max(figures.over_N for _, figures in found),
        "over_sample_1_N": max(figures.over_N for case, figures in found if case.device == "sample_1"),
        "under_N": max(figures.under_N for _, figures in found),
        "peak_N": max(figures.peak_N for _, figures in found),
        "settled_N": max(settled),
        "low_hold_faults": sum(bool(wrong) for _, _, wrong in faults),
        "step_error_at_1s_N": {"median": float(np.median(np.abs(first))), "worst": float(np.abs(first).max())},
        "step_again_N": float(np.abs(again).max()),
        "overshoot_N": float(overshoot.max()),
        "slow_error_N": max(slow),
        "cases": len(found) + len(holds),
        "faults": [
            f"{case.device}, {case.hand}, {case.forces}: {', '.join(f.faults)}" for case, f in found if f.faults
        ],
        "low_holds": [f"{name} at {force} N: {', '.join(wrong)}" for name, force, wrong in faults if wrong],
        "model": model_on_plant(),
        "draws": draws,
        "low_hold_s": lasts_s,
        "rows": [row(case, figures) for case, figures in found],
    }
    return result, found


def missed(result: Json) -> list[str]:
    """Which of the bounds that the envelope is to keep it does not."""
    return [f"{name} = {result[name]:.3f}: allowed is {most}" for name, most in BOUNDS.items() if result[name] > most]


def held_devices(draws: int) -> list[str]:
    """The samples, and half of the draws, no more than 20."""
    return [*SAMPLES, *drawn(min(draws, 20))]


def row(case: Case, figures: Figures) -> Json:
    """One run for JSON."""
    errors = [error for _, _, error in figures.settled]
    return {
        "device": case.device,
        "hand": case.hand,
        "forces": case.forces,
        "displacement_mm": case.displacement_mm,
        "rate_mm_s": case.rate_mm_s,
        "over_N": figures.over_N,
        "under_N": figures.under_N,
        "peak_N": figures.peak_N,
        "settled_N": [min(errors), max(errors)] if errors else None,
        "limits": figures.limits,
    }


def print_table(result: Json) -> None:
    """For a person: the figures, and the worst runs."""
    step = result["step_error_at_1s_N"]
    print(
        f"{result['cases']} runs on samples 1..3 and {result['draws']} draws of the plant card (all synthetic)\n"
        f"over what was asked, arrived, for 50 ms: {result['over_N'] * 1e3:.0f} mN at worst "
        f"({result['over_sample_1_N'] * 1e3:.0f} on sample 1); under it {result['under_N'] * 1e3:.0f} mN\n"
        f"greatest force at all, starts included: {result['peak_N']:.2f} N\n"
        f"after {SETTLED_S:g} s of sliding at 5..300 mm/s: {result['settled_N'] * 1e3:.0f} mN at worst\n"
        f"step from 0.7 to 2 N, draws, at 1 s: median {step['median'] * 1e3:.0f}, worst {step['worst'] * 1e3:.0f}; "
        f"again {result['step_again_N'] * 1e3:.0f} mN; overshoot {result['overshoot_N'] * 1e3:.0f} mN\n"
        f"handle at 1 mm/s: {result['slow_error_N'] * 1e3:.0f} mN\n"
        f"held below F_min for {result['low_hold_s']:g} s: {result['low_hold_faults']} with a fault"
    )
    model = result["model"]
    print(
        f"shipped model on sample 1 without memory, 5..300 mm/s, every gap: mean {model['mean_N'] * 1e3:.0f} mN, worst "
        f"{model['worst_N'] * 1e3:.0f} mN; falls with the field on {model['not_rising_share']:.0%}"
    )
    for wrong in (*result["faults"], *result["low_holds"]):
        print(f"  FAULT {wrong}")
    for shown in sorted(result["rows"], key=lambda shown: -shown["over_N"])[:6]:
        said = "".join(
            f", {name} {shown[name]:g}" for name in ("displacement_mm", "rate_mm_s") if shown[name] is not None
        )
        print(f"  {shown['over_N'] * 1e3:4.0f} mN over: {shown['device']}, {shown['hand']}, {shown['forces']}{said}")


def picture(path: Path, result: Json, found: list[tuple[Case, Figures]]) -> None:
    """Error over handle speed and asked force, once for the own sample and once for all the others."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    own, others = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, title, is_own in ((own, "sample 1", True), (others, "samples 2, 3 and draws", False)):
        points = [
            point
            for case, figures in found
            if (case.device == "sample_1") is is_own and case.displacement_mm is None and case.rate_mm_s is None
            for point in figures.settled
        ]
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


def main() -> int:
    """Measures, prints, and draws; 0 only if the bounds were kept and nothing faulted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a sample of it: two draws, short holds")
    parser.add_argument("--draws", type=int, default=DRAWS, help=f"random devices ({DRAWS})")
    parser.add_argument(
        "--hold-s", type=float, default=LOW_HOLD_S, help=f"a force under F_min is held ({LOW_HOLD_S:g})"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--picture", type=Path, help="PNG of the force error over handle speed and asked force")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    options = parser.parse_args()
    result, found = measure(options)
    print(json.dumps(result)) if options.json else print_table(result)
    if options.picture is not None:
        picture(options.picture, result, found)
    wrong = missed(result)
    for text in wrong:
        print(f"missed: {text}", file=sys.stderr)
    return 1 if wrong or result["faults"] else 0


if __name__ == "__main__":
    sys.exit(main())
