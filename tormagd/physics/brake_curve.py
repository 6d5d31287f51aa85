"""The dimensionless brake curve: force and stretch over the magnetic load, without cancellation.

Divided by its scales, the thesis's force law (Eq. 29..34) depends on one load and two constants. With

    w = (R_o - R_i) / R_i     tau = t (mu_r - 1)     A = 1 - w tau / 2     B = w (1 + 3 tau / 2)
    y     magnetic over elastic stress, the load
    eps   1 - lambda1, the radial compression at the shaft
    phi   force over 2 pi t R_i^2 mu_d G0 / R_w

it reads

    eps = r - p,  p = 1 - A y,  r = sqrt(p^2 + 2 B y)                                        (Eq. 29)
    phi = (lambda1^-4 - 1) / lambda1 + 4 (1 + w) y / lambda1^3                               (Eq. 33, 34)

As printed, the elastic and the magnetic terms cancel to rounding while the load goes to 0. Here both terms of phi are
positive, and r - p is taken as 2 B y / (r + p) where p > 0. Solved for the load, Eq. 29 is

    y = eps (2 + eps) / (2 (B + A eps))

which rises with eps, so phi rises strictly with y and has one inverse.

In Gamma_1 and Gamma_2 the thesis multiplies pure numbers by t, a length: t counts there as a bare number of metres, the
*body-force weight*. That is dimensionally odd, and it is what gives the published forces.

Formulas are written once and serve floats (through `math`, for the control loop) and arrays (through numpy).
"""

import math
import sys
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from tormagd.physics.errors import Real

MAX_COMPRESSION = 0.95
"""Largest compression the model is used at (lambda1 = 0.05): the force goes to infinity as lambda1 goes to 0."""

_NEWTON_STEPS = 100
"""Enough for bisection alone; Newton's method takes at most 8 or so (see the tests)."""

_SCALAR = SimpleNamespace(
    sqrt=math.sqrt,
    log=math.log,
    log1p=math.log1p,
    expm1=math.expm1,
    where=lambda condition, this, that: this if condition else that,
    all=bool,
)


def _functions(value: Any) -> SimpleNamespace | ModuleType:
    """The elementary functions that fit the value's type."""
    return _SCALAR if isinstance(value, float | int) else np


class BrakeCurve(NamedTuple):
    """The curve of one wall ratio and body-force weight; all arguments and results dimensionless, unchecked."""

    wall: float
    a: float
    b: float

    @classmethod
    def of(cls, wall: float, body_force: float) -> "BrakeCurve":
        """From w = (R_o - R_i) / R_i > 0 and tau = t (mu_r - 1) >= 0."""
        return cls(wall, 1.0 - 0.5 * wall * body_force, wall * (1.0 + 1.5 * body_force))

    def compression(self, load: Real) -> Real:
        """eps = 1 - lambda1 at the load y >= 0."""
        fn = _functions(load)
        p = 1.0 - self.a * load
        larger = fn.sqrt(p * p + 2.0 * self.b * load) + abs(p)
        # a thin wall under a high load has p < 0, where the plain difference is the one that does not cancel
        compression: Real = fn.where(p < 0.0, larger, 2.0 * self.b * load / larger)
        return compression

    def load(self, compression: Real) -> Real:
        """The load y that compresses by eps: inverse of `compression`."""
        load: Real = 0.5 * compression * (2.0 + compression) / (self.b + self.a * compression)
        return load

    def force(self, compression: Real, load: Real) -> Real:
        """phi at a load and the compression it gives."""
        fn = _functions(load)
        stretch = 1.0 - compression
        elastic: Real = fn.expm1(-4.0 * fn.log1p(-compression))
        magnetic = 4.0 * (1.0 + self.wall) * load / (stretch * stretch)
        return (elastic + magnetic) / stretch

    def force_slope(self, compression: Real, load: Real) -> Real:
        """d phi / d y; every term is positive."""
        stretch, w = 1.0 - compression, self.wall
        # d phi / d eps at constant load, then d phi / d y at constant stretch
        elastic, magnetic = 5.0 / stretch**6 - 1.0 / stretch**2, 12.0 * (1.0 + w) * load / stretch**4
        return (elastic + magnetic) * self._compression_slope(compression, load) + 4.0 * (1.0 + w) / stretch**3

    def compression_for_force(self, force: Real) -> Real:
        """eps at which phi(eps) is `force`, for 0 <= force <= phi(0.95): inverse of the curve along eps.

        Newton's method on log(phi) over log(eps / lambda1), where the curve's slope goes from 1 to 5 only, kept inside
        a shrinking bracket. It starts at the root of the small-load limit, phi = 4 eps (1 + (1 + w) / B).
        """
        fn = _functions(force)
        rounding = 4.0 * float(np.finfo(force.dtype).eps if isinstance(force, np.ndarray) else sys.float_info.epsilon)
        wanted = fn.where(force > 0.0, force, 1.0)
        low, high = 0.0 * wanted, MAX_COMPRESSION + 0.0 * wanted
        compression = 0.25 * wanted / (1.0 + (1.0 + self.wall) / self.b)
        compression = fn.where(compression < 0.5, compression, 0.5)
        for _ in range(_NEWTON_STEPS):
            load = self.load(compression)
            value = self.force(compression, load)
            above = value > wanted
            low, high = fn.where(above, low, compression), fn.where(above, compression, high)
            per_compression = self.force_slope(compression, load) / self._compression_slope(compression, load)
            odds = compression / (1.0 - compression)
            step = -fn.log(value / wanted) * value / (per_compression * compression * (1.0 - compression))
            # odds * exp(step) to second order, positive and without overflow
            odds = fn.where(above, odds / (1.0 + abs(step)), odds * (1.0 + abs(step)))
            trial = odds / (1.0 + odds)
            settled = abs(trial - compression) <= rounding * compression
            # a step down to rounding is taken as it is: noise may put it just outside the bracket
            good = settled | ((trial > low) & (trial < high))
            compression = fn.where(good, trial, 0.5 * (low + high))
            if fn.all(settled):
                break
        result: Real = fn.where(force > 0.0, compression, 0.0 * wanted)
        return result

    def _compression_slope(self, compression: Real, load: Real) -> Real:
        """d eps / d y = (B + A eps) / r, with r = p + eps."""
        return (self.b + self.a * compression) / (1.0 - self.a * load + compression)
