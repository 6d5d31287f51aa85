"""Stress in the elastomer by the thesis's magnetoelastic model (Eq. 25 and 27), in SI units, for the errata.

The deformation is F = diag(lambda_1, lambda_2, lambda_3) in the cylinder's radial, circumferential and axial directions
and keeps the volume. The field b is the thesis's a / R e_R with an axial part, per area of the *undeformed* elastomer.

The printed equations agree with each other only in two readings, which the tests confirm by differentiating the energy.
What Eq. 25 calls the nominal stress is the *true* (Cauchy) stress, force per deformed area. The b of its Maxwell term
is the field in the deformed elastomer, F b.
"""

from typing import NamedTuple

import numpy as np

from tormag_lab.arrays import Array
from tormagd.element.physics.force import MU0_H_M


class MooneyRivlin(NamedTuple):
    """Constants C10 and C01 (Pa) of Eq. 24 and the relative permeability mu_r."""

    c10_Pa: float
    c01_Pa: float
    relative_permeability: float


def stretches(radial: float, circumferential: float) -> Array:
    """Return the principal stretches (3) of an incompressible elastomer (Eq. 14)."""
    return np.array([radial, circumferential, 1.0 / (radial * circumferential)])


def cauchy_stress_Pa(stretch: Array, b_T: Array, material: MooneyRivlin, pressure_Pa: float) -> Array:
    """Return the true stress (3 x 3) at a stretch (3) and a field (3) (Eq. 25 and 27); tension is positive."""
    square, flux_T = stretch**2, stretch * b_T
    # I1 - lambda_i^2 is the sum of the two other squares
    elastic = 2.0 * square * (material.c10_Pa + material.c01_Pa * (np.roll(square, 1) + np.roll(square, 2)))
    maxwell = np.outer(flux_T, flux_T) / (MU0_H_M * material.relative_permeability)
    return np.diag(elastic - pressure_Pa) + maxwell


def nominal_stress_Pa(stretch: Array, b_T: Array, material: MooneyRivlin, pressure_Pa: float) -> Array:
    """Return the force per *undeformed* area (3 x 3), P = T F^-T."""
    return cauchy_stress_Pa(stretch, b_T, material, pressure_Pa) / stretch


def pressure_for_free_ends_Pa(stretch: Array, b_T: Array, material: MooneyRivlin) -> float:
    """Return the multiplier p that leaves the end faces without axial stress."""
    return float(cauchy_stress_Pa(stretch, b_T, material, 0.0)[2, 2])
