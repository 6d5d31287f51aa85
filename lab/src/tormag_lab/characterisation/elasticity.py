"""Fits of uniaxial laws of incompressible rubber to engineering stress, force over undeformed area.

    Ogden        sigma = sum 2 mu_i / alpha_i (lambda^(alpha_i - 1) - lambda^(-alpha_i / 2 - 1))
    neo-Hookean  sigma = G (lambda - lambda^-2), which is Ogden's with alpha = 2
    thesis       sigma = G_o (lambda^alpha - lambda^(-alpha / 2))                                      (Eq. 3)

The thesis calls Eq. 3 an Ogden law of engineering stress, and G_o the shear modulus. But it is Ogden's *true* stress
with G_o for 2 mu / alpha. By the initial slope, 3 G in any incompressible law, its shear modulus is alpha G_o / 2.
Tension is positive. Every law is linear in its moduli. A grid and a search find the exponents, non-negative least
squares the moduli of each trial (variable projection).
"""

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, nnls

from tormag_lab.arrays import Array
from tormag_lab.errors import LabError
from tormagd.element.physics.errors import FloatArray, require

Shape = Callable[[FloatArray, float], FloatArray]
"Stress of one term over its modulus, by stretch and exponent."

MIN_STRETCH, MAX_STRETCH = 0.05, 20.0
MIN_EXPONENT, MAX_EXPONENT = 0.05, 30.0
MAX_TERMS = 3
_GRID = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 13.0, 19.0, 27.0)
_STARTS = 4


def thesis_shape(stretch: FloatArray, exponent: float) -> FloatArray:
    """Return Eq. 3 over mu, the true stress of an Ogden term."""
    log = np.log(stretch)
    return 2.0 / exponent * np.exp(-0.5 * exponent * log) * np.expm1(1.5 * exponent * log)


def ogden_shape(stretch: FloatArray, exponent: float) -> FloatArray:
    """Return the engineering stress of an Ogden term over its mu."""
    return thesis_shape(stretch, exponent) / stretch


class Fit(NamedTuple):
    """A fitted law: its moduli mu, its exponents, and R2."""

    moduli_Pa: tuple[float, ...]
    exponents: tuple[float, ...]
    r2: float

    @property
    def shear_modulus_Pa(self) -> float:
        return sum(self.moduli_Pa)


def fit_neo_hookean(stretch: Array, stress_Pa: Array) -> Fit:
    _check(stretch, stress_Pa, 2)
    return _fitted(ogden_shape, stretch, stress_Pa, (2.0,))


def fit_ogden(stretch: Array, stress_Pa: Array, terms: int = 1) -> Fit:
    """Fit Ogden's law with up to `terms` terms, 1..3."""
    if not 1 <= terms <= MAX_TERMS:
        raise LabError(f"terms = {terms}: allowed is 1..{MAX_TERMS}")
    return _searched(ogden_shape, stretch, stress_Pa, terms)


def fit_thesis_ogden(stretch: Array, stress_Pa: Array) -> Fit:
    """Fit Eq. 3 of the thesis as printed, with alpha > 0."""
    return _searched(thesis_shape, stretch, stress_Pa, 1)


def _searched(shape: Shape, stretch: Array, stress_Pa: Array, terms: int) -> Fit:
    _check(stretch, stress_Pa, 2 * terms + 1)

    def norm(exponents: tuple[float, ...]) -> float:
        return float(np.linalg.norm(_moduli(shape, stretch, stress_Pa, exponents)[1]))

    starts = sorted(combinations(_GRID, terms), key=norm)[:_STARTS]
    tried = [starts[0]]
    for start in starts:
        found = least_squares(
            lambda log: _moduli(shape, stretch, stress_Pa, tuple(np.exp(log).tolist()))[1],
            np.log(start),
            bounds=(np.log(MIN_EXPONENT), np.log(MAX_EXPONENT)),
            x_scale=0.3,
            xtol=1e-12,
            ftol=1e-14,
        )
        tried.append(tuple(np.exp(found.x).tolist()))
    return _fitted(shape, stretch, stress_Pa, min(tried, key=norm))


def _moduli(shape: Shape, stretch: Array, stress_Pa: Array, exponents: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the best moduli >= 0 for these exponents, and the residual (n)."""
    columns = np.column_stack([shape(stretch, exponent) for exponent in exponents])
    # scale columns and stress to unit size: the shapes differ by many orders of magnitude
    sizes, size_Pa = np.linalg.norm(columns, axis=0), float(np.linalg.norm(stress_Pa))
    scaled, _ = nnls(columns / sizes, stress_Pa / size_Pa)
    return scaled * size_Pa / sizes, columns / sizes @ scaled - stress_Pa / size_Pa


def _fitted(shape: Shape, stretch: Array, stress_Pa: Array, exponents: tuple[float, ...]) -> Fit:
    moduli, residual = _moduli(shape, stretch, stress_Pa, exponents)
    if not (moduli > 0.0).any():
        raise LabError("the stress does not rise with the stretch: no positive modulus fits")
    kept = [pair for pair in zip(moduli.tolist(), exponents, strict=True) if pair[0] > 0.0]
    kept_Pa, kept_exponents = zip(*kept, strict=True)
    left = float(residual @ residual * (stress_Pa @ stress_Pa))
    return Fit(kept_Pa, kept_exponents, 1.0 - left / float(np.sum((stress_Pa - stress_Pa.mean()) ** 2)))


def _check(stretch: Array, stress_Pa: Array, least: int) -> None:
    if stretch.ndim != 1 or stretch.shape != stress_Pa.shape or len(stretch) < least:
        raise LabError(f"stretch {stretch.shape}, stress_Pa {stress_Pa.shape}: wanted are {least} pairs or more")
    require("stretch", stretch, MIN_STRETCH, MAX_STRETCH)
    require("stress_Pa", stress_Pa, -1e12, 1e12)
    if not (np.ptp(stretch) > 1e-6 and np.ptp(stress_Pa) > 0.0):
        raise LabError("stretch and stress must both vary over the curve")
