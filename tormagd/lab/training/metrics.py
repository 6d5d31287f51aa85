"""How good a force model is: its error on data, and where it does not rise with the field."""

import numpy as np

from tormagd.lab.training.dataset import Array, Dataset
from tormagd.model.features import FEATURES
from tormagd.model.model_file import ForceModel


def fit_metrics(model: ForceModel, dataset: Dataset) -> dict[str, float]:
    """Return r2, mae_N, rmse_N, max_N, and mae_percent: the mean error in percent of the training force span."""
    return force_metrics(model.predict(dataset.features), dataset.force_N, model.force_span_N)


def force_metrics(predicted_N: Array, force_N: Array, span_N: float) -> dict[str, float]:
    """Return r2, mae_N, rmse_N, max_N and mae_percent (of `span_N`) of forces (n) predicted by any model."""
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
    """Return the share of a grid over the training box (`points` per feature that varies) where dF/dB <= 0.

    There the field for a force is not unique, or the force does not depend on the field.
    """
    axes = [np.linspace(low, high, points if high > low else 1) for low, high in model.feature_ranges]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(FEATURES))
    return float((model.field_slope_N_per_mT(grid) <= 0).mean())
