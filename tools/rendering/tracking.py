"""How well a force was rendered: nothing is removed from the error, no mean and no delay."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Tracking(NamedTuple):
    """Tracking of one signal. `variance_accounted_for` is 1 - sum(e^2) / sum((ref - mean(ref))^2)."""

    rms_N: float
    variance_accounted_for: float
    worst_N: float
    mean_N: float
    reference_sd_N: float


def tracking(reference_N: Array, rendered_N: Array) -> Tracking:
    """Compares two signals of one length, sample by sample."""
    error = rendered_N - reference_N
    deviation = reference_N - reference_N.mean()
    return Tracking(
        rms_N=float(np.sqrt(np.mean(error**2))),
        variance_accounted_for=float(1.0 - np.sum(error**2) / np.sum(deviation**2)),
        worst_N=float(np.abs(error).max()),
        mean_N=float(error.mean()),
        reference_sd_N=float(deviation.std()),
    )
