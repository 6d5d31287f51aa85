"""Reads motor logs: the CSV of `tormagctl calibrate --motors`, or the EMPS benchmark's .mat file."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from tormag_lab.arrays import MAX_TABLE_BYTES, Array, read_columns
from tormag_lab.errors import LabError
from tormagd_client.regular_file import require_regular

COLUMNS = ("t_s", "input_V", "position_mm")
CURRENT_COLUMN = "current_A"
MIN_ROWS = 100
MIN_RATE_HZ = 400.0


class Log(NamedTuple):
    """A motor log in even time steps; `gain_N_V` and `current_A` are None where the file has none."""

    t_s: Array
    input_V: Array
    position_m: Array
    gain_N_V: float | None = None
    current_A: Array | None = None

    @property
    def period_s(self) -> float:
        return float(np.median(np.diff(self.t_s)))

    def part(self, rows: slice) -> "Log":
        current = None if self.current_A is None else self.current_A[rows]
        return Log(self.t_s[rows], self.input_V[rows], self.position_m[rows], self.gain_N_V, current)


def read_log(path: Path) -> Log:
    log = _read_mat(path) if path.suffix == ".mat" else _read_csv(path)
    if len(log.t_s) < MIN_ROWS:
        raise LabError(f"{path}: {len(log.t_s)} rows: allowed are at least {MIN_ROWS}")
    for name, values in zip((*COLUMNS, "gain", CURRENT_COLUMN), log, strict=True):
        if isinstance(values, np.ndarray) and not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise LabError(f"{path}, row {row}: {name} = {values[row]}: allowed is a finite number")
    steps, period = np.diff(log.t_s), log.period_s
    if period <= 0.0 or np.abs(steps - period).max() > 0.5 * period:
        row = int(np.argmax(np.abs(steps - period)))
        raise LabError(
            f"{path}, row {row + 1}: t_s steps by {steps[row]:g} s: allowed is about {period:g} s throughout"
        )
    if 1.0 / period < MIN_RATE_HZ:
        raise LabError(f"{path}: sampled at {1.0 / period:.0f} Hz: allowed is at least {MIN_RATE_HZ:.0f} Hz")
    return log


def _read_mat(path: Path) -> Log:
    """Read an EMPS .mat file: t, s, vir, V, qm, m, and the gain gtau, N/V."""
    try:
        require_regular(path, MAX_TABLE_BYTES)
        data = loadmat(path)
        t_s, input_V, position_m = (np.asarray(data[name], dtype=np.float64).ravel() for name in ("t", "vir", "qm"))
        gain = float(np.asarray(data["gtau"]).item())
    except OSError as error:
        raise LabError(f"{path}: {error.strerror or error}") from error
    except (MatReadError, KeyError, ValueError, TypeError) as error:
        raise LabError(f"{path}: not an EMPS file with t, vir, qm and gtau: {error}") from error
    rows = [len(t_s), len(input_V), len(position_m)]
    if len(set(rows)) != 1:
        raise LabError(f"{path}: t, vir and qm have {rows} rows: allowed is one length")
    return Log(t_s, input_V, position_m, gain)


def _read_csv(path: Path) -> Log:
    named = read_columns(path, COLUMNS, (CURRENT_COLUMN,))
    t_s, input_V, position_mm = (named[name] for name in COLUMNS)
    return Log(t_s, input_V, position_mm * 1e-3, None, named.get(CURRENT_COLUMN))
