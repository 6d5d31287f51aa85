"""Type aliases for arrays, masks and plain data, the root mean square, and columns of numbers from a table."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tormag_lab.errors import LabError
from tormagd.ground.table import Quantity, Wanted, read_table

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Json = dict[str, Any]
MAX_TABLE_BYTES = 1 << 28


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def read_columns(
    path: Path,
    names: tuple[str, ...],
    optional: tuple[str, ...] = (),
    allowed: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, Array]:
    """Return the columns `names` of a CSV file, and those of `optional` that it has, within `allowed`."""
    needed, more = ({name: Quantity((name,)) for name in group} for group in (names, optional))
    table = read_table(path, Wanted(needed, more), MAX_TABLE_BYTES)
    if table.missing:
        raise LabError(f"{path}: row {table.missing[0]} lacks a value: allowed is one in every column")
    columns = {name: np.array(values) for name, values in table.values.items()}
    for name, column in columns.items():
        low, high = (allowed or {}).get(name, (-np.inf, np.inf))
        for place in np.flatnonzero((column < low) | (column > high))[:1].tolist():
            where = f"{path}: row {table.rows[place]}, {name}"
            raise LabError(f"{where}: {column[place]:g} is not allowed, only numbers {low:g} to {high:g}")
    return columns
