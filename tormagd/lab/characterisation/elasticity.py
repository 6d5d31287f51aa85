"""Fits of uniaxial laws of incompressible rubber to a stress-stretch curve, by least squares of the engineering stress.

The *engineering stress* is force over undeformed area; tension, and stretches above one, are positive.

    Ogden        sigma = sum 2 mu_i / alpha_i (lambda^(alpha_i - 1) - lambda^(-alpha_i / 2 - 1))
    neo-Hookean  sigma = G (lambda - lambda^-2), which is Ogden's with alpha = 2
    thesis       sigma = G_o (lambda^alpha - lambda^(-alpha / 2))                                      (Eq. 3)

The thesis calls Eq. 3 an Ogden law for the engineering stress of Eq. 1, and G_o the shear modulus. It is one up to
two factors: lambda times Ogden's stress is the *true* stress, and G_o stands for 2 mu / alpha. Any incompressible law
starts with the slope 3 G; that of Eq. 3 is 3 alpha G_o / 2. So its shear modulus is mu = alpha G_o / 2, and G_o only
where alpha is 2.

Every law is linear in its moduli, so only the exponents are searched: the moduli are the non-negative least-squares
solution for each trial (variable projection). A grid of exponents starts the search, so that it needs no first guess.
"""

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, nnls

from tormagd.lab.arrays import Array
from tormagd.lab.errors import LabError
from tormagd.physics.errors import FloatArray, require

Shape = Callable[[FloatArray, float], FloatArray]
"Stress of one term over its modulus, by the stretch and the exponent; unchecked."

MIN_STRETCH, MAX_STRETCH = 0.05, 20.0
MIN_EXPONENT, MAX_EXPONENT = 0.05, 30.0
MAX_TERMS = 3
_GRID = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 13.0, 19.0, 27.0)
_STARTS = 4


def thesis_shape(stretch: FloatArray, exponent: float) -> FloatArray:
    """Return Eq."""
    log = np.log(stretch)
    return 2.0 / exponent * np.exp(-0.5 * exponent * log) * np.expm1(1.5 * exponent * log)


def ogden_shape(stretch: FloatArray, exponent: float) -> FloatArray:
    """Return the engineering stress of one Ogden term over its mu."""
    return thesis_shape(stretch, exponent) / stretch


class Fit(NamedTuple):
    """A fitted law: its moduli mu, Pa, its exponents, and r2, the share of the stress's variance that it explains."""

    moduli_Pa: tuple[float, ...]
    exponents: tuple[float, ...]
    r2: float

    @property
    def shear_modulus_Pa(self) -> float:
        return sum(self.moduli_Pa)


def fit_neo_hookean(stretch: Array, stress_Pa: Array) -> Fit:
    """Fit the shear modulus of the neo-Hookean law to stretch and engineering stress, Pa (n each, 2 at least)."""
    _check(stretch, stress_Pa, 2)
    return _fitted(ogden_shape, stretch, stress_Pa, (2.0,))


def fit_ogden(stretch: Array, stress_Pa: Array, terms: int = 1) -> Fit:
    """Fit Ogden's law with up to `terms` terms, 1..3, to stretch and engineering stress, Pa (n each), in any order."""
    if not 1 <= terms <= MAX_TERMS:
        raise LabError(f"terms = {terms}: allowed is 1..{MAX_TERMS}")
    return _searched(ogden_shape, stretch, stress_Pa, terms)


def fit_thesis_ogden(stretch: Array, stress_Pa: Array) -> Fit:
    """Fit Eq."""
    return _searched(thesis_shape, stretch, stress_Pa, 1)


def _searched(shape: Shape, stretch: Array, stress_Pa: Array, terms: int) -> Fit:
    """Return the best fit of a law with up to `terms` terms, each of which has the stress `shape`, to a curve."""
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
    """Return the best moduli >= 0, Pa, for given exponents, in their order, and the residual (n)."""
    columns = np.column_stack([shape(stretch, exponent) for exponent in exponents])
    # columns and stress to unit size: the shapes differ by many orders of magnitude
    sizes, size_Pa = np.linalg.norm(columns, axis=0), float(np.linalg.norm(stress_Pa))
    scaled, _ = nnls(columns / sizes, stress_Pa / size_Pa)
    return scaled * size_Pa / sizes, columns / sizes @ scaled - stress_Pa / size_Pa


def _fitted(shape: Shape, stretch: Array, stress_Pa: Array, exponents: tuple[float, ...]) -> Fit:
    """Return the law of `shape` with these exponents and its best moduli, without terms of modulus 0."""
    moduli, residual = _moduli(shape, stretch, stress_Pa, exponents)
    if not (moduli > 0.0).any():
        raise LabError("the stress does not rise with the stretch: no positive modulus fits")
    kept = [pair for pair in zip(moduli.tolist(), exponents, strict=True) if pair[0] > 0.0]
    kept_Pa, kept_exponents = zip(*kept, strict=True)
    left = float(residual @ residual * (stress_Pa @ stress_Pa))
    return Fit(kept_Pa, kept_exponents, 1.0 - left / float(np.sum((stress_Pa - stress_Pa.mean()) ** 2)))


def _check(stretch: Array, stress_Pa: Array, least: int) -> None:
    """Refuse stretch and stress unless they are `least` pairs or more, in range and not constant."""
    if stretch.ndim != 1 or stretch.shape != stress_Pa.shape or len(stretch) < least:
        raise LabError(f"stretch {stretch.shape}, stress_Pa {stress_Pa.shape}: wanted are {least} pairs or more")
    require("stretch", stretch, MIN_STRETCH, MAX_STRETCH)
    require("stress_Pa", stress_Pa, -1e12, 1e12)
    if not (np.ptp(stretch) > 1e-6 and np.ptp(stress_Pa) > 0.0):
        raise LabError("stretch and stress must both vary over the curve")
