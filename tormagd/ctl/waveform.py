"""What `tormagctl send` sends: a force over time, computed or from a CSV file. All computed shapes are synthetic."""

import math
from array import array
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from tormagd.ground.files import did_you_mean
from tormagd.ground.force_file import OPTIONAL_COLUMNS, read_forces
from tormagd_client.messages import MAX_FORCE_N
from tormagd_client.printable import in_short


class WaveformError(ValueError):
    """A shape that cannot be sent."""


class Sample(NamedTuple):
    """What is asked at one moment; displacement and rate may be unknown."""

    force_N: float
    displacement_mm: float | None = None
    rate_mm_s: float | None = None


class Waveform(NamedTuple):
    """A force over time: `at(t_s)` for 0..`duration_s`, which may be infinite."""

    duration_s: float
    at: Callable[[float], Sample]
    least_N: float
    most_N: float
    told: tuple[str, ...] = ()
    "What was converted to read a file."


def by_legs(start_N: float, legs: Sequence[tuple[float, float]]) -> Waveform:
    """Return straight lines from `start_N` on; each leg is its duration, s, and the force at its end, N."""
    times_s = [0.0, *accumulate(lasts_s for lasts_s, _ in legs)]
    return _lines(times_s, [start_N, *(force_N for _, force_N in legs)])


def _lines(times_s: Sequence[float], forces_N: Sequence[float], *others: Sequence[float] | None) -> Waveform:
    def at(t_s: float) -> Sample:
        right = min(max(bisect_right(times_s, t_s), 1), len(times_s) - 1)
        share = (t_s - times_s[right - 1]) / (times_s[right] - times_s[right - 1])
        share = min(max(share, 0.0), 1.0)

        def there(column: Sequence[float]) -> float:
            return column[right - 1] + (column[right] - column[right - 1]) * share

        return Sample(there(forces_N), *(None if column is None else there(column) for column in others))

    return Waveform(times_s[-1], at, min(forces_N), max(forces_N))


SHAPES = ("step", "sine", "ramp", "pulse")


def shape(name: str, from_N: float, to_N: float, frequency_hz: float, duration_s: float) -> Waveform:
    for label, value in (("from-N", from_N), ("to-N", to_N)):
        if not 0.0 <= value <= MAX_FORCE_N:
            raise WaveformError(f"--{label} = {value:g}: allowed is 0..{MAX_FORCE_N:g} N")
    if name not in SHAPES:
        near = did_you_mean(name, SHAPES)
        raise WaveformError(f"{in_short(name)}: allowed are {', '.join(SHAPES)} or a file ending in .csv{near}")
    if name in ("step", "ramp") and not math.isfinite(duration_s):
        raise WaveformError(f"--duration = {duration_s:g}: allowed for a {name} is a finite time")

    def at(t_s: float) -> Sample:
        match name:
            case "step":
                share = float(t_s >= duration_s / 2)
            case "ramp":
                share = min(1.0, t_s / duration_s)
            case "sine":
                share = 0.5 - 0.5 * math.cos(math.tau * frequency_hz * t_s)
            case _:
                share = beat(t_s * frequency_hz % 1.0)
        return Sample(from_N + (to_N - from_N) * share)

    return Waveform(duration_s, at, min(from_N, to_N), max(from_N, to_N))


def beat(phase: float) -> float:
    """Return one synthetic heart beat, 0..1, at `phase` 0..1: a systolic bell and a reflected wave."""
    bells = math.exp(-(((phase - 0.25) / 0.09) ** 2)) + 0.35 * math.exp(-(((phase - 0.55) / 0.12) ** 2))
    # the second bell adds 0.06 % to the peak of the first
    return min(1.0, bells)


def read_csv(path: Path, stated: Mapping[str, str] | None = None) -> Waveform:
    table = read_forces(path, stated or {})
    values = table.values
    start_s = values["time_s"][0]
    times_s = array("d", (time_s - start_s for time_s in values["time_s"]))
    others = (values.get(name) for name in OPTIONAL_COLUMNS)
    return _lines(times_s, values["force_N"], *others)._replace(told=tuple(table.told))
