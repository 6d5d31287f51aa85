"""Motor logs of the simulated samples, made in virtual time, and what is true of them."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.ctl.calibrate_motors import COLUMNS, Side, excitation, motor_log
from tormagd.ctl.calibrate_run import RATE_HZ, VALID_FOR_MS, Columns, Range
from tormagd.lab.main import Found
from tormagd.lab.motor.fit import motion
from tormagd.lab.motor.identification import identify
from tormagd.lab.motor.log import Array, Log
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.static_laws import pull_of_magnets_N

SAMPLES = ("sample_1", "sample_2", "sample_3")
SIDES: tuple[Side, Side] = ("left", "right")
PERIOD_S = 1e-3


def judged() -> Found:
    """Identified beside true values of every sample and side; exit code 1 where one is outside its interval."""
    found = {}
    for sample in tqdm(SAMPLES, desc="samples", disable=None):
        ticks = record(sample)
        for side in SIDES:
            log = to_log(motor_log(ticks, side))
            for current in (log.current_A, None):
                kind = "voltage and gain" if current is None else "voltage and current"
                seen = log._replace(current_A=current)
                found[f"{sample} {side}, {kind}"] = compare(seen, load_plant(sample), side)
    is_inside = all(row["inside"] for rows in found.values() for row in rows.values())
    return Found({"samples": found, "inside": is_inside}, _lines(found), 0 if is_inside else 1)


def _lines(found: dict[str, dict[str, dict[str, Any]]]) -> Iterator[str]:
    for name, rows in found.items():
        yield f"{name}\n{'':16s}{'true':>12s}{'identified':>12s}{'+-':>10s}"
        for key, row in rows.items():
            mark = "" if row["inside"] else "  OUTSIDE its interval"
            yield f"{key:16s}{row['true']:12.5g}{row['value']:12.5g}{row['ci95']:10.2g}{mark}"


def compare(log: Log, plant: PlantParameters, side: Side) -> dict[str, dict[str, Any]]:
    """Identified and true, by parameter. Without a current in the log the true gain is given."""
    true = truth(plant, side, 2e3 * log.position_m[motion(log).sign != 0.0])
    result = identify(log, None if log.current_A is not None else true["gain_N_V"])
    identified = {**(result["motor"] or {}), **result["parameters"], "time_constant_s": result["time_constant_s"]}
    return {
        name: {**found, "true": true[name], "inside": abs(found["value"] - true[name]) <= found["ci95"]}
        for name, found in identified.items()
        if found is not None
    }


SHOWING_S = 1.0
"Before the excitation the device shows itself, as it does beside a daemon."


def record(sample: str, seed: int = 1, rounds: int = 2) -> Columns:
    """The control ticks of `tormagctl calibrate --motors` on a simulated device, in virtual time."""
    config = Config()
    core = build_core(config)
    device = VirtualDevice(load_plant(sample), SteadyHand(), seed=seed)
    loop = ClosedLoop(config, core.stepper, core.planner, device)
    loop.arm()
    if loop.plan_state is None:
        raise ValueError("core.planner: allowed is one that plans")
    for _ in loop.run(SHOWING_S):
        pass
    # the status of a daemon says the same: what this device gives with its gap open, as far as it has shown itself
    least_N = loop.plan_state.device.force_N(core.planner.portrait.least_N)
    waveform = excitation(Range(least_N, min(core.planner.portrait.most_N, core.scene.force.most_N)), rounds)
    start_s = loop.now_s

    def newest(now_s: float) -> TimedSetpoint:
        sent_s = math.floor((now_s - start_s) * RATE_HZ + 1e-9) / RATE_HZ
        return TimedSetpoint(waveform.at(sent_s).force_N, start_s + sent_s, VALID_FOR_MS * 1e-3)

    rows = []
    for sample_ in loop.run(waveform.duration_s, newest):
        measured, estimate, reference = loop.measurement, sample_.state.estimate, sample_.state.reference
        if measured is None or estimate is None or reference is None:
            raise RuntimeError(f"the run ended at {sample_.time_s:.1f} s: {sample_.state.safety}")
        rows.append(
            (
                measured.device_time_s,
                sample_.output.left_duty,
                sample_.output.right_duty,
                measured.supply_V,
                estimate.left_mm,
                estimate.right_mm,
                measured.left_current_A,
                measured.right_current_A,
                estimate.force_N,
                reference.gap_mm,
            )
        )
    return dict(zip(COLUMNS, np.array(rows).T, strict=True))


def to_log(columns: Columns) -> Log:
    """What `read_log` makes of the file."""
    return Log(columns["t_s"], columns["input_V"], columns["position_mm"] * 1e-3, None, columns["current_A"])


def truth(plant: PlantParameters, side: Side, gap_mm: Array) -> dict[str, float]:
    """What the plant file says, in the identified quantities; friction and offset as means over the gaps of the log.

    The delay runs from a row's positions to the middle of the millisecond in which its voltage acts: the Drive that
    carries it arrives when the next positions are taken, but for the device's reply jitter, half of it in the mean.
    """
    motor, gear, screw = plant.motor, plant.gear, plant.screw
    lead_m_rad = screw.lead_mm * 1e-3 / math.tau
    k = gear.ratio * motor.back_emf_V_s_rad / lead_m_rad
    mass = motor.inertia_kg_m2 * gear.ratio**2 / lead_m_rad**2
    idle_N = gear.output_friction_Nm / lead_m_rad
    drag_N = screw.drag_left_N if side == "left" else screw.drag_right_N
    pull_N = np.asarray(pull_of_magnets_N(gap_mm, plant))
    rub = screw.friction_coefficient * 0.5e-3 * plant.assumed.screw_mean_diameter_mm / lead_m_rad

    def slow(direction: float) -> Array:
        contact_N = pull_N + direction * drag_N
        load_N = direction * contact_N + rub * np.abs(contact_N)
        driving = idle_N + load_N / gear.efficiency
        braking = np.maximum(idle_N + load_N, (load_N + gear.efficiency * idle_N) / (2.0 - gear.efficiency))
        force_N: Array = np.where(load_N > 0.0, driving, braking) * direction
        return force_N

    opening, closing = slow(1.0), slow(-1.0)
    return {
        "gain_N_V": k / motor.resistance_Ohm,
        "resistance_ohm": motor.resistance_Ohm,
        "inductance_mH": motor.inductance_mH,
        "back_emf_V_s_m": k,
        "friction_viscous_N_s_m": 0.0,
        "gear_efficiency": gear.efficiency,
        "mass_kg": mass,
        "viscous_N_s_m": k**2 / motor.resistance_Ohm,
        "coulomb_N": float((opening - closing).mean()) / 2.0,
        "offset_N": float((opening + closing).mean()) / 2.0,
        "delay_s": 1.5 * PERIOD_S - 0.5e-6 * plant.firmware.reply_jitter_us,
        "time_constant_s": mass * motor.resistance_Ohm / k**2,
    }
