"""Least squares whose intervals hold where neighbouring rows are alike."""

import numpy as np

from tormagd.commission.finding import SURE, Array


def sandwich(jacobian: Array, residual: Array, blocks: Array) -> Array:
    """Return the covariance (p x p) of coefficients by the sandwich over blocks (Liang and Zeger 1986)."""
    labels, index = np.unique(blocks, return_inverse=True)
    scores = np.zeros((len(labels), jacobian.shape[1]))
    np.add.at(scores, index, jacobian * residual[:, None])
    bread = np.linalg.inv(jacobian.T @ jacobian)
    count = len(labels) / max(len(labels) - jacobian.shape[1], 1)
    return np.asarray(bread @ (scores.T @ scores) @ bread * count)


def solved(rows: Array, target: Array, blocks: Array) -> tuple[Array, Array]:
    """Fit `target` (n) by `rows` (n x p); return the coefficients (p) and their covariance."""
    scale, count = np.linalg.norm(rows, axis=0), rows.shape[1]
    if not (scale > 0.0).all() or np.linalg.matrix_rank(rows / scale) < count:
        return np.full(count, np.nan), np.full((count, count), np.nan)
    scaled = rows / scale
    values, *_ = np.linalg.lstsq(scaled, target, rcond=None)
    return values / scale, sandwich(scaled, target - scaled @ values, blocks) / np.outer(scale, scale)


def fitted(rows: Array, target: Array, blocks: Array) -> tuple[Array, Array]:
    """Fit as `solved`; return the coefficients and the half widths of their intervals."""
    values, covariance = solved(rows, target, blocks)
    return values, SURE * np.sqrt(np.diag(covariance))
