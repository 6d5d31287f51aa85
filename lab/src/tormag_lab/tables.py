"""Columns of numbers from a CSV file, checked."""

import csv
import math
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from tormag_lab.arrays import Array
from tormag_lab.errors import LabError
from tormagd_client.regular_file import require_regular

MAX_ROWS = 5_000_000
MAX_TABLE_BYTES = 1 << 30
"A day of a testing machine; the table is read row by row."


def read_columns(
    path: Path,
    names: tuple[str, ...],
    optional: tuple[str, ...] = (),
    *,
    delimiter: str = ",",
    allowed: Mapping[str, tuple[float, float]] | None = None,
    is_exact: bool = False,
) -> dict[str, Array]:
    """Return the columns `names` of a CSV file, and those of `optional` that it has, within `allowed`."""
    try:
        require_regular(path, MAX_TABLE_BYTES)
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=delimiter, strict=is_exact)
            try:
                rows = ((reader.line_num, [cell.strip() for cell in row]) for row in reader)
                return _columns(path, rows, names, optional, allowed or {}, is_exact)
            except csv.Error as error:
                raise LabError(f"{path}: row {reader.line_num}: not CSV ({error})") from error
    except OSError as error:
        raise LabError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise LabError(f"{path}: not a text file in UTF-8 ({error.reason} at byte {error.start})") from error


def _columns(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    names: tuple[str, ...],
    optional: tuple[str, ...],
    allowed: Mapping[str, tuple[float, float]],
    is_exact: bool,
) -> dict[str, Array]:
    """Find the header among numbered rows, and return the columns below it."""
    header: list[str] = []
    for _, header in rows:
        if is_exact or set(names) <= set(header):
            break
    known = [name for name in (*names, *optional) if name in header]
    wrong = [f"{name!r} is missing" for name in names if name not in header]
    wrong += [f"{name!r} stands twice" for name in known if header.count(name) > 1]
    wrong += [f"{name!r} is not known" for name in header if is_exact and name not in known]
    if wrong:
        told = f", and optionally {' and '.join(optional)}" if optional else ""
        raise LabError(f"{path}: row 1: header: {', '.join(wrong)[:200]}; needed is {','.join(names)}{told}")
    places = [(name, header.index(name), allowed.get(name)) for name in known]
    columns = {name: array("d") for name in known}
    for line, row in rows:
        if is_exact and len(row) != len(header):
            raise LabError(f"{path}: row {line}: {len(row)} values; needed are {len(header)}")
        if len(columns[names[0]]) >= MAX_ROWS:
            raise LabError(f"{path}: row {line}: at most {MAX_ROWS} rows are allowed")
        if any(row):
            for name, place, bounds in places:
                text = row[place] if place < len(row) else ""
                columns[name].append(_number(f"{path}: row {line}, {name}", text, bounds))
    if not columns[names[0]]:
        raise LabError(f"{path}: 0 rows under the header")
    return {name: np.array(column) for name, column in columns.items()}


def _number(where: str, text: str, bounds: tuple[float, float] | None) -> float:
    try:
        # Python reads 1_000 as a number, CSV does not
        number = math.nan if "_" in text else float(text)
    except ValueError:
        number = math.nan
    low, high = bounds or (-math.inf, math.inf)
    if not (math.isfinite(number) and low <= number <= high):
        wanted = "finite numbers" if bounds is None else f"numbers {low:g} to {high:g}"
        raise LabError(f"{where}: {text[:40]!r} is not allowed, only {wanted}")
    return number
