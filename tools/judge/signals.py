"""The measured pulse as a force profile within the device's range, and the way up to it."""

from typing import NamedTuple

import numpy as np

from tormag_lab.arrays import Array
from tormag_lab.human_pulse import pulse_profile

PULSE_N = (1.4, 1.7)
RATE_HZ = 500
TRIM_S = 10.0
"The trim learns for this time before the figures of other devices than sample 1 begin."


class Signal(NamedTuple):
    name: str
    time_s: Array
    force_N: Array


def with_approach(times_s: Array, forces_N: Array, start_N: float, ramp_s: float, hold_s: float) -> tuple[Array, Array]:
    period_s = float(times_s[1] - times_s[0])
    ramp = np.linspace(start_N, forces_N[0], round(ramp_s / period_s), endpoint=False)
    hold = np.full(round(hold_s / period_s), forces_N[0])
    forces = np.concatenate([ramp, hold, forces_N])
    return np.arange(len(forces), dtype=np.float64) * period_s, forces


def pulse_signal(duration_s: float) -> Signal:
    return Signal("pulse", *pulse_profile(duration_s, *PULSE_N, RATE_HZ))
