"""Whether a device's gap speed alone lets it follow a force: ideal carriages, which only their top speed bounds."""

import math
from typing import NamedTuple

from tormagd.control.aim.portrait import Portrait

SHOWN = 3


class Point(NamedTuple):
    """The rate that a signal asks at a force, and the greatest that the device gives there."""

    force_N: float
    asked_N_s: float
    given_N_s: float


class Missed(NamedTuple):
    """What ideal carriages miss of a signal."""

    rms_N: float
    share: float
    worst: tuple[Point, ...]


def missed(shown: Portrait, times_s: list[float], forces_N: list[float], gap_speed_mm_s: float) -> Missed:
    """Return what ideal carriages without preview miss of forces at rising times."""
    tenth_N = max(max(forces_N) - min(forces_N), 1e-9) / 10.0
    outside: list[Point] = []
    at_N, squares = forces_N[0], 0.0
    for index in range(1, len(forces_N)):
        step_s, force_N = times_s[index] - times_s[index - 1], forces_N[index]
        most_N = shown.force_rate_N_s(at_N, gap_speed_mm_s) * step_s
        at_N += min(max(force_N - at_N, -most_N), most_N)
        squares += (force_N - at_N) ** 2
        asked_N_s = abs(force_N - forces_N[index - 1]) / step_s
        given_N_s = shown.force_rate_N_s(force_N, gap_speed_mm_s)
        if asked_N_s > given_N_s:
            outside.append(Point(force_N, asked_N_s, given_N_s))
    furthest: dict[int, Point] = {}
    for point in sorted(outside, key=lambda point: point.given_N_s / point.asked_N_s):
        furthest.setdefault(int(point.force_N / tenth_N), point)
    count = len(forces_N) - 1
    return Missed(math.sqrt(squares / count), len(outside) / count, tuple(furthest.values())[:SHOWN])
