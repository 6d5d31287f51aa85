"""Quantities over time in a CSV file: a force that is sent, asked for or designed for, or a hand's motion."""

import csv
import io
import math
from array import array
from collections.abc import Mapping
from pathlib import Path

from tormagd.ground.files import read_bounded
from tormagd_client.messages import MAX_DISPLACEMENT_MM, MAX_FORCE_N, MAX_RATE_MM_S

OPTIONAL_COLUMNS = ("displacement_mm", "rate_mm_s")
TIME = (-1e10, 1e10, "s")  # seconds since 1970 are allowed
ALLOWED = {
    "t_s": TIME,
    "force_N": (0.0, MAX_FORCE_N, "N"),
    "displacement_mm": (0.0, MAX_DISPLACEMENT_MM, "mm"),
    "rate_mm_s": (-MAX_RATE_MM_S, MAX_RATE_MM_S, "mm/s"),
}
"Least, most and unit of each column."
MIN_ROWS = 2
MAX_FILE_BYTES = 16_000_000
"Over a quarter of an hour at 1 kHz."


Allowed = Mapping[str, tuple[float, float, str]]


class ForceFileError(ValueError):
    """A CSV file that is not as allowed: the message names file, row, column and value."""


def read_forces(path: Path) -> dict[str, "array[float]"]:
    """Read the columns `t_s` and `force_N`, and those of OPTIONAL_COLUMNS that the file has, by name."""
    return read_table(path, ALLOWED, OPTIONAL_COLUMNS)


def read_column(path: Path, column: str) -> tuple["array[float]", "array[float]"]:
    """Read `t_s` and one `column` more, and ignore the rest."""
    table = read_table(path, {"t_s": TIME, column: (-1e9, 1e9, "")}, has_others=True)
    return table["t_s"], table[column]


def read_table(
    path: Path, allowed: Allowed, optional: tuple[str, ...] = (), *, has_others: bool = False
) -> dict[str, "array[float]"]:
    """Read a CSV file's columns into arrays of equal length, by name."""
    try:
        data = io.BytesIO(read_bounded(path, MAX_FILE_BYTES))
        with io.TextIOWrapper(data, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            header = [name.strip() for name in next(reader, [])]
            others = [name for name in header if name not in allowed] if has_others else []
            _check_header(path, header, [*allowed, *others], (*optional, *others))
            table = {name: array("d") for name in header if name in allowed}
            for cells in reader:
                if cells:
                    row = _check_row(path, reader.line_num, header, cells, table["t_s"][-1:], allowed)
                    for name, value in zip(table, row, strict=True):
                        table[name].append(value)
    except OSError as error:
        raise ForceFileError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ForceFileError(f"{path}: not UTF-8 text (byte {error.start})") from error
    except csv.Error as error:
        raise ForceFileError(f"{path}: not CSV: {error}") from error
    if len(table["t_s"]) < MIN_ROWS:
        raise ForceFileError(f"{path}: {len(table['t_s'])} rows: allowed is at least {MIN_ROWS}")
    return table


def _check_header(path: Path, columns: list[str], known: list[str], optional: tuple[str, ...]) -> None:
    required = [name for name in known if name not in optional]
    also = f" and optionally {','.join(optional)}" if optional else ""
    allowed = f"allowed is {','.join(required)}{also}"
    missing = [name for name in required if name not in columns]
    if missing:
        raise ForceFileError(f"{path}: row 1 has no column {missing[0]} (it is {','.join(columns)[:80]!r}): {allowed}")
    for index, name in enumerate(columns):
        if name not in known:
            raise ForceFileError(f"{path}: row 1: column {name[:40]!r} is not known: {allowed}")
        if name in columns[:index]:
            raise ForceFileError(f"{path}: row 1: column {name} is there twice")


def _check_row(
    path: Path, line: int, columns: list[str], cells: list[str], before_s: "array[float]", allowed: Allowed
) -> list[float]:
    """Return the numbers of the columns that `allowed` names."""
    if len(cells) != len(columns):
        raise ForceFileError(f"{path}: row {line} has {len(cells)} values: allowed is {len(columns)}")
    known = [(name, text) for name, text in zip(columns, cells, strict=True) if name in allowed]
    row = [_number(path, line, name, text, *allowed[name]) for name, text in known]
    time = [name for name, _ in known].index("t_s")
    if before_s and not row[time] > before_s[0]:
        raise ForceFileError(
            f"{path}: row {line}, t_s = {known[time][1]}: allowed is above the row before, {before_s[0]:g}"
        )
    return row


def _number(path: Path, line: int, name: str, text: str, least: float, most: float, unit: str) -> float:
    try:
        value = float(text) if "_" not in text else math.nan  # Python reads 1_5 as 15; a table means something else
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ForceFileError(f"{path}: row {line}, {name} = {text[:40]!r}: allowed is a finite number")
    if not least <= value <= most:
        raise ForceFileError(f"{path}: row {line}, {name} = {text[:40]}: allowed is {least:g}..{most:g} {unit}")
    return value
