"""`benchmark step`: how fast and how exactly the gap follows, on the plant in virtual time.

The device's physical limit comes from the plant itself: full voltage one way, then full voltage the other way, with the
switch timed so that it comes to rest at the target.
"""

import argparse
import gc
import itertools
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from pictures.stamp import stamp

from tormagd.closed_loop import ClosedLoop, Sample
from tormagd.config import Config, Motor
from tormagd.control.motor import margins, zero_order_hold
from tormagd.control.plan import Plan
from tormagd.control.step import Stepper
from tormagd.lab.tune_position import corner_margins
from tormagd.scenes.scene import EVERY_TERM, load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.plant import Plant

Array = npt.NDArray[np.float64]

START_MM, STEP_MM = 60.0, 1.0
STROKE_MM = (46.0, 94.0)
"The stroke within both ends' braking distance; the figure is scaled to the full 50 mm."
STROKE_GAPS_MM = (47.0, 51.0, 57.0, 64.0, 71.0, 78.0, 85.0, 93.0)
"Where the overshoot is measured too, opening and closing by STEP_MM."
MODEL_GAP_MM, MODEL_DUTY, MODEL_S = 70.0, 0.5, 0.15
"A duty step from rest in the middle of the stroke, with which H(z) is compared."
WATCHED_S = 0.6
SETTLING_BAND = 0.05
TICK_S = 1e-3


class Modelled(NamedTuple):
    """Both carriages' mean position from the start of a duty step, mm, as the encoders count it and by H(z)."""

    time_s: Array
    measured_mm: Array
    modelled_mm: Array

    @property
    def nrmse(self) -> float:
        """|measured - modelled| / |measured - mean(measured)|, norms."""
        deviation = self.measured_mm - self.measured_mm.mean()
        return float(np.linalg.norm(self.measured_mm - self.modelled_mm) / np.linalg.norm(deviation))


class Step(NamedTuple):
    """One step of the gap, seen by the encoders; the plant's true error beside it."""

    rise_s: float
    overshoot: float
    settling_5pct_s: float
    steady_error_um: float
    true_error_um: float
    skew_um: float
    time_s: Array
    gap_mm: Array


def run(plant_name: str = "sample_1", config: Config | None = None) -> dict[str, Any]:
    """The contract's keys, for steps that open and that close; `worst` of both is what counts."""
    config = config or Config()
    parameters = load_plant(plant_name)
    gc.collect()
    gc.disable()  # what is kept here is no garbage, and need not be looked through again and again
    started_s = time.thread_time()
    loop = settled_loop(config, parameters)
    opening = step(loop, START_MM + STEP_MM)
    closing = step(loop, START_MM)
    stroke_s = stroke(loop)
    over_stroke = overshoot_over_stroke(loop)
    factor = loop.now_s / (time.thread_time() - started_s)
    gc.enable()
    limits = {+1: time_optimal(parameters, START_MM, STEP_MM), -1: time_optimal(parameters, START_MM, -STEP_MM)}
    span = STROKE_MM[1] - STROKE_MM[0]
    physical_s = time_optimal(parameters, STROKE_MM[0], span).total_s
    nominal = margins(config.motor, config.position, TICK_S)
    corners = corner_margins(config)
    return {
        "plant": plant_name,
        "rise_s": max(opening.rise_s, closing.rise_s),
        "overshoot": max(opening.overshoot, closing.overshoot),
        "settling_5pct_s": max(opening.settling_5pct_s, closing.settling_5pct_s),
        "steady_error_um": max(opening.steady_error_um, closing.steady_error_um),
        "true_error_um": max(opening.true_error_um, closing.true_error_um),
        "overshoot_over_stroke": over_stroke,
        "skew_um": max(opening.skew_um, closing.skew_um),
        "rise_over_time_optimal": max(opening.rise_s / limits[1].rise_s, closing.rise_s / limits[-1].rise_s),
        "stroke_ratio": stroke_s / physical_s,
        "gain_margin_dB": nominal.gain_margin_dB,
        "phase_margin_deg": nominal.phase_margin_deg,
        "corners": corners,
        "model_nrmse": max(model_step(config.motor, parameters, sign * MODEL_DUTY).nrmse for sign in (1.0, -1.0)),
        "virtual_time_factor": factor,
    }


def settled_loop(config: Config, parameters: PlantParameters, left_out: tuple[str, ...] = ()) -> ClosedLoop:
    """A loop without these terms that is homed, enabled, and at rest at START_MM."""
    # a handle in motion would feel forces over the scene's at the closed end, which is a fault
    device = VirtualDevice(parameters, RecordedHand((0.0,), (0.0,)), seed=1)
    scene = msgspec.structs.replace(load_scene("coronary"), terms=EVERY_TERM.without(*left_out))
    loop = ClosedLoop(config, Stepper(config, scene), None, device)
    loop.arm(hold(95.0, 0.0))
    drive(loop, START_MM, 3.0)
    return loop


def step(loop: ClosedLoop, target_mm: float) -> Step:
    """One step to a gap, from rest."""
    before = loop.step_state.estimate
    if before is None:
        raise RuntimeError("the loop has no measurement")
    start_mm, start_s = before.gap_mm, loop.now_s
    samples = drive(loop, target_mm, WATCHED_S)
    time_s = np.array([sample.time_s - start_s for sample in samples])
    estimates = [sample.state.estimate for sample in samples if sample.state.estimate is not None]
    gap = np.array([estimate.gap_mm for estimate in estimates])
    share = (gap - start_mm) / (target_mm - start_mm)
    outside = np.flatnonzero(np.abs(share - 1.0) > SETTLING_BAND)
    return Step(
        rise_s=_rise(time_s, share),
        overshoot=max(0.0, float(share.max()) - 1.0),
        settling_5pct_s=float(time_s[outside[-1]]) if outside.size else 0.0,
        steady_error_um=abs(float(gap[-1]) - target_mm) * 1e3,
        true_error_um=abs(samples[-1].truth.gap_mm - target_mm) * 1e3,
        skew_um=max(abs(estimate.skew_mm) for estimate in estimates) * 1e3,
        time_s=time_s,
        gap_mm=gap,
    )


def stroke(loop: ClosedLoop) -> float:
    """Time from the first to the last millimetre of the stroke, opening, s."""
    drive(loop, STROKE_MM[0], 3.0)
    samples = drive(loop, STROKE_MM[1], 3.0)
    gap = np.array([sample.truth.gap_mm for sample in samples])
    return float(np.argmax(gap > STROKE_MM[1] - 0.05) + 1) * TICK_S


def overshoot_over_stroke(loop: ClosedLoop) -> float:
    """The largest overshoot of steps from STROKE_GAPS_MM, both ways, share of the step."""
    worst = 0.0
    for gap_mm in STROKE_GAPS_MM:
        for direction in (1.0, -1.0):
            if gap_mm + direction * STEP_MM < STROKE_GAPS_MM[0]:
                continue  # past the end of the stroke
            drive(loop, gap_mm, 0.8)
            worst = max(worst, step(loop, gap_mm + direction * STEP_MM).overshoot)
    return worst


def model_step(motor: Motor, parameters: PlantParameters, duty: float) -> Modelled:
    """The plant's answer to a duty step beside that of H(z): the step less the Coulomb duty, and the motor's inertia
    over the gears' efficiency, because they take their share of the torque that speeds it up.
    """
    side_mm = MODEL_GAP_MM / 2.0
    at_rest = msgspec.structs.replace(parameters.assumed, start_left_mm=side_mm, start_right_mm=side_mm)
    plant = Plant(msgspec.structs.replace(parameters, assumed=at_rest), SteadyHand())
    volts = duty * parameters.electronics.supply_V
    counts_per_rad = parameters.electronics.encoder_counts_per_rev / math.tau
    count = round(MODEL_S / TICK_S)
    measured = np.zeros(count + 1)
    plant.drive(volts, volts)
    for tick in range(1, count + 1):
        plant.advance(TICK_S)
        turned = [round(axis.angle_rad * counts_per_rad) for axis in (plant.left, plant.right)]
        measured[tick] = sum(turned) / 2.0 / counts_per_rad * motor.screw_lead_mm / math.tau
    geared = msgspec.structs.replace(motor, inertia_kg_m2=motor.inertia_kg_m2 / motor.gear_efficiency)
    transfer = zero_order_hold(geared, TICK_S)
    driving = np.full(count + 1, duty - math.copysign(motor.coulomb_V / motor.supply_V, duty))
    from scipy.signal import lfilter  # takes 0.6 s to import, and who only runs a loop needs it not

    modelled: Array = lfilter(transfer.numerator, transfer.denominator, driving)
    return Modelled(TICK_S * np.arange(count + 1, dtype=np.float64), measured, modelled)


def draw(path: Path, plant_name: str, config: Config, figures: dict[str, Any]) -> None:
    """Writes a PNG, stamped with these figures: H(z) beside the plant's duty steps, and the gap's 1 mm steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    parameters = load_plant(plant_name)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), constrained_layout=True)
    for duty, colour in ((MODEL_DUTY, "#2a6f97"), (-MODEL_DUTY, "#d1495b")):
        found = model_step(config.motor, parameters, duty)
        left.plot(
            found.time_s, found.measured_mm, color=colour, linewidth=2.5, alpha=0.4, label=f"plant, duty {duty:+g}"
        )
        left.plot(
            found.time_s, found.modelled_mm, color="#222222", linewidth=1.0, label=f"H(z), NRMSE {found.nrmse:.1%}"
        )
    left.set_title(f"Duty step from rest at a gap of {MODEL_GAP_MM:g} mm", loc="left")
    left.set_ylabel("carriage, mm")
    loop = settled_loop(config, parameters)
    for target_mm, colour in ((START_MM + STEP_MM, "#2a6f97"), (START_MM, "#d1495b")):
        found_step = step(loop, target_mm)
        right.plot(found_step.time_s, found_step.gap_mm, color=colour, label=f"to {target_mm:g} mm")
        right.axhline(target_mm, color="#8d99ae", linewidth=0.8, linestyle=":")
    right.set_xlim(0.0, 0.15)
    right.set_title(f"Gap step, {plant_name} (synthetic)", loc="left")
    right.set_ylabel("gap by the encoders, mm")
    for axes in (left, right):
        axes.set_xlabel("time, s")
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110, metadata=stamp(figures))
    plt.close(figure)


class Optimum(NamedTuple):
    """The fastest the plant can do: rise from 10 to 90 %, and from rest to rest."""

    rise_s: float
    total_s: float


def time_optimal(parameters: PlantParameters, start_mm: float, distance_mm: float) -> Optimum:
    """Bang-bang on the plant: the latest switch that still comes to rest at the target, by bisection."""
    low, high = 0.0, 4.0
    for _ in range(30):
        middle = (low + high) / 2.0
        gap, _ = bang_bang(parameters, start_mm, distance_mm, middle)
        if abs(gap[-1] - start_mm) < abs(distance_mm):
            low = middle
        else:
            high = middle
    gap, total_s = bang_bang(parameters, start_mm, distance_mm, low)
    time_s = np.arange(1, len(gap) + 1, dtype=np.float64) * TICK_S / 10.0
    return Optimum(_rise(time_s, (gap - start_mm) / distance_mm), total_s)


def bang_bang(parameters: PlantParameters, start_mm: float, distance_mm: float, switch_s: float) -> tuple[Array, float]:
    """True gap every 0.1 ms until rest, and the time of that, for full voltage that turns round at `switch_s`."""
    at_rest = msgspec.structs.replace(parameters.assumed, start_left_mm=start_mm / 2, start_right_mm=start_mm / 2)
    gaps, time_s, tick = [], 0.0, TICK_S / 10.0
    plant = Plant(msgspec.structs.replace(parameters, assumed=at_rest), SteadyHand(), substep_s=tick)
    volts = np.sign(distance_mm) * parameters.electronics.supply_V
    for count in itertools.count(1):
        time_s = count * tick
        applied = volts if time_s <= switch_s else -volts
        before = plant.gap_mm
        plant.drive(applied, applied)
        plant.advance(tick)
        gaps.append(plant.gap_mm)
        is_turning = time_s > switch_s and (plant.gap_mm - before) * distance_mm <= 0.0
        if is_turning or time_s > 6.0:
            return np.array(gaps), time_s
    raise AssertionError("count ends never")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark step`."""
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--plot", type=Path, help="PNG of H(z) beside the plant, and of the steps")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The object for these options."""
    result = run(options.plant)
    if options.plot is not None:
        draw(options.plot, options.plant, Config(), result)
    return result


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    for name, value in result.items():
        if name == "corners":
            print(
                f"{'smallest margins':24s}{value['gain_margin_dB']:.1f} dB, {value['phase_margin_deg']:.0f} degrees "
                f"over {value['corners']:.0f} corners"
            )
        else:
            print(f"{name:24s}{value if isinstance(value, str) else f'{value:.4g}'}")


def hold(gap_mm: float, now_s: float) -> Plan:
    """A plan that asks for a gap and nothing else."""
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())


def drive(loop: ClosedLoop, gap_mm: float, duration_s: float) -> list[Sample]:
    """Asks for one gap for a while."""
    return [loop.tick(plan=hold(gap_mm, loop.now_s)) for _ in range(round(duration_s / TICK_S))]


def _rise(time_s: Array, share: Array) -> float:
    return float(time_s[np.argmax(share >= 0.9)] - time_s[np.argmax(share >= 0.1)])
