"""A finding: one measured value of a device, its interval by least squares, what is allowed, and a remedy."""

import math

import msgspec
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
BLOCKS = 8
"Parts of a record whose means say how sure a mean is."
SURE = 2.0
"Standard deviations on either side that make an interval."


class Finding(msgspec.Struct, frozen=True):
    """One row of a commissioning: a value that passes from `least` to `most`, both included."""

    name: str
    value: float | None
    half_width: float
    unit: str
    least: float
    most: float
    remedy: str

    @property
    def is_fine(self) -> bool:
        return self.value is not None and self.least <= self.value <= self.most

    @property
    def shown(self) -> str:
        if self.value is None:
            return "not measured"
        width = f" ± {self.half_width:.2g}" if self.half_width else ""
        return f"{float(f'{self.value:.4g}'):g}{width} {self.unit}".rstrip()  # 14090, not 1.409e+04

    @property
    def allowed(self) -> str:
        return f"{self.least:.4g} to {self.most:.4g}"


def finding(
    name: str,
    values: Array | float,
    unit: str,
    allowed: tuple[float, float],
    remedy: str,
    scale: float = 1.0,
    half_width: float = 0.0,
) -> Finding:
    known = np.atleast_1d(np.asarray(values, dtype=np.float64)) * scale
    known = known[np.isfinite(known)]
    if not known.size:
        return Finding(name, None, 0.0, unit, *allowed, remedy)
    if known.size >= 2 * BLOCKS:
        means = [part.mean() for part in np.array_split(known, BLOCKS)]
        half_width = SURE * float(np.std(means)) / math.sqrt(BLOCKS - 1)
    return Finding(name, float(known.mean()), half_width, unit, *allowed, remedy)


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
