"""Identifies a motor and its screw from a log: mass, friction, offset, delay, with 95% confidence.

Reads the motor log CSV (`t_s,input_V,position_mm`, optionally `current_A`) that `tormagctl calibrate --motors` writes,
or the EMPS benchmark's .mat file, which states its own gain. `motor_fit` says with which models, and what the intervals
cover. Volts and position alone fix only ratios to the gain: without `--gain-N-V` or a current the physical values are
null. Everything is referred to the carriage; `viscous_N_s_m` is the slope of gain times voltage over speed, the
back-EMF's part included.

The first half of the log is fitted and the second half judged; the parameters come from all of it. `--samples` makes
such logs of the simulated device in virtual time and prints what was identified beside what is true.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from motor_fit import THINNED_HZ, Estimate, Gearbox, Volts, Windings, fit_gearbox, fit_volts, fit_windings
from motor_log import Log, LogError, read_log

from tormagd.config import Config, ConfigError, Motor, load_config

PARAMETERS = ("mass_kg", "viscous_N_s_m", "coulomb_N", "offset_N")
RATIOS = ("mass_V_s2_m", "viscous_V_s_m", "coulomb_V", "offset_V")
VAGUE_SHARE = 0.5
BACKLASH = "backlash: an encoder on the motor's side of the play cannot show it"


def main() -> int:
    """Prints the parameters; 2 where the log or the configuration cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path, nargs="?", help="motor log CSV, or DATA_EMPS.mat")
    parser.add_argument("--gain-N-V", type=float, dest="gain", help="force per volt, N/V; replaces a current")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="measured against simulated voltage")
    parser.add_argument("--config", type=Path, help="whose gear ratio and screw lead hold; the defaults otherwise")
    parser.add_argument("--write-config", type=Path, metavar="FILE.toml", help="new file with the identified [motor]")
    parser.add_argument("--samples", action="store_true", help="identify the simulated samples, beside the truth")
    options = parser.parse_args()
    if options.samples == (options.log is not None):
        parser.error("give either a log or --samples")
    if options.samples:
        import motor_samples

        return motor_samples.main(options.json)
    try:
        log = read_log(options.log)
        result = identify(log, options.gain if options.gain is not None else log.gain_N_V)
        if options.write_config:
            write_config(options.write_config, result, load_config(options.config))
    except (LogError, ConfigError) as error:
        print(f"identify_motor: {error}", file=sys.stderr)
        return 2
    if options.plot:
        draw(options.plot, log, result)
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0


def identify(log: Log, gain_N_V: float | None) -> dict[str, Any]:
    """The contract's object. Raises LogError where the log does not move enough to show anything."""
    if gain_N_V is not None and not (math.isfinite(gain_N_V) and gain_N_V > 0.0):
        raise LogError(f"gain_N_V = {gain_N_V}: allowed is a finite number above 0")
    half = len(log.t_s) // 2
    measured, predicted = fit_volts(log.part(slice(None, half))).voltage(log.part(slice(half, None)))
    volts = fit_volts(log)
    ratios = (volts.mass, volts.viscous, volts.coulomb, volts.offset)
    has_current = log.current_A is not None and gain_N_V is None
    notes = [BACKLASH]
    delay, motor = volts.delay, None
    found: tuple[Estimate | None, ...]
    if has_current:
        windings = fit_windings(log)
        gearbox = fit_gearbox(log, windings.back_emf.value)
        found, delay = physical(windings, gearbox), windings.delay
        motor = motor_parameters(windings, gearbox)
        gain_N_V = motor["gain_N_V"].value
    elif gain_N_V is not None:
        found = tuple(ratio.scaled(gain_N_V) for ratio in ratios)
        notes.append("gain: taken as given, without an interval of its own")
    else:
        found = (None,) * len(PARAMETERS)
        notes.append("no gain and no current: only ratios to the gain show")
    return {
        "parameters": {
            **{name: _plain(estimate) for name, estimate in zip(PARAMETERS, found, strict=True)},
            "delay_s": _plain(delay),
            "backlash_um": None,
        },
        "ratios_to_gain": {name: _plain(ratio) for name, ratio in zip(RATIOS, ratios, strict=True)},
        "motor": None if motor is None else {name: _plain(estimate) for name, estimate in motor.items()},
        "time_constant_s": _plain(_time_constant(volts, motor)),
        "gain_N_V": gain_N_V,
        "relative_residual": volts.relative_residual,
        "holdout_voltage_nrmse": float(np.linalg.norm(measured - predicted) / np.linalg.norm(measured)),
        "notes": notes,
    }


def physical(windings: Windings, gearbox: Gearbox) -> tuple[Estimate, ...]:
    """The contract's four parameters: the back-EMF brakes the carriage as drag of K^2 / R does."""
    k, resistance = windings.back_emf, windings.resistance
    braking = k.value**2 / resistance.value
    width = braking * math.hypot(2.0 * k.ci95 / k.value, resistance.ci95 / resistance.value)
    viscous = Estimate(braking + gearbox.viscous.value, width + gearbox.viscous.ci95)
    return gearbox.mass, viscous, gearbox.coulomb, gearbox.offset


def motor_parameters(windings: Windings, gearbox: Gearbox) -> dict[str, Estimate]:
    """What a current shows besides: the motor as the carriage feels it, gain in N/V."""
    k, resistance = windings.back_emf, windings.resistance
    gain = k.value / resistance.value
    width = gain * math.hypot(k.ci95 / k.value, resistance.ci95 / resistance.value)
    return {
        "gain_N_V": Estimate(gain, width),
        "resistance_ohm": resistance,
        "inductance_mH": windings.inductance.scaled(1e3),
        "back_emf_V_s_m": k,
        "friction_viscous_N_s_m": gearbox.viscous,
        "gear_efficiency": gearbox.efficiency,
        "mass_kg": gearbox.mass,
        "coulomb_N": gearbox.coulomb,
    }


def _time_constant(volts: Volts, motor: dict[str, Estimate] | None) -> Estimate:
    """Of the speed after a voltage step: mass R / K^2, or mass over drag where only ratios are known."""
    if motor is None:
        factors = [(volts.mass, 1.0), (volts.viscous, -1.0)]
    else:
        factors = [(motor["mass_kg"], 1.0), (motor["resistance_ohm"], 1.0), (motor["back_emf_V_s_m"], -2.0)]
    value = math.prod(estimate.value**power for estimate, power in factors)
    width = math.hypot(*(power * estimate.ci95 / estimate.value for estimate, power in factors))
    return Estimate(value, abs(value) * width)


def _plain(estimate: Estimate | None) -> dict[str, float] | None:
    return None if estimate is None else estimate._asdict()


def write_config(path: Path, result: dict[str, Any], config: Config) -> None:
    """A configuration file with the identified motor, for the gear ratio and lead of `config`.

    Raises LogError where the log cannot fill it, the file exists, or a value is one that `tormagd` would refuse.
    """
    found = result["motor"]
    if found is None:
        raise LogError("--write-config: needs a log with current_A, and no --gain-N-V")
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
            file.write(f"# identified by tools/identify_motor.py: {', '.join(identified)}; the rest as configured\n")
            file.write("[motor]\n")
            file.writelines(f"{name} = {value!r}\n" for name, value in table.items())
    except msgspec.ValidationError as error:
        raise LogError(f"--write-config: {table}: {error}") from error
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from error


def print_table(result: dict[str, Any]) -> None:
    """The parameters for a person."""
    tables = (result["parameters"], result["ratios_to_gain"], result["motor"] or {})
    for name, found in (tables[2] | tables[1] | tables[0] | {"time_constant_s": result["time_constant_s"]}).items():
        print(
            f"{name:24s}"
            + ("not shown by this log" if found is None else f"{found['value']:12.5g} +- {found['ci95']:.2g}")
        )
    print(f"residual {result['relative_residual']:.1%} of the voltage; held out {result['holdout_voltage_nrmse']:.1%}")
    for note in result["notes"]:
        print(note)


def draw(path: Path, log: Log, result: dict[str, Any]) -> None:
    """Measured against simulated voltage on the half that was not fitted."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    half = len(log.t_s) // 2
    fitted = fit_volts(log.part(slice(None, half)))
    time_s, measured, predicted = fitted.over_time(log.part(slice(half, None)))
    figure, (above, below) = plt.subplots(2, 1, figsize=(11, 6), sharex=True, constrained_layout=True)
    above.plot(time_s, measured, color="#222222", label="measured")
    above.plot(time_s, predicted, color="#d1495b", linewidth=1.0, label="from the fit of the other half")
    above.legend(frameon=False, ncols=2)
    above.set_ylabel("input, V")
    error = result["holdout_voltage_nrmse"]
    above.set_title(f"Held-out half, {THINNED_HZ:.0f} Hz: relative error {error:.1%}; gaps where it stands", loc="left")
    below.plot(time_s, measured - predicted, color="#2a6f97", linewidth=0.8)
    below.set_ylabel("difference, V")
    below.set_xlabel("time, s")
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
