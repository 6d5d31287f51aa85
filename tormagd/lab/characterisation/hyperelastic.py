"""Uniaxial stress of incompressible rubber: what a compression or tension test is compared with.

The *engineering stress* is force over undeformed area; tension, and stretches above one, are positive.

    Ogden        sigma = sum 2 mu_i / alpha_i (lambda^(alpha_i - 1) - lambda^(-alpha_i / 2 - 1))
    neo-Hookean  sigma = G (lambda - lambda^-2), which is Ogden's with alpha = 2
    thesis       sigma = G_o (lambda^alpha - lambda^(-alpha / 2))                                      (Eq. 3)

The thesis calls Eq. 3 an Ogden law for the engineering stress of Eq. 1, and G_o the shear modulus. It is one up to
two factors: lambda times Ogden's stress is the *true* stress, and G_o stands for 2 mu / alpha. Any incompressible law
starts with the slope 3 G; that of Eq. 3 is 3 alpha G_o / 2. So its shear modulus is alpha G_o / 2, and G_o only where
alpha is 2.

All stresses are written with expm1, so that they lose no digits towards lambda = 1. They take a float, or an array of
float32 or float64 whose type the result keeps.
"""

from dataclasses import dataclass

import numpy as np

from tormagd.physics.errors import DomainError, Real, require

MIN_STRETCH, MAX_STRETCH = 0.05, 20.0
MIN_EXPONENT, MAX_EXPONENT = 1e-3, 30.0
LEAST_MODULUS_PA = 1e-30


@dataclass(frozen=True, slots=True)
class Ogden:
    """Ogden's law with one term or more: moduli mu_i > 0 (Pa) and exponents alpha_i.

    Raises `DomainError` unless there is one exponent for each modulus, the moduli are above 0 up to 1 TPa (one of a
    stiffening term is often minute) and the exponents 1e-3..30 in size, of either sign.
    """

    moduli_Pa: tuple[float, ...]
    exponents: tuple[float, ...]

    def __post_init__(self) -> None:
        if not 0 < len(self.moduli_Pa) == len(self.exponents):
            raise DomainError("exponents", self.exponents, f"one exponent for each modulus of {self.moduli_Pa}")
        for modulus_Pa, exponent in zip(self.moduli_Pa, self.exponents, strict=True):
            require("moduli_Pa", modulus_Pa, LEAST_MODULUS_PA, 1e12)
            require("size of exponents", abs(exponent), MIN_EXPONENT, MAX_EXPONENT)

    @property
    def shear_modulus_Pa(self) -> float:
        """Initial shear modulus, the sum of the mu_i."""
        return sum(self.moduli_Pa)

    def stress_Pa(self, stretch: Real) -> Real:
        """Engineering stress, Pa, at a stretch of 0.05..20; strictly rising."""
        require("stretch", stretch, MIN_STRETCH, MAX_STRETCH)
        stress = 0.0 * stretch
        for modulus_Pa, exponent in zip(self.moduli_Pa, self.exponents, strict=True):
            stress = stress + modulus_Pa * ogden_shape(stretch, exponent)
        return stress


@dataclass(frozen=True, slots=True)
class ThesisOgden:
    """Eq. 3 as printed: its constant G_o (Pa) and exponent alpha > 0; `DomainError` outside the bounds of `Ogden`."""

    constant_Pa: float
    exponent: float

    def __post_init__(self) -> None:
        require("constant_Pa", self.constant_Pa, 1e-3, 1e12)
        require("exponent", self.exponent, MIN_EXPONENT, MAX_EXPONENT)

    @property
    def shear_modulus_Pa(self) -> float:
        """Initial shear modulus, a third of the slope at lambda = 1: alpha G_o / 2."""
        return 0.5 * self.exponent * self.constant_Pa

    def stress_Pa(self, stretch: Real) -> Real:
        """The stress of Eq. 3, Pa, at a stretch of 0.05..20."""
        require("stretch", stretch, MIN_STRETCH, MAX_STRETCH)
        return self.constant_Pa * thesis_shape(stretch, self.exponent)


def ogden_shape(stretch: Real, exponent: float) -> Real:
    """Engineering stress of one Ogden term over its mu; unchecked."""
    return 2.0 / exponent * thesis_shape(stretch, exponent) / stretch


def thesis_shape(stretch: Real, exponent: float) -> Real:
    """lambda^alpha - lambda^(-alpha / 2), Eq. 3 over its G_o; unchecked."""
    log = np.log(stretch)
    # the power and the difference apart: at lambda = 1 the first is 1 and the second has all its digits
    shape = np.exp(-0.5 * exponent * log) * np.expm1(1.5 * exponent * log)
    return float(shape) if isinstance(stretch, float | int) else shape
