"""`benchmark step`: how fast and how exactly the gap follows, on the plant in virtual time.

The device's physical limit comes from the plant itself: full voltage one way, then the other, switched so that it comes
to rest at the target.
"""

import argparse
import gc
import math
import time
from typing import Any

import msgspec
import numpy as np

from tormagd.commission.gains import corner_margins
from tormagd.config import Config, Motor
from tormagd.control.core import Stepper
from tormagd.control.move.motor import margins, zero_order_hold
from tormagd.element.physics.errors import FloatArray as Array
from tormagd.scenes.scene import load_scene
from tormagd.simulation.closed_loop import ClosedLoop, gap_plan
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant, standing
from tormagd.simulation.plant import Plant

START_MM, STEP_MM = 60.0, 1.0
STROKE_MM = (46.0, 94.0)
"Within both ends' braking distance; the figure is scaled to the full 50 mm."
STROKE_GAPS_MM = (47.0, 51.0, 57.0, 64.0, 71.0, 78.0, 85.0, 93.0)
MODEL_GAP_MM, MODEL_DUTY, MODEL_S = 70.0, 0.5, 0.15
"A duty step from rest in the middle of the stroke, with which H(z) is compared."
WATCHED_S = 0.6
SETTLING_BAND = 0.05
TICK_S = 1e-3


def measure(options: argparse.Namespace) -> dict[str, Any]:
    config, parameters = Config(), load_plant(options.plant)
    gc.collect()
    gc.disable()  # what is kept here is no garbage
    started_s = time.thread_time()
    loop = settled_loop(config, parameters)
    steps = [step(loop, START_MM + STEP_MM), step(loop, START_MM)]
    stroke_s = stroke(loop)
    over_stroke = overshoot_over_stroke(loop)
    factor = loop.now_s / (time.thread_time() - started_s)
    gc.enable()
    fastest_s = [time_optimal(parameters, START_MM, length_mm)[0] for length_mm in (STEP_MM, -STEP_MM)]
    nominal = margins(config.motor, config.position, TICK_S)
    return {
        "plant": options.plant,
        **{name: max(found[name] for found in steps) for name in steps[0]},
        "overshoot_over_stroke": over_stroke,
        "rise_over_time_optimal": max(found["rise_s"] / s for found, s in zip(steps, fastest_s, strict=True)),
        "stroke_ratio": stroke_s / time_optimal(parameters, STROKE_MM[0], STROKE_MM[1] - STROKE_MM[0])[1],
        "gain_margin_dB": nominal.gain_margin_dB,
        "phase_margin_deg": nominal.phase_margin_deg,
        "corners": corner_margins(config),
        "model_nrmse": max(nrmse(*model_step(config.motor, parameters, sign * MODEL_DUTY)) for sign in (1.0, -1.0)),
        "virtual_time_factor": factor,
    }


def settled_loop(config: Config, parameters: PlantParameters) -> ClosedLoop:
    # a moving handle would feel forces over the scene's at the closed end, which is a fault
    device = VirtualDevice(parameters, RecordedHand((0.0,), (0.0,)), seed=1)
    loop = ClosedLoop(config, Stepper(config, load_scene("coronary")), None, device)
    loop.arm(gap_plan(95.0))
    list(loop.hold(START_MM, 3.0))
    return loop


def step(loop: ClosedLoop, target_mm: float) -> dict[str, float]:
    before = loop.stepper.measured
    assert before is not None, "this loop has run"
    start_mm, start_s = before.gap_mm, loop.now_s
    samples = list(loop.hold(target_mm, WATCHED_S))
    time_s = np.array([sample.time_s - start_s for sample in samples])
    estimates = [sample.measured for sample in samples if sample.measured is not None]
    gap = np.array([estimate.gap_mm for estimate in estimates])
    share = (gap - start_mm) / (target_mm - start_mm)
    outside = np.flatnonzero(np.abs(share - 1.0) > SETTLING_BAND)
    return {
        "rise_s": _rise(time_s, share),
        "overshoot": max(0.0, float(share.max()) - 1.0),
        "settling_5pct_s": float(time_s[outside[-1]]) if outside.size else 0.0,
        "steady_error_um": abs(float(gap[-1]) - target_mm) * 1e3,
        "skew_um": max(abs(estimate.skew_mm) for estimate in estimates) * 1e3,
    }


def stroke(loop: ClosedLoop) -> float:
    list(loop.hold(STROKE_MM[0], 3.0))
    gap = np.array([sample.truth.gap_mm for sample in loop.hold(STROKE_MM[1], 3.0)])
    return float(np.argmax(gap > STROKE_MM[1] - 0.05) + 1) * TICK_S


def overshoot_over_stroke(loop: ClosedLoop) -> float:
    """Return the largest overshoot of steps from STROKE_GAPS_MM, both ways, as a share of the step."""
    worst = 0.0
    # the first step that closes would go past the end of the stroke
    for gap_mm, target_mm in [(gap_mm, gap_mm + way) for gap_mm in STROKE_GAPS_MM for way in (STEP_MM, -STEP_MM)]:
        if target_mm >= STROKE_GAPS_MM[0]:
            list(loop.hold(gap_mm, 0.8))
            worst = max(worst, step(loop, target_mm)["overshoot"])
    return worst


def model_step(motor: Motor, parameters: PlantParameters, duty: float) -> tuple[Array, Array]:
    """Return both carriages' mean position every tick of a duty step, by the encoders and by H(z)."""
    plant = Plant(standing(parameters, MODEL_GAP_MM / 2.0, MODEL_GAP_MM / 2.0), SteadyHand())
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
    from scipy.signal import lfilter  # takes 0.6 s to import, and only this needs it

    return measured, lfilter(transfer.numerator, transfer.denominator, driving)


def nrmse(measured: Array, modelled: Array) -> float:
    return float(np.linalg.norm(measured - modelled) / np.linalg.norm(measured - measured.mean()))


def time_optimal(parameters: PlantParameters, start_mm: float, distance_mm: float) -> tuple[float, float]:
    """Return the plant's fastest rise from 10 to 90 %, and from rest to rest, s."""
    low, high = 0.0, 4.0
    for _ in range(16):  # to less than a tick of the plant
        middle = (low + high) / 2.0
        gap, _ = bang_bang(parameters, start_mm, distance_mm, middle)
        if abs(gap[-1] - start_mm) < abs(distance_mm):
            low = middle
        else:
            high = middle
    gap, total_s = bang_bang(parameters, start_mm, distance_mm, low)
    time_s = np.arange(1, len(gap) + 1, dtype=np.float64) * TICK_S / 10.0
    return _rise(time_s, (gap - start_mm) / distance_mm), total_s


def bang_bang(parameters: PlantParameters, start_mm: float, distance_mm: float, switch_s: float) -> tuple[Array, float]:
    """Return the true gap every 0.1 ms until rest, and that time, for full voltage reversed at `switch_s`."""
    gaps: list[float] = []
    time_s, tick = 0.0, TICK_S / 10.0
    plant = Plant(standing(parameters, start_mm / 2.0, start_mm / 2.0), SteadyHand(), substep_s=tick)
    volts = np.sign(distance_mm) * parameters.electronics.supply_V
    is_turning = False
    while not is_turning and time_s <= 6.0:
        time_s = (len(gaps) + 1) * tick
        applied = volts if time_s <= switch_s else -volts
        before = plant.gap_mm
        plant.drive(applied, applied)
        plant.advance(tick)
        gaps.append(plant.gap_mm)
        is_turning = time_s > switch_s and (plant.gap_mm - before) * distance_mm <= 0.0
    return np.array(gaps), time_s


OPTIONS = {"--plant": {"default": "sample_1", "help": "plant file or the name of a committed sample"}}


def _rise(time_s: Array, share: Array) -> float:
    return float(time_s[np.argmax(share >= 0.9)] - time_s[np.argmax(share >= 0.1)])
