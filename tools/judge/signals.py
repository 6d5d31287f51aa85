"""Recorded signals as force profiles within the device's range, from the folder that TORMAG_DATA names.

Shape and rhythm are measured, the newtons are chosen.
"""

import os
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from judge.following import PULSE_N, RATE_HZ
from tormag_lab.arrays import Array
from tormag_lab.human_pulse import scaled

PULSE_S = 16.0
"A recorded pulse is repeated up to this; the loops of `aac_nibp_pulse` end where they begin."
LOW_PASS_HZ = 20.0
HAPTIC_S = 40.0
"Of the 98 s recorded."
HAPTIC_N = (0.62, 2.0)

Signal = tuple[Array, Array]
"Times, s, and forces, N."


def recorded_signals() -> dict[str, Signal]:
    return {
        **{f"finger pressure {path.stem}": _pulse(path) for path in _recorded("aac_nibp_pulse/*.csv")},
        **{f"arterial pressure {path.stem}": _pulse(path) for path in _recorded("wfdb_mimicdb/*_ABP.csv")},
        **{f"haptic scaled {path.stem}": _haptic(path) for path in _recorded("kit_cataract_haptic/*.csv")},
    }


def _recorded(pattern: str) -> list[Path]:
    data = os.environ.get("TORMAG_DATA")
    return sorted(Path(data).glob(pattern)) if data else []


def _pulse(path: Path) -> Signal:
    raw = np.loadtxt(path, delimiter=",", skiprows=1)
    period_s = float(np.median(np.diff(raw[:, 0])))
    # there and back if the ends do not meet: a jump is none of the pulse's own
    values = raw[:, 1]
    if abs(values[-1] - values[0]) > 0.02 * np.ptp(values):
        values = np.concatenate([values, values[-2:0:-1]])
    values = np.tile(values, int(np.ceil(PULSE_S / period_s / len(values))) + 1)
    smooth = sosfiltfilt(butter(4, LOW_PASS_HZ, fs=1.0 / period_s, output="sos"), values)
    time_s = np.arange(round(PULSE_S * RATE_HZ)) / RATE_HZ
    part = np.interp(time_s, np.arange(len(smooth)) * period_s, smooth)
    return time_s, scaled(part, *PULSE_N)


def _haptic(path: Path) -> Signal:
    """Return the commands of the first HAPTIC_S, joined by straight lines, as a player of the file sends them."""
    raw = np.loadtxt(path, delimiter=",", skiprows=1)
    sent_s, first = np.unique(raw[:, 0], return_index=True)
    sent_s, sent_N = sent_s[sent_s <= HAPTIC_S], np.linalg.norm(raw[first, 1:4], axis=1)[sent_s <= HAPTIC_S]
    time_s = np.arange(0.0, sent_s[-1], 1.0 / RATE_HZ)
    return time_s, np.interp(time_s, sent_s, scaled(sent_N, *HAPTIC_N))
