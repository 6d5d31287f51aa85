"""Columns of numbers from a CSV file, checked."""

import csv
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tormagd.bounded_file import MOST_TABLE_BYTES, require_regular

MAX_ROWS = 1_000_000


class RecordError(ValueError):
    """A record that cannot be used: names the file or the quantity, where in it, and what is wanted."""


def read_columns(path: Path, names: tuple[str, ...], delimiter: str = ",") -> list[NDArray[np.float64]]:
    """The named columns of a CSV file, in the order asked for.

    The header is the first line with all the names; lines before it are skipped (many testing machines write a
    preamble) and so are other columns. Raises `RecordError`: unreadable, no such header, a cell that is not a finite
    number (with its line), no rows, more than a million lines.
    """
    try:
        require_regular(path, MOST_TABLE_BYTES)
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(enumerate(csv.reader(file, delimiter=delimiter), start=1))[: MAX_ROWS + 1]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordError(f"{path}: {error}") from error
    if len(rows) > MAX_ROWS:
        raise RecordError(f"{path}: more than {MAX_ROWS} lines")
    header = next((place for place, (_, row) in enumerate(rows) if set(names) <= {cell.strip() for cell in row}), None)
    if header is None:
        raise RecordError(f"{path}: no header line with the columns {', '.join(names)}")
    cells = [cell.strip() for cell in rows[header][1]]
    places = [cells.index(name) for name in names]
    values = [
        [_number(path, line, name, row, place) for name, place in zip(names, places, strict=True)]
        for line, row in rows[header + 1 :]
        if any(cell.strip() for cell in row)
    ]
    if not values:
        raise RecordError(f"{path}: no rows under the header")
    return list(np.array(values, dtype=np.float64).T)


def _number(path: Path, line: int, name: str, row: list[str], place: int) -> float:
    text = row[place] if place < len(row) else ""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise RecordError(f"{path}, line {line}: {name} = {text!r}, wanted is a finite number")
    return number
