"""What a device first showed: its force over the model's, with the curve of its own field law.

    force    F = s m + o + q (m - MIDDLE_N)^2 + h max(LEAST_N - m, 0)^2      m the model's force, N; s, o, N, q, h, 1/N
    learn    Kalman filter of (s, o, q, h) that forgets nothing, with an error of density ERROR_N2_S

A straight line misses devices of the thesis's field law by 60 to 80 mN, and sample 2 by 140 mN at its open gap.
"""

import math
from typing import Final, final

from tormagd.control.believe.strength import DeviceFit

MIDDLE_N: Final = 1.3
"The curve is 0 here, amid the forces that scenes ask for."
CURVE_VARIANCE: Final = 0.06**2
"Spread of the curve, 1/N^2: what the field law of the thesis makes of a power law."
LEAST_N: Final = 1.0
HOOK_VARIANCE: Final = 0.5**2
"At a wide gap the field is another: spread of h, 1/N^2."
ERROR_N2_S: Final = 1e-3
"Density of what no curve follows, N^2 s: a turn of the shaft takes some seconds, and is to count as a whole."


@final
class Anchor:
    """Estimator of a device's force that forgets nothing. It keeps (s, o, q, h) with their covariance."""

    def __init__(self, fit: DeviceFit) -> None:
        self.values: list[float] = [fit.scale, fit.offset_N, 0.0, 0.0]
        self.covariance: list[list[float]] = [
            [fit.scale_variance, fit.covariance_N, 0.0, 0.0],
            [fit.covariance_N, fit.offset_variance_N2, 0.0, 0.0],
            [0.0, 0.0, CURVE_VARIANCE, 0.0],
            [0.0, 0.0, 0.0, HOOK_VARIANCE],
        ]

    def force_N(self, model_N: float) -> float:
        """Return the device's force, N, where the model's is `model_N`."""
        return _dot(self.values, _terms(model_N))

    def model_N(self, force_N: float) -> float:
        """Return the model's force, N, over LEAST_N, that gives `force_N`; one beyond where the device gives most, if
        none does."""
        scale, offset_N, curve, _ = self.values
        slope, left_N = scale - 2.0 * MIDDLE_N * curve, offset_N + MIDDLE_N * MIDDLE_N * curve - force_N
        return -2.0 * left_N / (slope + math.sqrt(max(slope * slope - 4.0 * curve * left_N, 0.0)))

    def deviation_N(self, model_N: float) -> float:
        """Return the standard deviation, N, of the device's force where the model's is `model_N`."""
        terms = _terms(model_N)
        return math.sqrt(max(_dot([_dot(row, terms) for row in self.covariance], terms), 0.0))

    def learn(self, model_N: float, reading_N: float, dt_s: float) -> None:
        """Learn from one reading, which stands for `dt_s` > 0, where the model's force is `model_N`."""
        terms = _terms(model_N)
        gains = [_dot(row, terms) for row in self.covariance]
        variance_N2 = _dot(gains, terms) + ERROR_N2_S / dt_s
        error_N = reading_N - self.force_N(model_N)
        self.values = [value + gain * error_N / variance_N2 for value, gain in zip(self.values, gains, strict=True)]
        self.covariance = [
            [each - gain * other / variance_N2 for each, other in zip(row, gains, strict=True)]
            for row, gain in zip(self.covariance, gains, strict=True)
        ]


def _terms(model_N: float) -> list[float]:
    return [model_N, 1.0, math.pow(model_N - MIDDLE_N, 2.0), math.pow(max(LEAST_N - model_N, 0.0), 2.0)]


def _dot(left: list[float], right: list[float]) -> float:
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2] + left[3] * right[3]
