"""Recorded signals as force profiles within the device's range, from the folder that TORMAG_DATA names.

Shape and rhythm are measured, the newtons are chosen.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from tormag_lab.arrays import Array
from tormag_lab.human_pulse import pulse_profile, recorded, scaled

PULSE_N = (1.4, 1.7)
RATE_HZ = 500
PULSE_S = 16.0
"A recorded pulse is repeated up to this; the loops of `aac_nibp_pulse` end where they begin."
LOW_PASS_HZ = 20.0
HAPTIC_S = 40.0
"Of the 98 s recorded."
SCALED_N = (0.62, 2.0)
RISE_S = 0.1
LASTS_S = (0.1, 0.6)
"Of a touch of the palpation, and between two."
TOUCHES_N = (0.9, 2.0)
TOUCHED_S = 16.0
TRIM_S = 10.0
"The trim learns for this time before the figures of other devices than sample 1 begin."


class Signal(NamedTuple):
    """A force profile. `is_known_ahead`: it comes from a file, so that a publisher can send a preview."""

    name: str
    time_s: Array
    force_N: Array
    is_known_ahead: bool = True


def with_approach(times_s: Array, forces_N: Array, start_N: float, ramp_s: float, hold_s: float) -> tuple[Array, Array]:
    period_s = float(times_s[1] - times_s[0])
    ramp = np.linspace(start_N, forces_N[0], round(ramp_s / period_s), endpoint=False)
    forces = np.concatenate([ramp, np.full(round(hold_s / period_s), forces_N[0]), forces_N])
    return np.arange(len(forces), dtype=np.float64) * period_s, forces


def pulse_signal(duration_s: float) -> Signal:
    return Signal("pulse", *pulse_profile(duration_s, *PULSE_N, RATE_HZ))


def recorded_signals() -> list[Signal]:
    return [
        *(_pulse(path, "finger pressure") for path in recorded("aac_nibp_pulse")),
        *(_pulse(path, "arterial pressure") for path in recorded("wfdb_mimicdb") if path.stem.endswith("_ABP")),
        *(_haptic(path) for path in recorded("kit_cataract_haptic")),
    ]


def palpation(seed: int) -> Signal:
    """Return a palpating hand: touches of random force, each within RISE_S, at random times (synthetic)."""
    random = np.random.default_rng(seed)
    time_s = np.arange(round(TOUCHED_S * RATE_HZ)) / RATE_HZ
    force_N = np.full(len(time_s), SCALED_N[0])
    begins_s = random.uniform(*LASTS_S)
    while begins_s < TOUCHED_S:
        ends_s = begins_s + RISE_S + random.uniform(*LASTS_S)
        more_N = random.uniform(*TOUCHES_N) - SCALED_N[0]
        force_N += more_N * (_rising(time_s - begins_s) - _rising(time_s - ends_s))
        begins_s = ends_s + RISE_S + random.uniform(*LASTS_S)
    return Signal(f"palpation {seed}", time_s, force_N)


def _rising(since_s: Array) -> Array:
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(since_s / RISE_S, 0.0, 1.0))


def _pulse(path: Path, what: str) -> Signal:
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
    return Signal(f"{what} {path.stem}", time_s, scaled(part, *PULSE_N))


def _haptic(path: Path) -> Signal:
    """Return the commands of the first HAPTIC_S, joined by straight lines, as a player of the file sends them."""
    raw = np.loadtxt(path, delimiter=",", skiprows=1)
    sent_s, first = np.unique(raw[:, 0], return_index=True)
    sent_s, sent_N = sent_s[sent_s <= HAPTIC_S], np.linalg.norm(raw[first, 1:4], axis=1)[sent_s <= HAPTIC_S]
    time_s = np.arange(0.0, sent_s[-1], 1.0 / RATE_HZ)
    return Signal(f"haptic scaled {path.stem}", time_s, np.interp(time_s, sent_s, scaled(sent_N, *SCALED_N)))
