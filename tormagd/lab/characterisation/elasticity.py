"""Fits of the uniaxial laws to a stress-stretch curve by least squares of the engineering stress.

Every law is linear in its moduli, so only the exponents are searched: the moduli are the non-negative least-squares
solution for each trial (variable projection). A grid of exponents starts the search, so that it needs no first guess.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Generic, TypeVar

import numpy as np
from scipy.optimize import least_squares, nnls

from tormagd.lab.arrays import Array
from tormagd.lab.characterisation.hyperelastic import (
    MAX_EXPONENT,
    MAX_STRETCH,
    MIN_STRETCH,
    Ogden,
    ThesisOgden,
    ogden_shape,
    thesis_shape,
)
from tormagd.lab.errors import LabError
from tormagd.physics.errors import FloatArray, require

Law = TypeVar("Law", Ogden, ThesisOgden)
Shape = Callable[[FloatArray, float], FloatArray]

MAX_TERMS = 3
LEAST_EXPONENT = 0.05
_GRID = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 13.0, 19.0, 27.0)
_STARTS = 4


@dataclass(frozen=True, slots=True)
class Fit(Generic[Law]):
    """A fitted law with r2, the share of the stress's variance that it explains, and the RMS of what it leaves, Pa."""

    law: Law
    r2: float
    rms_Pa: float


def fit_neo_hookean(stretch: Array, stress_Pa: Array) -> Fit[Ogden]:
    """The shear modulus that fits best. Raises `LabError` for a curve no positive modulus fits."""
    _check(stretch, stress_Pa, 2)
    moduli, _ = _moduli(ogden_shape, stretch, stress_Pa, (2.0,))
    return _fit(Ogden(_positive(moduli), (2.0,)), stretch, stress_Pa)


def fit_ogden(stretch: Array, stress_Pa: Array, terms: int = 1) -> Fit[Ogden]:
    """Ogden's law with up to `terms` terms, 1..3, of positive exponents; one whose best modulus is zero is dropped.

    Negative exponents are left out, because one direction of loading cannot tell them from positive ones: under tension
    alpha = -2 (alpha' - 1) grows like alpha', but the two differ widely under compression.

    Raises `LabError` for a curve of fewer than 2 points a term and one more, for stretches outside 0.05..20, and for
    one that no positive modulus fits (stress of the wrong sign).
    """
    if not 1 <= terms <= MAX_TERMS:
        raise LabError(f"terms = {terms}: allowed is 1..{MAX_TERMS}")
    _check(stretch, stress_Pa, 2 * terms + 1)
    moduli, exponents = _search(ogden_shape, stretch, stress_Pa, terms)
    kept = [(modulus, exponent) for modulus, exponent in zip(moduli, exponents, strict=True) if modulus > 0.0]
    return _fit(Ogden(tuple(pair[0] for pair in kept), tuple(pair[1] for pair in kept)), stretch, stress_Pa)


def fit_thesis_ogden(stretch: Array, stress_Pa: Array) -> Fit[ThesisOgden]:
    """Eq. 3 of the thesis as printed, with alpha > 0. Raises `LabError` like `fit_ogden`."""
    _check(stretch, stress_Pa, 3)
    moduli, exponents = _search(thesis_shape, stretch, stress_Pa, 1)
    return _fit(ThesisOgden(moduli[0], exponents[0]), stretch, stress_Pa)


def _search(shape: Shape, stretch: Array, stress_Pa: Array, terms: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(moduli, exponents) of the best fit, from the best few points of a grid."""
    ranked = sorted(
        ((_moduli(shape, stretch, stress_Pa, start)[1], start) for start in combinations(_GRID, terms)),
        key=lambda pair: pair[0],
    )
    best_norm, best = ranked[0]
    for _, start in ranked[:_STARTS]:
        found = least_squares(
            lambda log: _residual(shape, stretch, stress_Pa, tuple(np.exp(log).tolist())),
            np.log(start),
            bounds=(np.log(LEAST_EXPONENT), np.log(MAX_EXPONENT)),
            x_scale=0.3,
            xtol=1e-12,
            ftol=1e-14,
        )
        exponents = tuple(np.exp(found.x).tolist())
        norm = _moduli(shape, stretch, stress_Pa, exponents)[1]
        if norm < best_norm:
            best_norm, best = norm, exponents
    return _positive(_moduli(shape, stretch, stress_Pa, best)[0]), best


def _moduli(shape: Shape, stretch: Array, stress_Pa: Array, exponents: tuple[float, ...]) -> tuple[Array, float]:
    """Best moduli >= 0 for given exponents, and the norm of the residual over that of the stress."""
    columns = np.column_stack([shape(stretch, exponent) for exponent in exponents])
    # columns and stress to unit size: the shapes differ by many orders of magnitude
    sizes, size_Pa = np.linalg.norm(columns, axis=0), float(np.linalg.norm(stress_Pa))
    scaled, norm = nnls(columns / sizes, stress_Pa / size_Pa)
    return scaled * size_Pa / sizes, float(norm)


def _residual(shape: Shape, stretch: Array, stress_Pa: Array, exponents: tuple[float, ...]) -> Array:
    moduli, _ = _moduli(shape, stretch, stress_Pa, exponents)
    model = sum(modulus * shape(stretch, exponent) for modulus, exponent in zip(moduli, exponents, strict=True))
    difference: Array = (model - stress_Pa) / float(np.linalg.norm(stress_Pa))
    return difference


def _positive(moduli: Array) -> tuple[float, ...]:
    if not (moduli > 0.0).any():
        raise LabError("the stress does not rise with the stretch: no positive modulus fits")
    return tuple(moduli.tolist())


def _fit(law: Law, stretch: Array, stress_Pa: Array) -> Fit[Law]:
    residual = stress_Pa - law.stress_Pa(stretch)
    left, whole = float(np.sum(residual**2)), float(np.sum((stress_Pa - stress_Pa.mean()) ** 2))
    return Fit(law, 1.0 - left / whole, float(np.sqrt(left / len(stress_Pa))))


def _check(stretch: Array, stress_Pa: Array, least: int) -> None:
    if stretch.ndim != 1 or stretch.shape != stress_Pa.shape or len(stretch) < least:
        raise LabError(f"stretch {stretch.shape}, stress_Pa {stress_Pa.shape}: wanted are {least} pairs or more")
    require("stretch", stretch, MIN_STRETCH, MAX_STRETCH)
    require("stress_Pa", stress_Pa, -1e12, 1e12)
    if not (np.ptp(stretch) > 1e-6 and np.ptp(stress_Pa) > 0.0):
        raise LabError("stretch and stress must both vary over the curve")
