"""The static friction of one device: the force of a creeping handle over the force at speed, a factor k.

    model    F = f(v) (s m + o)            f(v) = 1 + e(v) (k - 1),  e(v) = exp(-(v / STRIBECK_MM_S)^2)
    error    1 + (F / (s m + o) - 1) / e(v) - k
    update   k by that times e(v) dt / (LEARNED_S + dt)

The factor is learned, and acts, at creep only. It is bounded by how much static friction differs from device to device,
and by how uncertain the fit (s, o) is.
"""

import math
from typing import Final, final

from tormagd.config import Trim
from tormagd.control.believe.strength import MAX_RELAXED, DeviceFit
from tormagd.element.model.force_curve import within

STRIBECK_MM_S: Final = 5.0
"At this speed most of static friction is gone (plant card)."
SLOWEST_MM_S: Final = 0.3
"A slower handle may stand."
LEARNED_S: Final = 0.3
"Time constant of learning the factor at rest."
MIN_STATIC: Final = 0.9
MAX_STATIC: Final = 1.15
"Bounds of k: static over kinetic friction is 1.08 to 1.25, and 1.15 on the device of the model."
BELIEVED_SD: Final = 3.0
"Standard deviations of the fit within which a creep is believed; with two, seven of draws 0 to 39 stand at the bound."
NOISE_N: Final = 0.03
"A reading below the weakest device's force, relaxed, and this noise teaches nothing."


@final
class SlowFriction:
    """Estimator of one device's factor k, its force at rest over its force at speed, and of how much of
    it was learned."""

    factor: float = 1.0
    "k, before its bounds: a fit that errs at another rate, and comes back, leaves it as it was."
    learned: float = 0.0
    "Share of the factor that was learned at a creep, 0..1."
    slowness: float = 1.0
    "e(v) where it was learned, by the same low pass; 1, as at rest, until then."

    def __init__(self, bounds: Trim) -> None:
        self._factors: Final = factor_bounds(bounds)

    def factor_at(self, rate_mm_s: float) -> float:
        """Return the factor on the force of a handle that slides at `rate_mm_s` >= 0: 1 at speed, k at rest."""
        return 1.0 + _slowness(rate_mm_s) * (within(self.factor, self._factors) - 1.0)

    def rescale(self, before_N: float, after_N: float, rate_mm_s: float) -> None:
        """Change k so that the force at a creep stays while the fit's force at speed goes from `before_N`
        to `after_N`."""
        if before_N > 0.0 and after_N > 0.0:
            kept = self.learned * max(1.0 - _slowness(rate_mm_s) / self.slowness, 0.0)
            at_creep = (1.0 + self.slowness * (self.factor - 1.0)) * math.pow(before_N / after_N, kept)
            self.factor = 1.0 + (within(at_creep, self._factors) - 1.0) / self.slowness

    def update(self, fit: DeviceFit, model_N: float, rate_mm_s: float, reading_N: float, dt_s: float) -> None:
        """Learn k from one reading at a creep of `rate_mm_s`, which stands for `dt_s`."""
        if reading_N < self._factors[0] / MIN_STATIC * (1.0 - MAX_RELAXED) * model_N - NOISE_N:
            return
        slowness = _slowness(rate_mm_s)
        share = slowness * dt_s / (LEARNED_S + dt_s)
        shown = 1.0 + (reading_N / fit.force_N(model_N) - 1.0) / slowness
        unsure = BELIEVED_SD * fit.deviation_N(model_N) / fit.force_N(model_N)
        believed = max(MIN_STATIC - unsure, self._factors[0]), min(MAX_STATIC + unsure, self._factors[1])
        self.factor = within(self.factor + share * (shown - self.factor), believed)
        self.learned += share * (1.0 - self.learned)
        self.slowness += share * (slowness - self.slowness)


def factor_bounds(bounds: Trim) -> tuple[float, float]:
    """Return the least and the greatest k of any device: MIN_STATIC at its least scale, MAX_STATIC at its greatest."""
    return bounds.least * MIN_STATIC, bounds.most * MAX_STATIC


def _slowness(rate_mm_s: float) -> float:
    return math.exp(-math.pow(rate_mm_s / STRIBECK_MM_S, 2.0))
