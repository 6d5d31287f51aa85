"""Identify a motor and its screw from a log: mass, friction, offset, delay, with 95% confidence.

Reads the CSV (`t_s,input_V,position_mm`, optionally `current_A`) that `tormagctl calibrate --motors` writes, or the
EMPS benchmark's .mat file. Volts and position alone fix only ratios to the gain: without `--gain-N-V` or a current the
physical values are null. All are referred to the carriage; `viscous_N_s_m` includes the back-EMF's part.

The first half of the log is fitted and the second half judged; the parameters come from all of it.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.motor.fit import Estimate, Gearbox, Windings, fit_gearbox, fit_volts, fit_windings
from tormag_lab.motor.log import Log, read_log
from tormagd.config import Config, Motor, load_config
from tormagd.ground.files import new_file

VAGUE_SHARE = 0.5
PARAMETERS = ("mass_kg", "viscous_N_s_m", "coulomb_N", "offset_N")
RATIOS = ("mass_V_s2_m", "viscous_V_s_m", "coulomb_V", "offset_V")
BACKLASH = "backlash: an encoder on the motor's side of the play cannot show it"


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, help="motor log CSV, or DATA_EMPS.mat")
    parser.add_argument("--gain-N-V", type=float, dest="gain", help="force per volt, N/V; replaces a current")
    parser.add_argument("--config", type=Path, help="whose gear ratio and screw lead hold; the defaults otherwise")
    parser.add_argument("--write-config", type=Path, metavar="FILE.toml", help="new file with the identified [motor]")


def run(options: argparse.Namespace) -> Found:
    log = read_log(options.log)
    result = identify(log, options.gain if options.gain is not None else log.gain_N_V)
    if options.write_config:
        write_config(options.write_config, result, load_config(options.config))
    return Found(result)


def identify(log: Log, gain_N_V: float | None) -> dict[str, Any]:
    """Return estimates (`value` and `ci95`), residuals and notes as plain data."""
    if gain_N_V is not None and not (math.isfinite(gain_N_V) and gain_N_V > 0.0):
        raise LabError(f"gain_N_V = {gain_N_V}: allowed is a finite number above 0")
    half = len(log.t_s) // 2
    measured, predicted = fit_volts(log.part(slice(None, half))).voltage(log.part(slice(half, None)))
    volts = fit_volts(log)
    ratios = (volts.mass, volts.viscous, volts.coulomb, volts.offset)
    notes, delay, motor = [BACKLASH], volts.delay, None
    found: tuple[Estimate | None, ...] = (None,) * len(PARAMETERS)
    if gain_N_V is not None:
        found = tuple(ratio.scaled(gain_N_V) for ratio in ratios)
        notes.append("gain: taken as given, without an interval of its own")
    elif log.current_A is not None:
        windings = fit_windings(log)
        gearbox = fit_gearbox(log, windings.back_emf.value)
        found, delay = physical(windings, gearbox), windings.delay
        motor = motor_parameters(windings, gearbox)
        gain_N_V = motor["gain_N_V"].value
    else:
        notes.append("no gain and no current: only ratios to the gain show")
    return {
        "parameters": {
            **{name: _plain(estimate) for name, estimate in zip(PARAMETERS, found, strict=True)},
            "delay_s": _plain(delay),
            "backlash_um": None,
        },
        "ratios_to_gain": {name: _plain(ratio) for name, ratio in zip(RATIOS, ratios, strict=True)},
        "motor": None if motor is None else {name: _plain(estimate) for name, estimate in motor.items()},
        "gain_N_V": gain_N_V,
        "relative_residual": volts.relative_residual,
        "holdout_voltage_nrmse": float(np.linalg.norm(measured - predicted) / np.linalg.norm(measured)),
        "notes": notes,
    }


def physical(windings: Windings, gearbox: Gearbox) -> tuple[Estimate, ...]:
    """Return mass, kg, viscous friction with the back-EMF's drag, N s/m, Coulomb friction and offset, N."""
    braking = _product((windings.back_emf, 2), (windings.resistance, -1))
    viscous = Estimate(braking.value + gearbox.viscous.value, braking.ci95 + gearbox.viscous.ci95)
    return gearbox.mass, viscous, gearbox.coulomb, gearbox.offset


def motor_parameters(windings: Windings, gearbox: Gearbox) -> dict[str, Estimate]:
    """Return what only a log with a current shows, by name, referred to the carriage."""
    return {
        "gain_N_V": _product((windings.back_emf, 1), (windings.resistance, -1)),
        "resistance_ohm": windings.resistance,
        "inductance_mH": windings.inductance.scaled(1e3),
        "back_emf_V_s_m": windings.back_emf,
        "friction_viscous_N_s_m": gearbox.viscous,
        "gear_efficiency": gearbox.efficiency,
        "mass_kg": gearbox.mass,
        "coulomb_N": gearbox.coulomb,
    }


def _product(*factors: tuple[Estimate, int]) -> Estimate:
    value = math.prod(estimate.value**power for estimate, power in factors)
    width = math.hypot(*(power * estimate.ci95 / estimate.value for estimate, power in factors))
    return Estimate(value, abs(value) * width)


def _plain(estimate: Estimate | None) -> dict[str, float] | None:
    return None if estimate is None else estimate._asdict()


def write_config(path: Path, result: dict[str, Any], config: Config) -> None:
    """Write a new file with `[motor]`: the identified values, and the others from `config`."""
    found = result["motor"]
    if found is None:
        raise LabError("--write-config: needs a log with current_A, and no --gain-N-V")
    advance_m_rad = config.motor.screw_lead_mm * 1e-3 / (math.tau * config.motor.gear_ratio)
    identified = {
        "resistance_ohm": found["resistance_ohm"]["value"],
        "back_emf_V_s": found["back_emf_V_s_m"]["value"] * advance_m_rad,
        "inertia_kg_m2": found["mass_kg"]["value"] * advance_m_rad**2,
        "gear_efficiency": found["gear_efficiency"]["value"],
        "coulomb_V": found["coulomb_N"]["value"] / found["gain_N_V"]["value"],
    }
    inductance = found["inductance_mH"]
    if inductance["ci95"] < VAGUE_SHARE * inductance["value"]:  # a log at 1 kHz hardly shows it
        identified["inductance_mH"] = inductance["value"]
    kept = msgspec.to_builtins(config.motor)
    table = kept | {name: float(f"{value:.4g}") for name, value in identified.items()}
    head = f"# identified by tormag-lab identify-motor: {', '.join(identified)}; the rest as configured"
    lines = [head, "[motor]", *(f"{name} = {value!r}" for name, value in table.items())]
    try:
        msgspec.convert(table, Motor)
        with new_file(path):
            path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    except msgspec.ValidationError as error:
        raise LabError(f"--write-config: {table}: {error}") from error
    except OSError as error:
        raise LabError(f"{path}: {error.strerror}") from error
