"""Splits into rows that a model learns from and rows that judge it, at random or by whole groups; and its errors."""

from collections.abc import Iterator

import numpy as np

from tormagd.lab.arrays import Array, Mask
from tormagd.lab.training.dataset import Dataset
from tormagd.model.features import FEATURES
from tormagd.model.model_file import ForceModel


def random_split(rows: int, seed: int, share: float = 0.3) -> Mask:
    """Return a mask (rows), True for the rows held out: `share` of them, rounded, drawn by `seed`. The thesis's is 70 :
    30.

    Rows of a time series are nearly copies of their neighbours: this split flatters, and is for comparison only.
    `share` is not checked: 0 holds out none, 1 all.
    """
    held = np.zeros(rows, dtype=np.bool_)
    held[np.random.default_rng(seed).permutation(rows)[: round(share * rows)]] = True
    return held


def leave_one_out(dataset: Dataset, feature: str) -> Iterator[tuple[float, Mask]]:
    """Yield each value of `feature` (whole fields, whole classes) with the mask of the rows that have it."""
    column = dataset.features[:, FEATURES.index(feature)]
    for value in np.unique(column):
        yield float(value), column == value


def leave_cycles_out(dataset: Dataset, folds: int, seed: int) -> Iterator[tuple[int, Mask]]:
    """Yield the number of each of `folds` folds, from 0, and the mask (n) of its rows, True for those held out.

    A fold has whole cycles, drawn by `seed`, and every cycle is in one fold. The data must have cycles. More folds than
    cycles leave some without a row.
    """
    assert dataset.cycle is not None
    parts = np.array_split(np.random.default_rng(seed).permutation(np.unique(dataset.cycle)), folds)
    for fold, part in enumerate(parts):
        yield fold, np.isin(dataset.cycle, part)


def trained_metrics(model: ForceModel, training: Dataset, validation: Dataset) -> dict[str, float]:
    """Return what a model file says of its training: errors on both data sets, their rows, and `not_rising_share`.

    Keys are those of `fit_metrics` behind `train_` and `validation_`, and `train_rows` and `validation_rows`, floats.
    """
    return {
        **{f"train_{name}": value for name, value in fit_metrics(model, training).items()},
        **{f"validation_{name}": value for name, value in fit_metrics(model, validation).items()},
        "not_rising_share": not_rising_share(model),
        "train_rows": float(len(training)),
        "validation_rows": float(len(validation)),
    }


def fit_metrics(model: ForceModel, dataset: Dataset) -> dict[str, float]:
    """Return a model's errors on a data set as `force_metrics` does; percents are of the training force span."""
    return force_metrics(model.predict(dataset.features), dataset.force_N, model.force_span_N)


def force_metrics(predicted_N: Array, force_N: Array, span_N: float) -> dict[str, float]:
    """Return mae_N, rmse_N, max_N, mae_percent (of `span_N`) and r2 of forces (n), N, predicted by any model.

    There is no r2 where all measured forces are equal. Raises ZeroDivisionError for a `span_N` of 0, ValueError without
    rows.
    """
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
    if variance > 0:  # a subset of equal forces has no variance to explain
        metrics["r2"] = 1 - mean_square / variance
    return metrics


def not_rising_share(model: ForceModel, points: int = 17) -> float:
    """Return the share, 0..1, of a grid over the training box (`points` per feature that varies) where dF/dB <= 0.

    In these places no single field gives a force, or the force does not depend on the field. A model of several inserts
    gets the greatest share of one.
    """
    if model.metadata.boxes:
        return max(not_rising_share(model.of(name), points) for name in model.metadata.boxes)
    axes = [np.linspace(low, high, points if high > low else 1) for low, high in model.feature_ranges]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(FEATURES))
    return float((model.field_slope_N_per_mT(grid) <= 0).mean())
