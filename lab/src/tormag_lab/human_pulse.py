"""A measured human pulse as a force profile.

The pulse is a photoplethysmogram: blood volume under the skin seen by light, not a pressure or a force. The PyPI
package heartpy ships it as `data.csv`: 100 Hz, 25 s, one person. Shape and rhythm are measured; the newtons are chosen.
"""

import importlib.util
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from tormag_lab.arrays import Array

SOURCE_HZ = 100
LOW_PASS_HZ = 8.0
"Higher frequencies in a pulse are the sensor's noise."
EDGE_S = 0.5


def measured_pulse() -> Array:
    """Return heartpy's recording (n, about 25 s) at SOURCE_HZ, in the light sensor's own unit."""
    # found, not imported: heartpy's import fails with a current setuptools
    package = importlib.util.find_spec("heartpy")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("heartpy is not installed: pip install 'tormagd[demo]'", name="heartpy")
    return np.loadtxt(Path(package.origin).parent / "data" / "data.csv", delimiter=",", ndmin=1)


def pulse_profile(duration_s: float, least_N: float, most_N: float, rate_hz: int) -> tuple[Array, Array]:
    """Return times, s, and forces, N (n each), of a pulse that spans `least_N`..`most_N`."""
    raw = measured_pulse()
    smooth = sosfiltfilt(butter(4, LOW_PASS_HZ, fs=SOURCE_HZ, output="sos"), raw)
    # both ends of a filtered signal carry the filter's guesses
    count = round(duration_s * rate_hz)
    if duration_s > len(raw) / SOURCE_HZ - 2.0 * EDGE_S:
        raise ValueError(f"duration_s = {duration_s}: allowed is up to {len(raw) / SOURCE_HZ - 2.0 * EDGE_S:g}")
    times_s = np.arange(count) / rate_hz
    # band-limited far below its sampling rate, so that a spline adds no images at 100 Hz
    part = CubicSpline(np.arange(len(raw)) / SOURCE_HZ, smooth)(EDGE_S + times_s)
    return times_s, scaled(part, least_N, most_N)


def scaled(values: Array, least: float, most: float) -> Array:
    """Return `values` (n) mapped linearly to `least`..`most`; a smaller `most` mirrors them."""
    found: Array = least + (values - values.min()) / np.ptp(values) * (most - least)
    return found
