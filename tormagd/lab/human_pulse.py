"""A measured human pulse as a force profile.

The pulse is a photoplethysmogram (blood volume under the skin seen by light, not a pressure or a force) that the PyPI
package heartpy ships as `data.csv`: 100 Hz, 25 s, one person. Shape and rhythm are measured; the newtons are chosen.
"""

import importlib.util
import os
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from tormagd.lab.arrays import Array

SOURCE_HZ = 100
LOW_PASS_HZ = 8.0
"What is above this in a pulse is noise of the sensor."
EDGE_S = 0.5


def measured_pulse() -> Array:
    """The recording, as shipped, 100 Hz. Raises ModuleNotFoundError where heartpy is not installed."""
    # found, not imported: heartpy's import fails beside a current setuptools
    package = importlib.util.find_spec("heartpy")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("heartpy is not installed: pip install 'tormagd[demo]'", name="heartpy")
    return np.loadtxt(Path(package.origin).parent / "data" / "data.csv", delimiter=",", ndmin=1)


def pulse_profile(duration_s: float, least_N: float, most_N: float, rate_hz: int) -> tuple[Array, Array]:
    """Times, s, and forces, N, of the pulse between two forces: low-passed without lag, scaled, resampled.

    Raises ValueError where the recording is shorter than `duration_s`.
    """
    raw = measured_pulse()
    smooth = sosfiltfilt(butter(4, LOW_PASS_HZ, fs=SOURCE_HZ, output="sos"), raw)
    # both ends of a filtered signal carry the filter's guesses
    count = round(duration_s * rate_hz)
    if duration_s > len(raw) / SOURCE_HZ - 2.0 * EDGE_S:
        raise ValueError(f"duration_s = {duration_s}: allowed is up to {len(raw) / SOURCE_HZ - 2.0 * EDGE_S:g}")
    times_s = np.arange(count) / rate_hz
    # band-limited far below its sampling: a spline adds no images at 100 Hz, which the carriages would follow
    part = CubicSpline(np.arange(len(raw)) / SOURCE_HZ, smooth)(EDGE_S + times_s)
    return times_s, scaled(part, least_N, most_N)


def scaled(values: Array, least: float, most: float) -> Array:
    """The values with their least and greatest brought to these."""
    found: Array = least + (values - values.min()) / np.ptp(values) * (most - least)
    return found


def recorded(folder: str) -> list[Path]:
    """The CSV files of a folder of measured data; none unless TORMAG_DATA names where that is."""
    data = os.environ.get("TORMAG_DATA")
    return sorted((Path(data) / folder).glob("*.csv")) if data else []
