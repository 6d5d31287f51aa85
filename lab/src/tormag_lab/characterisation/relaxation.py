"""A relaxation spectrum from a record: the `PronySeries` that turns the driving force into the measured one.

The driving force is what the elastomer would give without memory, of any course and in any unit, because its scale is
fitted too. With branch responses h_i the model is linear,

    F = c_0 F0 + sum c_i h_i          g_i = c_i / (c_0 + sum c_i)

so only the time constants are searched. Non-negative least squares finds the c of each trial. So every fraction stays
at or above zero and their sum at or below one, whatever the noise.
"""

import math
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, nnls

from tormag_lab.arrays import Array
from tormag_lab.errors import LabError
from tormagd.element.physics.errors import require
from tormagd.element.physics.relaxation import MAX_FORCE_N, PronySeries

MAX_BRANCHES = 6
MIN_FRACTION = 1e-6
"A branch with a smaller share of the force is noise."

_STARTS = 3


class RelaxationRecord(NamedTuple):
    """Times, driving force in any unit, and measured force; the first row is the state at rest before."""

    time_s: Array
    driving: Array
    force_N: Array


@dataclass(frozen=True, slots=True)
class RelaxationFit:
    """A fitted series, its instant force per unit of driving force, R2, and the residual's RMS."""

    series: PronySeries
    scale_N: float
    r2: float
    rms_N: float


def fit_relaxation(record: RelaxationRecord, branches: int = 3) -> RelaxationFit:
    """Fit a series of up to `branches` (1..6) time constants, in rising order."""
    _check(record, branches)
    span = float(record.time_s[-1] - record.time_s[0])
    low, high = math.log(float(np.diff(record.time_s).min()) / 3.0), math.log(3.0 * span)
    fastest = max(low, math.log(span) - 2.5 * branches)
    found = []
    for start in range(_STARTS):
        # spread over the record's decades, each start shifted by a share of the spacing
        places = (np.arange(branches) + (start + 1.0) / (_STARTS + 1.0)) / branches
        trial = least_squares(
            lambda log_times: _fitted(record, np.exp(log_times))[1] / float(np.linalg.norm(record.force_N)),
            np.clip(fastest + places * (math.log(span) - fastest), low, high),
            bounds=(low, high),
            x_scale=0.5,
            xtol=1e-10,
            ftol=1e-12,
            max_nfev=60,
        )
        found.append(trial)
    best = min(found, key=lambda trial: float(trial.cost))
    times_s = np.sort(np.exp(best.x))
    coefficients, left_N = _fitted(record, times_s)
    scale = float(coefficients.sum())
    if not coefficients[0] > 0.0:
        raise LabError("nothing is left at equilibrium: the record is too short to tell the slowest time from it")
    kept = coefficients[1:] / scale >= MIN_FRACTION
    series = PronySeries(tuple((coefficients[1:][kept] / scale).tolist()), tuple(times_s[kept].tolist()))
    left = float(np.sum(left_N**2))
    whole = float(np.sum((record.force_N - record.force_N.mean()) ** 2))
    return RelaxationFit(series, scale, 1.0 - left / whole, math.sqrt(left / len(record.force_N)))


def _columns(record: RelaxationRecord, times_s: Array) -> Array:
    """Return the driving force and each branch's response as columns (n x 1 + branches)."""
    ratios = np.diff(record.time_s)[:, None] / times_s
    changes = np.diff(record.driving)[:, None] * -np.expm1(-ratios) / ratios
    decays = np.exp(-ratios)
    columns = np.zeros((len(record.time_s), len(times_s) + 1))
    columns[:, 0] = record.driving
    for branch in range(len(times_s)):
        steps = zip(decays[:, branch].tolist(), changes[:, branch].tolist(), strict=True)
        columns[:, branch + 1] = list(accumulate(steps, _responded, initial=0.0))
    return columns


def _responded(response: float, step: tuple[float, float]) -> float:
    decay, change = step
    return response * decay + change


def _fitted(record: RelaxationRecord, times_s: Array) -> tuple[Array, Array]:
    columns = _columns(record, times_s)
    coefficients, _ = nnls(columns, record.force_N)
    return coefficients, columns @ coefficients - record.force_N


def _check(record: RelaxationRecord, branches: int) -> None:
    if not 1 <= branches <= MAX_BRANCHES:
        raise LabError(f"branches = {branches}: allowed is 1..{MAX_BRANCHES}")
    rows = len(record.time_s)
    if record.time_s.ndim != 1 or any(column.shape != (rows,) for column in record) or rows < 4 * branches + 2:
        shapes = ", ".join(str(column.shape) for column in record)
        raise LabError(f"columns of shape {shapes}: wanted are {4 * branches + 2} rows or more in each")
    require("time_s", record.time_s, -1e12, 1e12)
    require("driving", record.driving, -MAX_FORCE_N, MAX_FORCE_N)
    require("force_N", record.force_N, -MAX_FORCE_N, MAX_FORCE_N)
    if not (np.diff(record.time_s) > 0.0).all():
        raise LabError("time_s does not rise strictly")
    if not (np.ptp(record.driving) > 0.0 and np.ptp(record.force_N) > 0.0):
        raise LabError("driving and force_N must both change: there is no relaxation to see")
