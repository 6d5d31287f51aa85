"""The force that a scene asks for over time, as numbers."""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from tormagd.ground.force_file import read_forces
from tormagd.ground.table import TableError
from tormagd.scenes.scene import Signal
from tormagd_client.endpoints import ConfigError

Array = npt.NDArray[np.float64]


def recorded(path: Path) -> tuple[Array, Array]:
    """Read a file of forces, and return times from the first row on, s, and forces, N. Raises ConfigError."""
    try:
        table = read_forces(path).values
    except TableError as error:
        raise ConfigError(f"signal.file = {error}") from error
    time_s = np.array(table["time_s"])
    return time_s - time_s[0], np.array(table["force_N"])


def asked(
    signal: Signal, beside: Path, range_N: tuple[float, float], longest_s: float, rate_hz: int
) -> tuple[Array, Array]:
    """Return times from 0 on, s, and forces, N (n each), that `signal` asks for."""
    low_N, high_N = range_N
    if signal.file:
        known_s, known_N = recorded(beside / signal.file)
        time_s = np.arange(max(round(min(longest_s, known_s[-1]) * rate_hz), 2)) / rate_hz
        return time_s, np.clip(_through(time_s, known_s, known_N), low_N, high_N)
    assert signal.bandwidth_hz is not UNSET, "a signal without a file has a bandwidth"
    turn_s = 0.5 / signal.bandwidth_hz
    hold_s = 0.0 if signal.hold_s is UNSET else signal.hold_s
    steps = 1 if signal.step_N is UNSET else max(math.ceil((high_N - low_N) / signal.step_N - 1e-9), 1)
    levels_N = np.linspace(low_N, high_N, steps + 1)
    levels_N = np.concatenate([levels_N, levels_N[-2::-1]])
    each_s = turn_s + hold_s
    time_s = np.arange(max(round(min(longest_s, each_s * 2 * steps) * rate_hz), 2)) / rate_hz
    place = np.minimum(time_s // each_s, 2 * steps - 1).astype(np.int64)
    share = np.minimum((time_s - place * each_s) / turn_s, 1.0)
    rise = 0.5 - 0.5 * np.cos(math.pi * share)
    return time_s, levels_N[place] + rise * (levels_N[place + 1] - levels_N[place])


def _through(time_s: Array, known_s: Array, known_N: Array) -> Array:
    """Return the forces at `time_s` on cubic Hermite curves through the known rows."""
    slope = np.gradient(known_N, known_s)
    after = np.clip(np.searchsorted(known_s, time_s, side="right"), 1, len(known_s) - 1)
    start = after - 1
    width_s = known_s[after] - known_s[start]
    share = (time_s - known_s[start]) / width_s
    rest = 1.0 - share
    return (
        known_N[start] * (1.0 + 2.0 * share) * rest**2
        + width_s * slope[start] * share * rest**2
        + known_N[after] * (1.0 + 2.0 * rest) * share**2
        - width_s * slope[after] * rest * share**2
    )
