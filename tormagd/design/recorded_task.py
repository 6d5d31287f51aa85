"""A recorded task as points of the phase plane: a setpoint CSV in, forces and force rates out."""

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import butter, sosfiltfilt

from tormagd.bounded_file import MOST_TABLE_BYTES, require_regular
from tormagd.physics.errors import DomainError, require

Array = npt.NDArray[np.float64]

COLUMNS = ("t_s", "force_N")
MIN_ROWS = 3
MAX_TIME_S = 1e9
MAX_FORCE_N = 1e6
_ORDER = 2


class RecordedTask(NamedTuple):
    """Time, force and rate of change of the force, one element each per point."""

    time_s: Array
    force_N: Array
    rate_N_s: Array


def read_task(path: Path, cutoff_Hz: float | None = None) -> RecordedTask:
    """The task in a CSV with the columns `t_s,force_N` (others are ignored), at any spacing in time; see `task_of`.

    Raises `DomainError` naming file, line and value for a file that is not that, and `OSError`.
    """
    times, forces = [], []
    require_regular(path, MOST_TABLE_BYTES)
    with path.open(newline="", encoding="utf-8") as file:
        try:
            rows = csv.DictReader(file, strict=True)
            missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                raise DomainError(str(path), rows.fieldnames, f"a header with {', '.join(COLUMNS)}")
            for row in rows:
                times.append(_number(row["t_s"], f"{path}:{rows.line_num} t_s"))
                forces.append(_number(row["force_N"], f"{path}:{rows.line_num} force_N"))
        except (csv.Error, UnicodeDecodeError) as error:
            raise DomainError(str(path), error, "a CSV file in UTF-8") from error
    return task_of(np.array(times), np.array(forces), cutoff_Hz)


def task_of(time_s: Array, force_N: Array, cutoff_Hz: float | None = None) -> RecordedTask:
    """The points of a force record of three rows or more, times rising.

    The rate is the second-order difference over the times as they are. A sensor's noise makes such a rate useless:
    with `cutoff_Hz` the record is brought to its median spacing and low-passed without lag (Butterworth, order 2, to
    and fro) before. Raises `DomainError` for times that do not rise, values that are not finite, or a cutoff that is
    not between 0 and half the sampling rate.
    """
    if time_s.ndim != 1 or time_s.shape != force_N.shape or len(time_s) < MIN_ROWS:
        raise DomainError("force_N", force_N.shape, f"one force for each of {MIN_ROWS} times or more, {time_s.shape}")
    require("t_s", time_s, -MAX_TIME_S, MAX_TIME_S)
    require("force_N", force_N, -MAX_FORCE_N, MAX_FORCE_N)
    steps = np.diff(time_s)
    if not np.all(steps > 0.0):
        index = int(np.argmin(steps > 0.0)) + 1
        raise DomainError("t_s", time_s[index], f"above the time before it, {time_s[index - 1]}")
    if cutoff_Hz is not None:
        time_s, force_N = _low_pass(time_s, force_N, cutoff_Hz, float(np.median(steps)))
    return RecordedTask(time_s, force_N, np.gradient(force_N, time_s))


def _low_pass(time_s: Array, force_N: Array, cutoff_Hz: float, spacing_s: float) -> tuple[Array, Array]:
    rate_Hz = 1.0 / spacing_s
    if not 0.0 < cutoff_Hz < 0.5 * rate_Hz:
        raise DomainError("cutoff_Hz", cutoff_Hz, f"above 0 and below half the sampling rate, {0.5 * rate_Hz:g} Hz")
    even_s = np.arange(time_s[0], time_s[-1] + 0.5 * spacing_s, spacing_s)
    even_N = np.interp(even_s, time_s, force_N)
    # the filter mirrors the record at its ends; a short record has less to mirror
    padding = min(len(even_N) - 1, 3 * (2 * _ORDER + 1))
    smooth: Array = sosfiltfilt(butter(_ORDER, cutoff_Hz, fs=rate_Hz, output="sos"), even_N, padlen=padding)
    return even_s, smooth


def _number(text: str | None, where: str) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise DomainError(where, repr(text), "a number") from None
