"""The dimensionless brake curve: force and stretch over the magnetic load (Eq. 29 to 34), without cancellation.

    w = (R_o - R_i) / R_i     tau = t (mu_r - 1)     A = 1 - w tau / 2     B = w (1 + 3 tau / 2)
    eps = r - p,  p = 1 - A y,  r = sqrt(p^2 + 2 B y)             radial compression 1 - lambda1
    phi = (lambda1^-4 - 1) / lambda1 + 4 (1 + w) y / lambda1^3    force over 2 pi t R_i^2 mu_d G0 / R_w

The load y is magnetic over elastic stress; in tau, t is a bare number of metres, as in the thesis. Nothing cancels at
small loads: both terms of phi are positive, and r - p is taken as 2 B y / (r + p) where p > 0.
"""

import math
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from tormagd.element.physics.errors import Real

MAX_COMPRESSION = 0.95
"lambda1 = 0.05: the force goes to infinity as lambda1 goes to 0."

_SCALAR = SimpleNamespace(
    sqrt=math.sqrt,
    log=math.log,
    log1p=math.log1p,
    expm1=math.expm1,
    where=lambda condition, this, that: this if condition else that,
    all=bool,
)


def functions(value: Any) -> SimpleNamespace | ModuleType:
    return _SCALAR if isinstance(value, float | int) else np


class BrakeCurve(NamedTuple):
    wall: float
    a: float
    b: float

    @classmethod
    def of(cls, wall: float, body_force: float) -> "BrakeCurve":
        return cls(wall, 1.0 - 0.5 * wall * body_force, wall * (1.0 + 1.5 * body_force))

    def compression(self, load: Real) -> Real:
        """Return eps at the load y >= 0 (Eq. 29)."""
        fn = functions(load)
        p = 1.0 - self.a * load
        larger = fn.sqrt(p * p + 2.0 * self.b * load) + abs(p)
        # a thin wall under a high load has p < 0, where r - p does not cancel
        compression: Real = fn.where(p < 0.0, larger, 2.0 * self.b * load / larger)
        return compression

    def load(self, compression: Real) -> Real:
        """Return the load y that compresses by eps."""
        load: Real = 0.5 * compression * (2.0 + compression) / (self.b + self.a * compression)
        return load

    def force(self, compression: Real, load: Real) -> Real:
        """Return the force phi (Eq. 33 and 34)."""
        fn = functions(load)
        stretch = 1.0 - compression
        elastic: Real = fn.expm1(-4.0 * fn.log1p(-compression))
        magnetic = 4.0 * (1.0 + self.wall) * load / (stretch * stretch)
        return (elastic + magnetic) / stretch
