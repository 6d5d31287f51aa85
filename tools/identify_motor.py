"""Identifies a motor and its screw from a log: mass, friction, offset, delay, with 95% confidence.

The model is inverse dynamics, linear in what is sought (Gautier and Khalil):

    gain V(t - delay) = mass a + viscous v + coulomb sign(v) + offset

Position is low-passed without lag and differentiated centrally; both sides are filtered alike and thinned, so that the
residuals left are nearly independent and the confidence intervals honest. The first half of the log is fitted, the
second half judged. Volts and position alone fix only ratios to the gain: without `--gain-N-V` the physical values are
null.

Reads the motor log CSV (`t_s,input_V,position_mm`) or the EMPS benchmark's .mat file, which states its own gain.
"""

import argparse
import csv
import json
import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.optimize import minimize_scalar
from scipy.signal import butter, decimate, sosfiltfilt

Array = npt.NDArray[np.float64]

CUTOFF_HZ = 100.0
THINNED_HZ = 40.0
SLOW_M_S = 1e-3
"Slower than this the sign of the speed is noise, and friction may be static."
LONGEST_DELAY_S = 0.02
LEAST_ROWS = 100


class LogError(ValueError):
    """A log that cannot be used: file, line, what is wrong and what is allowed."""


class Log(NamedTuple):
    """A motor log: evenly spaced times, s; voltage, V; position, m; and the gain where the file states one, N/V."""

    t_s: Array
    input_V: Array
    position_m: Array
    gain_N_V: float | None


class Fit(NamedTuple):
    """Least squares in volts: coefficients of a, v, sign(v), 1, their 95% half widths, the residual's share."""

    coefficients: Array
    ci95: Array
    relative_residual: float


def main() -> int:
    """Prints the parameters; 2 where the log cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path, help="motor log CSV, or DATA_EMPS.mat")
    parser.add_argument("--gain-N-V", type=float, dest="gain", help="force for each volt, N/V")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="measured against simulated voltage")
    options = parser.parse_args()
    try:
        log = read_log(options.log)
        result = identify(log, options.gain if options.gain is not None else log.gain_N_V)
    except LogError as error:
        print(f"identify_motor: {error}", file=sys.stderr)
        return 2
    if options.plot:
        draw(options.plot, log, result)
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0


def read_log(path: Path) -> Log:
    """The log in a CSV or EMPS .mat file. Raises LogError."""
    log = _read_mat(path) if path.suffix == ".mat" else _read_csv(path)
    if len(log.t_s) < LEAST_ROWS:
        raise LogError(f"{path}: {len(log.t_s)} rows: allowed are at least {LEAST_ROWS}")
    for name, values in zip(("t_s", "input_V", "position"), log[:3], strict=True):
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise LogError(f"{path}, row {row}: {name} = {values[row]}: allowed is a finite number")
    steps = np.diff(log.t_s)
    period = float(np.median(steps))
    if period <= 0.0 or np.abs(steps - period).max() > 0.5 * period:
        row = int(np.argmax(np.abs(steps - period)))
        raise LogError(
            f"{path}, row {row + 1}: t_s steps by {steps[row]:g} s: allowed is about {period:g} s throughout"
        )
    if 1.0 / period < 4.0 * CUTOFF_HZ:
        raise LogError(f"{path}: sampled at {1.0 / period:.0f} Hz: allowed is at least {4.0 * CUTOFF_HZ:.0f} Hz")
    return log


def _read_mat(path: Path) -> Log:
    try:
        data = loadmat(path)
        columns = [np.asarray(data[name], dtype=np.float64).ravel() for name in ("t", "vir", "qm")]
        gain = float(np.asarray(data["gtau"]).item())
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}") from error
    except (MatReadError, KeyError, ValueError, TypeError) as error:
        raise LogError(f"{path}: not an EMPS file with t, vir, qm and gtau: {error}") from error
    if len({len(column) for column in columns}) != 1:
        raise LogError(f"{path}: t, vir and qm have {[len(column) for column in columns]} rows: allowed is one length")
    return Log(*columns, gain)


def _read_csv(path: Path) -> Log:
    names = ("t_s", "input_V", "position_mm")
    rows: list[tuple[float, ...]] = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            missing = set(names) - set(reader.fieldnames or ())
            if missing:
                raise LogError(f"{path}: no column {', '.join(sorted(missing))}: needed are {', '.join(names)}")
            for row in reader:
                try:
                    rows.append(tuple(float(row[name]) for name in names))
                except (TypeError, ValueError) as error:
                    raise LogError(f"{path}, line {reader.line_num}: {error}") from error
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{path}: {error}") from error
    table = np.array(rows).reshape(-1, 3)
    return Log(table[:, 0], table[:, 1], table[:, 2] * 1e-3, None)


def identify(log: Log, gain_N_V: float | None) -> dict[str, Any]:
    """The contract's object. Raises LogError where the log does not move enough to show anything."""
    if gain_N_V is not None and not (math.isfinite(gain_N_V) and gain_N_V > 0.0):
        raise LogError(f"gain_N_V = {gain_N_V}: allowed is a finite number above 0")
    half = len(log.t_s) // 2
    delay, delay_ci = _delay(_part(log, slice(None, half)))
    fitted = fit(_part(log, slice(None, half)), delay)
    whole = fit(log, delay)
    judged = _part(log, slice(half, None))
    measured, predicted = voltages(judged, fitted, delay)
    scale = gain_N_V if gain_N_V is not None else math.nan
    names = ("mass_kg", "viscous_N_s_m", "coulomb_N", "offset_N")
    parameters: dict[str, Any] = {
        name: {"value": float(scale * value), "ci95": float(scale * width)} if gain_N_V is not None else None
        for name, value, width in zip(names, whole.coefficients, whole.ci95, strict=True)
    }
    parameters["delay_s"] = {"value": delay, "ci95": delay_ci}
    parameters["backlash_um"] = None
    ratios = ("mass_V_s2_m", "viscous_V_s_m", "coulomb_V", "offset_V")
    return {
        "parameters": parameters,
        "ratios_to_gain": {
            name: {"value": float(value), "ci95": float(width)}
            for name, value, width in zip(ratios, whole.coefficients, whole.ci95, strict=True)
        },
        "gain_N_V": gain_N_V,
        "relative_residual": whole.relative_residual,
        "holdout_voltage_nrmse": float(np.linalg.norm(measured - predicted) / np.linalg.norm(measured)),
        "notes": ["backlash: an encoder on the motor's side of the play cannot show it"],
    }


def _part(log: Log, rows: slice) -> Log:
    return Log(log.t_s[rows], log.input_V[rows], log.position_m[rows], log.gain_N_V)


def regressors(log: Log, delay_s: float) -> tuple[Array, Array]:
    """Rows of (a, v, sign(v), 1) and the delayed voltage, filtered alike and thinned."""
    period = float(np.median(np.diff(log.t_s)))
    sections = butter(4, CUTOFF_HZ, fs=1.0 / period, output="sos")
    position = sosfiltfilt(sections, log.position_m)
    speed = np.gradient(position, period)
    acceleration = np.gradient(speed, period)
    volts = np.interp(log.t_s - delay_s, log.t_s, log.input_V)
    columns = (acceleration, speed, np.sign(speed) * (np.abs(speed) > SLOW_M_S), np.ones_like(speed), volts)
    factor = max(1, round(1.0 / period / THINNED_HZ))
    # the ends carry the filters' guesses
    edge = 4
    thinned = [_thin(column, factor)[edge:-edge] for column in columns]
    rows = np.column_stack(thinned[:4])
    if len(rows) < LEAST_ROWS // 2 or np.linalg.matrix_rank(rows) < 4:
        raise LogError("the log moves too little: mass, friction and offset cannot be told apart")
    return rows, thinned[4]


def _thin(column: Array, factor: int) -> Array:
    return np.asarray(decimate(column, factor, ftype="fir", zero_phase=True)) if factor > 1 else column


def fit(log: Log, delay_s: float) -> Fit:
    """Least squares over a log at a known delay."""
    rows, volts = regressors(log, delay_s)
    coefficients, *_ = np.linalg.lstsq(rows, volts, rcond=None)
    residual = volts - rows @ coefficients
    variance = float(residual @ residual) / (len(volts) - 4)
    deviation = np.sqrt(variance * np.diag(np.linalg.inv(rows.T @ rows)))
    return Fit(coefficients, 1.96 * deviation, float(np.linalg.norm(residual) / np.linalg.norm(volts)))


def voltages(log: Log, fitted: Fit, delay_s: float) -> tuple[Array, Array]:
    """The voltage that was applied and the one that the fit says the motion took."""
    rows, volts = regressors(log, delay_s)
    return volts, rows @ fitted.coefficients


def _delay(log: Log) -> tuple[float, float]:
    """The delay that leaves the least residual, and its half width from the curvature of the sum of squares."""

    def squares(delay_s: float) -> float:
        rows, volts = regressors(log, delay_s)
        coefficients, *_ = np.linalg.lstsq(rows, volts, rcond=None)
        return float(np.sum((volts - rows @ coefficients) ** 2))

    best = minimize_scalar(squares, bounds=(0.0, LONGEST_DELAY_S), method="bounded", options={"xatol": 1e-5})
    count = len(regressors(log, float(best.x))[1])
    step = 5e-4
    curvature = (squares(best.x + step) - 2.0 * best.fun + squares(max(best.x - step, 0.0))) / step**2
    width = 1.96 * math.sqrt(2.0 * best.fun / (count - 5) / curvature) if curvature > 0.0 else LONGEST_DELAY_S
    return float(best.x), min(width, LONGEST_DELAY_S)


def print_table(result: dict[str, Any]) -> None:
    """The parameters for a person."""
    for name, found in (result["parameters"] | result["ratios_to_gain"]).items():
        print(
            f"{name:16s}"
            + ("not shown by this log" if found is None else f"{found['value']:12.5g} +- {found['ci95']:.2g}")
        )
    print(f"residual {result['relative_residual']:.1%} of the voltage; held out {result['holdout_voltage_nrmse']:.1%}")


def draw(path: Path, log: Log, result: dict[str, Any]) -> None:
    """Measured against simulated voltage on the half that was not fitted."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    half = len(log.t_s) // 2
    delay = result["parameters"]["delay_s"]["value"]
    fitted = fit(_part(log, slice(None, half)), delay)
    measured, predicted = voltages(_part(log, slice(half, None)), fitted, delay)
    time_s = log.t_s[half] + np.arange(len(measured)) / THINNED_HZ
    figure, (above, below) = plt.subplots(2, 1, figsize=(11, 6), sharex=True, constrained_layout=True)
    above.plot(time_s, measured, color="#222222", label="measured")
    above.plot(time_s, predicted, color="#d1495b", linewidth=1.0, label="from the fit of the other half")
    above.legend(frameon=False, ncols=2)
    above.set_ylabel("input, V")
    above.set_title(f"Held-out half: relative error {result['holdout_voltage_nrmse']:.1%}", loc="left")
    below.plot(time_s, measured - predicted, color="#2a6f97", linewidth=0.8)
    below.set_ylabel("difference, V")
    below.set_xlabel("time, s")
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
