"""Whether a device's gap speed alone lets it follow a force: ideal carriages, which only their top speed bounds."""

import math
from typing import NamedTuple

from tormagd.control.aim.portrait import Portrait


class Missed(NamedTuple):
    """What ideal carriages miss of a signal."""

    rms_N: float
    share: float
    "Of the time in which the signal is faster than the gap."


def missed(shown: Portrait, times_s: list[float], forces_N: list[float], gap_speed_mm_s: float) -> Missed:
    """Return what ideal carriages without preview miss of forces at rising times."""
    at_N, squares, faster = forces_N[0], 0.0, 0
    for index in range(1, len(forces_N)):
        step_s, force_N = times_s[index] - times_s[index - 1], forces_N[index]
        most_N = shown.force_rate_N_s(at_N, gap_speed_mm_s) * step_s
        at_N += min(max(force_N - at_N, -most_N), most_N)
        squares += (force_N - at_N) ** 2
        faster += abs(force_N - forces_N[index - 1]) / step_s > shown.force_rate_N_s(force_N, gap_speed_mm_s)
    count = len(forces_N) - 1
    return Missed(math.sqrt(squares / count), faster / count)
