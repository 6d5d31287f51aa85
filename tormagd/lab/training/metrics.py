"""How good a force model is: its error on data."""

import numpy as np

from tormagd.lab.arrays import Array
from tormagd.lab.training.dataset import Dataset
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
