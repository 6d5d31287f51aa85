"""Training data as arrays, the CSV file that carries it, and how a model is judged on it.

A model is judged on rows that it did not learn from, drawn at random or in whole groups.
"""

import csv
import hashlib
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tormag_lab.arrays import Array, Mask, read_columns
from tormag_lab.errors import LabError
from tormagd.element.model.features import FEATURES, Scaling
from tormagd.element.model.model_file import ForceModel
from tormagd.element.physics.errors import DomainError

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
"""Wider than any device, and narrow enough to catch a wrong unit or a shifted column. Rates are negative while the
element is unloaded."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Measured rows: features (n x 4, order of `FEATURES`), forces (n), and optionally times and `cycle`, which labels
    rows that a split keeps together."""

    features: Array
    force_N: Array
    cycle: NDArray[np.int64] | None = None
    time_s: Array | None = None

    @classmethod
    def of(cls, columns: Mapping[str, NDArray[Any]]) -> "Dataset":
        cycle = columns["cycle"].astype(np.int64) if "cycle" in columns else None
        features = np.column_stack([columns[name] for name in FEATURES])
        return cls(features, columns["force_N"], cycle, columns.get("time_s"))

    def __post_init__(self) -> None:
        if len(self.force_N) < 2:
            raise LabError(f"{len(self.force_N)} rows; at least 2 are needed")

    def columns(self) -> dict[str, Array | NDArray[np.int64]]:
        columns = (*self.features.T, self.force_N, self.cycle, self.time_s)
        named = zip((*COLUMNS, *OPTIONAL_COLUMNS), columns, strict=True)
        return {name: column for name, column in named if column is not None}

    def __len__(self) -> int:
        return len(self.force_N)

    def ranges(self) -> dict[str, tuple[float, float]]:
        columns = self.columns()
        return {name: (float(columns[name].min()), float(columns[name].max())) for name in COLUMNS}

    def scaling(self) -> Scaling:
        low, high = self.features.min(axis=0), self.features.max(axis=0)
        span = high - low
        gain = np.divide(2.0, span, out=np.zeros_like(span), where=span > 0)
        force_low, force_high = float(self.force_N.min()), float(self.force_N.max())
        if not force_high > force_low:
            raise DomainError(
                "force_N", force_low, "at least two different values, otherwise there is nothing to learn"
            )
        return Scaling(
            input_offset=tuple(((low + high) / 2).tolist()),
            input_gain=tuple(gain.tolist()),
            output_offset=(force_low + force_high) / 2,
            output_gain=2 / (force_high - force_low),
        )

    def sha256(self) -> str:
        """Return the digest of names and values, whatever the file's number format or line ends."""
        digest = hashlib.sha256()
        for name, column in self.columns().items():
            digest.update(f"{name} {len(column)} ".encode())
            digest.update(column.astype(column.dtype.newbyteorder("<")).tobytes())
        return digest.hexdigest()

    def subset(self, rows: NDArray[np.integer] | Mask) -> "Dataset":
        return Dataset.of({name: column[rows] for name, column in self.columns().items()})

    def split(self, validation_share: float, seed: int) -> tuple["Dataset", "Dataset"]:
        """Split into training and validation at random, by `seed`; rows keep their order."""
        if not 0 < validation_share < 1:
            raise LabError(f"validation_share = {validation_share} is not allowed, only between 0 and 1")
        groups = np.arange(len(self)) if self.cycle is None else self.cycle
        labels = np.unique(groups)
        held_out = round(validation_share * len(labels))
        chosen = np.random.default_rng(seed).permutation(labels)[:held_out]
        validation = np.isin(groups, chosen)
        if not 2 <= validation.sum() <= len(self) - 2:
            raise LabError(
                f"{len(self)} rows in {len(labels)} groups leave fewer than 2 rows on one side "
                f"at validation_share = {validation_share:g}"
            )
        return self.subset(~validation), self.subset(validation)


def records(time_s: Array) -> list[slice]:
    """Return the rows of each record: a new one begins wherever time goes back."""
    starts = [0, *(np.flatnonzero(np.diff(time_s) < 0) + 1).tolist(), len(time_s)]
    return [slice(first, last) for first, last in itertools.pairwise(starts)]


def times_of(data: Dataset) -> Array:
    if data.time_s is None:
        raise DomainError("time_s", None, "a column of the data: a model with memory needs it")
    return data.time_s


def read_csv(path: Path) -> Dataset:
    """Read training data, with its columns in any order; `cycle` and `time_s` are optional."""
    named = read_columns(path, COLUMNS, OPTIONAL_COLUMNS, ALLOWED)
    cycle = named.get("cycle", np.zeros(0))
    for row in np.flatnonzero(cycle != np.floor(cycle))[:1].tolist():
        raise LabError(f"{path}: row {row + 2}, cycle: '{cycle[row]:g}' is not allowed, only whole numbers")
    return Dataset.of(named)


def write_csv(path: Path | str, dataset: Dataset) -> None:
    """Write `dataset` so that `read_csv` gives back the same numbers to the last bit."""
    columns = dataset.columns()
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def random_split(rows: int, seed: int, share: float = 0.3) -> Mask:
    """Return a mask of the held-out `share` of so many rows, drawn by `seed`."""
    held = np.zeros(rows, dtype=np.bool_)
    held[np.random.default_rng(seed).permutation(rows)[: round(share * rows)]] = True
    return held


def leave_one_out(dataset: Dataset, feature: str) -> list[Mask]:
    column = dataset.features[:, FEATURES.index(feature)]
    return [column == value for value in np.unique(column)]


def leave_cycles_out(dataset: Dataset, folds: int, seed: int) -> list[Mask]:
    """Return the mask of the whole cycles that each fold holds out."""
    assert dataset.cycle is not None
    parts = np.array_split(np.random.default_rng(seed).permutation(np.unique(dataset.cycle)), folds)
    return [np.isin(dataset.cycle, part) for part in parts]


def trained_metrics(model: ForceModel, training: Dataset, validation: Dataset) -> dict[str, float]:
    """Return a model file's metrics: errors on both data sets, their rows, and `not_rising_share`."""
    return {
        **{f"train_{name}": value for name, value in fit_metrics(model, training).items()},
        **{f"validation_{name}": value for name, value in fit_metrics(model, validation).items()},
        "not_rising_share": not_rising_share(model),
        "train_rows": float(len(training)),
        "validation_rows": float(len(validation)),
    }


def fit_metrics(model: ForceModel, dataset: Dataset) -> dict[str, float]:
    return force_metrics(model.predict(dataset.features), dataset.force_N, model.force_span_N)


def force_metrics(predicted_N: Array, force_N: Array, span_N: float) -> dict[str, float]:
    """Return mae_N, rmse_N, max_N, mae_percent (of `span_N`) and r2 of predicted forces."""
    error_N = predicted_N - force_N
    variance = float(np.var(force_N))
    mae_N = float(np.abs(error_N).mean())
    mean_square = float(np.square(error_N).mean())
    metrics = {
        "mae_N": mae_N,
        "mae_percent": 100 * mae_N / span_N,
        "rmse_N": float(np.sqrt(mean_square)),
        "max_N": float(np.abs(error_N).max()),
    }
    if variance > 0:  # equal forces have no variance to explain
        metrics["r2"] = 1 - mean_square / variance
    return metrics


def not_rising_share(model: ForceModel, points: int = 17) -> float:
    """Return the share of a grid over the training box where dF/dB <= 0."""
    if model.metadata.boxes:
        return max(not_rising_share(model.of(name), points) for name in model.metadata.boxes)
    axes = [np.linspace(low, high, points if high > low else 1) for low, high in model.feature_ranges]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(FEATURES))
    return float((model.field_slope_N_per_mT(grid) <= 0).mean())
