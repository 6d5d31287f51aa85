"""Least squares whose intervals hold where neighbouring rows are alike."""

import numpy as np

from tormagd.commission.finding import SURE, Array


def sandwich(jacobian: Array, residual: Array, blocks: Array) -> Array:
    """Return the covariance (p x p) of least-squares coefficients by the sandwich over blocks (Liang and Zeger 1986).

    Rows (n x p) and residuals (n) of one number in `blocks` (n) may be correlated; corrected for few blocks.
    """
    labels, index = np.unique(blocks, return_inverse=True)
    scores = np.zeros((len(labels), jacobian.shape[1]))
    np.add.at(scores, index, jacobian * residual[:, None])
    bread = np.linalg.inv(jacobian.T @ jacobian)
    count = len(labels) / max(len(labels) - jacobian.shape[1], 1)
    return np.asarray(bread @ (scores.T @ scores) @ bread * count)


def fitted(rows: Array, target: Array, blocks: Array) -> tuple[Array, Array]:
    """Return the coefficients (p) by which `rows` (n x p) make `target` (n), and the half widths of their intervals.

    They are NaN where the columns depend on each other.
    """
    scale = np.linalg.norm(rows, axis=0)
    if not (scale > 0.0).all() or np.linalg.matrix_rank(rows / scale) < rows.shape[1]:
        return np.full(rows.shape[1], np.nan), np.full(rows.shape[1], np.nan)
    values, *_ = np.linalg.lstsq(rows / scale, target, rcond=None)
    covariance = sandwich(rows / scale, target - rows / scale @ values, blocks)
    return values / scale, SURE * np.sqrt(np.diag(covariance)) / scale
