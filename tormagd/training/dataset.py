"""Training data: what was measured, as arrays, and the CSV file that carries it."""

import csv
import hashlib
import math
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tormagd.bounded_file import MOST_TABLE_BYTES, require_regular
from tormagd.model.features import FEATURES

Array: TypeAlias = NDArray[np.float64]

COLUMNS = (*FEATURES, "force_N")
OPTIONAL_COLUMNS = ("cycle", "time_s")

ALLOWED = {
    "displacement_mm": (-100.0, 100.0),
    "rate_mm_s": (-1000.0, 1000.0),
    "field_mT": (0.0, 2000.0),
    "cip_percent": (0.0, 100.0),
    "force_N": (-1000.0, 1000.0),
    "cycle": (0.0, 1e9),
    "time_s": (0.0, 1e9),
}
"""Wider than any device this program drives, and narrow enough to catch a wrong unit or a shifted column.

Force and displacement may be negative by noise; rate is negative when the element is unloaded."""

MAX_ROWS = 5_000_000


class DatasetError(ValueError):
    """Training data that cannot be used: names the row (line of the file), column, value and what is allowed."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Measured rows: features (n x 4, order of `FEATURES`), force_N (n), and optionally cycle (n) and time_s (n).

    `cycle` labels rows that belong together (one loading cycle, one run), so that a split can keep them together.
    Arrays are copied and unwritable. Raises `DatasetError` on shapes that do not fit, fewer than two rows, or a value
    outside `ALLOWED`; NaN never is inside. Rows are counted from 0 here.
    """

    features: Array
    force_N: Array
    cycle: NDArray[np.int64] | None = None
    time_s: Array | None = None

    def __post_init__(self) -> None:
        for name in ("features", "force_N", "time_s"):
            self._freeze(name, np.float64)
        self._freeze("cycle", np.int64)
        rows = len(self.force_N)
        if rows < 2:
            raise DatasetError(f"{rows} rows; at least 2 are needed")
        expected = {"features": (rows, len(FEATURES)), "force_N": (rows,), "cycle": (rows,), "time_s": (rows,)}
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise DatasetError(f"{name} has shape {array.shape}; needed is {shape}")
        for name, column in self.columns().items():
            low, high = ALLOWED[name]
            refused = np.flatnonzero(~((column >= low) & (column <= high)))
            if refused.size:
                row = int(refused[0])
                raise DatasetError(f"row {row}, {name}: {column[row]} is not allowed, only {low:g} to {high:g}")

    def _freeze(self, name: str, dtype: type[np.generic]) -> None:
        given = getattr(self, name)
        if given is not None:
            array = np.array(given, dtype=dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def columns(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
        """Return each column by its name, as in the file; the optional ones only where they exist."""
        columns: dict[str, NDArray[np.float64] | NDArray[np.int64]] = dict(zip(FEATURES, self.features.T, strict=True))
        columns["force_N"] = self.force_N
        if self.cycle is not None:
            columns["cycle"] = self.cycle
        if self.time_s is not None:
            columns["time_s"] = self.time_s
        return columns

    def __len__(self) -> int:
        return len(self.force_N)

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Return the least and the greatest value of each feature and of force_N."""
        columns = self.columns()
        return {name: (float(columns[name].min()), float(columns[name].max())) for name in COLUMNS}

    def sha256(self) -> str:
        """Return the digest of names and values: the same whatever the file's number format or line ends."""
        digest = hashlib.sha256()
        for name, column in self.columns().items():
            digest.update(f"{name} {len(column)} ".encode())
            digest.update(column.astype(column.dtype.newbyteorder("<")).tobytes())
        return digest.hexdigest()

    def subset(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> "Dataset":
        """Return the chosen rows (indices or a mask)."""
        cycle = None if self.cycle is None else self.cycle[rows]
        time_s = None if self.time_s is None else self.time_s[rows]
        return Dataset(self.features[rows], self.force_N[rows], cycle, time_s)

    def split(self, validation_share: float, seed: int) -> tuple["Dataset", "Dataset"]:
        """Split at random into (training, validation), the same way for the same seed.

        With cycle labels whole cycles go to one side, because neighbours in a time series are nearly copies of each
        other and a validation that holds copies of the training rows proves nothing.
        Raises `DatasetError` when the share leaves fewer than two rows on a side.
        """
        if not 0 < validation_share < 1:
            raise DatasetError(f"validation_share = {validation_share} is not allowed, only between 0 and 1")
        groups = np.arange(len(self)) if self.cycle is None else self.cycle
        labels = np.unique(groups)
        held_out = round(validation_share * len(labels))
        chosen = np.random.default_rng(seed).permutation(labels)[:held_out]
        validation = np.isin(groups, chosen)
        if not 2 <= validation.sum() <= len(self) - 2:
            raise DatasetError(
                f"{len(self)} rows in {len(labels)} groups leave fewer than 2 rows on one side "
                f"at validation_share = {validation_share:g}"
            )
        return self.subset(~validation), self.subset(validation)


def read_csv(path: Path | str) -> Dataset:
    """Read training data: header `displacement_mm,rate_mm_s,field_mT,cip_percent,force_N` (+ `cycle`, `time_s`).

    Raises `DatasetError` naming the line of the file, the column, the value and what is allowed.
    """
    source = Path(path)
    try:
        require_regular(source, MOST_TABLE_BYTES)
        with source.open(newline="", encoding="utf-8") as file:
            return _read_rows(source, file)
    except OSError as error:
        raise DatasetError(f"{source}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{source}: not a text file in UTF-8 ({error.reason} at byte {error.start})") from error


def _read_rows(source: Path, file: TextIO) -> Dataset:
    reader = csv.reader(file, strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        extra = header[len(COLUMNS) :]
        if (
            tuple(header[: len(COLUMNS)]) != COLUMNS
            or len(set(extra)) < len(extra)
            or set(extra) - set(OPTIONAL_COLUMNS)
        ):
            raise DatasetError(
                f"{source}: row 1: header is {','.join(header)!r}; "
                f"needed is {','.join(COLUMNS)!r}, then optionally {' and '.join(OPTIONAL_COLUMNS)}"
            )
        limits = [(name, *ALLOWED[name]) for name in header]
        columns: list[array[float]] = [array("d") for _ in header]
        for texts in reader:
            if len(texts) != len(header):
                raise DatasetError(f"{source}: row {reader.line_num}: {len(texts)} values; needed are {len(header)}")
            if len(columns[0]) >= MAX_ROWS:
                raise DatasetError(f"{source}: row {reader.line_num}: at most {MAX_ROWS} rows are allowed")
            for (name, low, high), text, column in zip(limits, texts, columns, strict=True):
                value = _number(text)
                if not low <= value <= high or (name == "cycle" and not value.is_integer()):
                    kind = "whole numbers" if name == "cycle" else "numbers"
                    where = f"{source}: row {reader.line_num}, {name}"
                    raise DatasetError(f"{where}: {text[:40]!r} is not allowed, only {kind} {low:g} to {high:g}")
                column.append(value)
    except csv.Error as error:
        raise DatasetError(f"{source}: row {reader.line_num}: not CSV ({error})") from error
    if len(columns[0]) < 2:
        raise DatasetError(f"{source}: {len(columns[0])} rows; at least 2 are needed")
    named = {name: np.array(column) for name, column in zip(header, columns, strict=True)}
    features = np.column_stack([named[name] for name in FEATURES])
    cycle = named["cycle"].astype(np.int64) if "cycle" in named else None
    return Dataset(features, named["force_N"], cycle, named.get("time_s"))


def _number(text: str) -> float:
    """Return the number that `text` is, NaN when it is none; digits grouped as 1_000 are Python's idea, not CSV's."""
    try:
        return math.nan if "_" in text else float(text)
    except ValueError:
        return math.nan


def write_csv(path: Path | str, dataset: Dataset) -> None:
    """Write `dataset` so that `read_csv` gives back the same numbers to the last bit."""
    columns = dataset.columns()
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
