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

from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.motor.fit import THINNED_HZ, fit_volts
from tormag_lab.motor.identification import identify
from tormag_lab.motor.log import Log, read_log
from tormag_lab.pages import draw_beside
from tormagd.config import Config, Motor, load_config

VAGUE_SHARE = 0.5


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, help="motor log CSV, or DATA_EMPS.mat")
    parser.add_argument("--gain-N-V", type=float, dest="gain", help="force per volt, N/V; replaces a current")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="measured against simulated voltage")
    parser.add_argument("--config", type=Path, help="whose gear ratio and screw lead hold; the defaults otherwise")
    parser.add_argument("--write-config", type=Path, metavar="FILE.toml", help="new file with the identified [motor]")


def run(options: argparse.Namespace) -> Found:
    if options.plot is not None and options.plot.suffix != ".png":
        raise LabError(f"--plot {options.plot}: allowed is a name that ends with .png")
    log = read_log(options.log)
    result = identify(log, options.gain if options.gain is not None else log.gain_N_V)
    if options.write_config:
        write_config(options.write_config, result, load_config(options.config))
    if options.plot:
        draw(options.plot, log, result)
    return Found(result)


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
    try:
        msgspec.convert(table, Motor)
        with path.open("x", encoding="utf-8") as file:
            file.write(f"# identified by tormag-lab identify-motor: {', '.join(identified)}; the rest as configured\n")
            file.write("[motor]\n")
            file.writelines(f"{name} = {value!r}\n" for name, value in table.items())
    except msgspec.ValidationError as error:
        raise LabError(f"--write-config: {table}: {error}") from error
    except OSError as error:
        raise LabError(f"{path}: {error.strerror}") from error


def draw(path: Path, log: Log, result: dict[str, Any]) -> None:
    half = len(log.t_s) // 2
    fitted = fit_volts(log.part(slice(None, half)))
    time_s, measured, predicted = fitted.over_time(log.part(slice(half, None)))
    draw_beside(
        path,
        time_s,
        measured,
        predicted,
        labels=("from the fit of the other half", "input, V", "difference, V"),
        title=f"Held-out half, {THINNED_HZ:.0f} Hz: relative error {result['holdout_voltage_nrmse']:.1%}; "
        "gaps where it stands",
    )
