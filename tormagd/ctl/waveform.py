"""What `tormagctl send` sends: a force over time, computed or from a CSV file. All computed shapes are synthetic."""

import csv
import io
import math
from array import array
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tormagd.bounded_file import read_bounded
from tormagd.messages import MAX_DISPLACEMENT_MM, MAX_FORCE_N, MAX_RATE_MM_S

REQUIRED_COLUMNS = ("t_s", "force_N")
OPTIONAL_COLUMNS = ("displacement_mm", "rate_mm_s")
ALLOWED = {
    "t_s": (-1e10, 1e10, "s"),  # seconds since 1970 are fine
    "force_N": (0.0, MAX_FORCE_N, "N"),
    "displacement_mm": (0.0, MAX_DISPLACEMENT_MM, "mm"),
    "rate_mm_s": (-MAX_RATE_MM_S, MAX_RATE_MM_S, "mm/s"),
}
"Least, most and unit of each column; of what a setpoint carries, as in the messages."
MAX_FILE_BYTES = 16_000_000
"More than a quarter of an hour at 1 kHz."


class WaveformError(ValueError):
    """A shape or a file that cannot be sent: names the file, row, column, value and what is allowed."""


class Sample(NamedTuple):
    """What is asked at one moment."""

    force_N: float
    displacement_mm: float | None = None
    rate_mm_s: float | None = None


class Waveform(NamedTuple):
    """`at(t_s)` for t_s in 0..duration_s, of forces from `least_N` to `most_N`. A shape that can go on for ever has
    duration_s = inf."""

    duration_s: float
    at: Callable[[float], Sample]
    least_N: float
    most_N: float


SHAPES = ("step", "sine", "ramp", "pulse")


def shape(name: str, from_N: float, to_N: float, frequency_hz: float, duration_s: float) -> Waveform:
    """One of SHAPES between two forces. Raises WaveformError.

    step: to_N from half of the time on. ramp: a straight line. sine: begins at from_N, swings to to_N and back.
    pulse: a synthetic arterial pulse, one beat per 1/frequency_hz.
    """
    for label, value in (("from-N", from_N), ("to-N", to_N)):
        if not 0.0 <= value <= MAX_FORCE_N:
            raise WaveformError(f"--{label} = {value:g}: allowed is 0..{MAX_FORCE_N:g} N")
    if name not in SHAPES:
        raise WaveformError(f"{name!r}: allowed are {', '.join(SHAPES)} or a file ending in .csv")
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
    """One synthetic heart beat, 0..1, over `phase` 0..1: a systolic bell, and a lower one for the reflected wave."""
    bells = math.exp(-(((phase - 0.25) / 0.09) ** 2)) + 0.35 * math.exp(-(((phase - 0.55) / 0.12) ** 2))
    # the second bell adds 0.06 % to the first one's top
    return min(1.0, bells)


def read_csv(path: Path) -> Waveform:
    """The waveform of a setpoint CSV: `t_s,force_N` and optional columns, any spacing, straight lines between the rows.

    Time is counted from the first row. Raises WaveformError.
    """
    table = _read_table(path)
    start_s = table["t_s"][0]
    times_s = array("d", (time_s - start_s for time_s in table["t_s"]))
    # in the order of Sample's fields; None for a column that the file does not have
    columns = [table.get(name) for name in ("force_N", *OPTIONAL_COLUMNS)]

    def at(t_s: float) -> Sample:
        right = min(max(bisect_right(times_s, t_s), 1), len(times_s) - 1)
        share = (t_s - times_s[right - 1]) / (times_s[right] - times_s[right - 1])
        share = min(1.0, max(0.0, share))
        values = [None if c is None else c[right - 1] + (c[right] - c[right - 1]) * share for c in columns]
        assert values[0] is not None  # force_N is a required column
        return Sample(values[0], values[1], values[2])

    return Waveform(times_s[-1], at, min(table["force_N"]), max(table["force_N"]))


def _read_table(path: Path) -> dict[str, "array[float]"]:
    """The columns by name: arrays, for a million rows of lists would not fit in the memory that a command may take."""
    try:
        data = io.BytesIO(read_bounded(path, MAX_FILE_BYTES))
        with io.TextIOWrapper(data, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            columns = _check_header(path, [name.strip() for name in next(reader, [])])
            table = {name: array("d") for name in columns}
            for cells in reader:
                if cells:
                    row = _check_row(path, reader.line_num, columns, cells, table["t_s"][-1:])
                    for name, value in zip(columns, row, strict=True):
                        table[name].append(value)
    except OSError as error:
        raise WaveformError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise WaveformError(f"{path}: not UTF-8 text (byte {error.start})") from error
    except csv.Error as error:
        raise WaveformError(f"{path}: not CSV: {error}") from error
    if len(table["t_s"]) < 2:
        raise WaveformError(f"{path}: {len(table['t_s'])} rows: allowed is at least 2")
    return table


def _check_header(path: Path, columns: list[str]) -> list[str]:
    allowed = f"allowed is {','.join(REQUIRED_COLUMNS)} and optionally {','.join(OPTIONAL_COLUMNS)}"
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    if missing:
        raise WaveformError(f"{path}: row 1 has no column {missing[0]} (it is {','.join(columns)[:80]!r}): {allowed}")
    for index, name in enumerate(columns):
        if name not in REQUIRED_COLUMNS + OPTIONAL_COLUMNS:
            raise WaveformError(f"{path}: row 1: column {name[:40]!r} is not known: {allowed}")
        if name in columns[:index]:
            raise WaveformError(f"{path}: row 1: column {name} is there twice")
    return columns


def _check_row(path: Path, line: int, columns: list[str], cells: list[str], before_s: "array[float]") -> list[float]:
    if len(cells) != len(columns):
        raise WaveformError(f"{path}: row {line} has {len(cells)} values: allowed is {len(columns)}")
    row = [_number(path, line, name, text) for name, text in zip(columns, cells, strict=True)]
    time = columns.index("t_s")
    if before_s and not row[time] > before_s[0]:
        raise WaveformError(
            f"{path}: row {line}, t_s = {cells[time]}: allowed is above the row before, {before_s[0]:g}"
        )
    return row


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text) if "_" not in text else math.nan  # Python reads 1_5 as 15; a table means something else
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise WaveformError(f"{path}: row {line}, {name} = {text[:40]!r}: allowed is a finite number")
    least, most, unit = ALLOWED[name]
    if not least <= value <= most:
        raise WaveformError(f"{path}: row {line}, {name} = {text[:40]}: allowed is {least:g}..{most:g} {unit}")
    return value
