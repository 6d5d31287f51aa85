"""A recorded task as points of the phase plane: a file of forces in, forces and force rates out."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import butter, sosfiltfilt

from tormagd.force_file import read_forces
from tormagd.physics.errors import DomainError, require

Array = npt.NDArray[np.float64]

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
    """The task in a file of forces; see `task_of`. Raises `ForceFileError` and `DomainError`."""
    table = read_forces(path)
    return task_of(np.array(table["t_s"]), np.array(table["force_N"]), cutoff_Hz)


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
