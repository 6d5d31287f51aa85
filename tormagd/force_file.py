"""A force over time in a CSV file: what is sent, what a scene asks for, what a design is judged by."""

import csv
import io
import math
from array import array
from pathlib import Path

from tormagd.bounded_file import read_bounded
from tormagd_client.messages import MAX_DISPLACEMENT_MM, MAX_FORCE_N, MAX_RATE_MM_S

REQUIRED_COLUMNS = ("t_s", "force_N")
OPTIONAL_COLUMNS = ("displacement_mm", "rate_mm_s")
ALLOWED = {
    "t_s": (-1e10, 1e10, "s"),  # seconds since 1970 are fine
    "force_N": (0.0, MAX_FORCE_N, "N"),
    "displacement_mm": (0.0, MAX_DISPLACEMENT_MM, "mm"),
    "rate_mm_s": (-MAX_RATE_MM_S, MAX_RATE_MM_S, "mm/s"),
}
"Least, most and unit of each column; of what a setpoint carries, as in the messages."
LEAST_ROWS = 2
MAX_FILE_BYTES = 16_000_000
"More than a quarter of an hour at 1 kHz."


class ForceFileError(ValueError):
    """A file that is no force over time: names the file, row, column, value and what is allowed."""


def read_forces(path: Path) -> dict[str, "array[float]"]:
    """The columns by name: `t_s`, which rises from row to row, `force_N`, and of the optional ones those that the file
    has, equally long. Raises ForceFileError.

    Arrays, for a million rows of lists would not fit in the memory that a command may take.
    """
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
        raise ForceFileError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ForceFileError(f"{path}: not UTF-8 text (byte {error.start})") from error
    except csv.Error as error:
        raise ForceFileError(f"{path}: not CSV: {error}") from error
    if len(table["t_s"]) < LEAST_ROWS:
        raise ForceFileError(f"{path}: {len(table['t_s'])} rows: allowed is at least {LEAST_ROWS}")
    return table


def _check_header(path: Path, columns: list[str]) -> list[str]:
    allowed = f"allowed is {','.join(REQUIRED_COLUMNS)} and optionally {','.join(OPTIONAL_COLUMNS)}"
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    if missing:
        raise ForceFileError(f"{path}: row 1 has no column {missing[0]} (it is {','.join(columns)[:80]!r}): {allowed}")
    for index, name in enumerate(columns):
        if name not in REQUIRED_COLUMNS + OPTIONAL_COLUMNS:
            raise ForceFileError(f"{path}: row 1: column {name[:40]!r} is not known: {allowed}")
        if name in columns[:index]:
            raise ForceFileError(f"{path}: row 1: column {name} is there twice")
    return columns


def _check_row(path: Path, line: int, columns: list[str], cells: list[str], before_s: "array[float]") -> list[float]:
    if len(cells) != len(columns):
        raise ForceFileError(f"{path}: row {line} has {len(cells)} values: allowed is {len(columns)}")
    row = [_number(path, line, name, text) for name, text in zip(columns, cells, strict=True)]
    time = columns.index("t_s")
    if before_s and not row[time] > before_s[0]:
        raise ForceFileError(
            f"{path}: row {line}, t_s = {cells[time]}: allowed is above the row before, {before_s[0]:g}"
        )
    return row


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text) if "_" not in text else math.nan  # Python reads 1_5 as 15; a table means something else
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ForceFileError(f"{path}: row {line}, {name} = {text[:40]!r}: allowed is a finite number")
    least, most, unit = ALLOWED[name]
    if not least <= value <= most:
        raise ForceFileError(f"{path}: row {line}, {name} = {text[:40]}: allowed is {least:g}..{most:g} {unit}")
    return value
