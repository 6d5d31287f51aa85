"""The magnetoelastic constitutive model of the elastomer: kinematics, invariants, energy and stress (thesis Eq. 9..27).

The deformation is F = diag(lambda_1, lambda_2, lambda_3) in the cylinder's radial, circumferential and axial directions
and keeps the volume. The field b is the thesis's a / R e_R with an axial part: Eq. 19..21 contract it with C = F^T F,
so there it is the field per area of the *undeformed* elastomer (Lagrangian).

Two readings are needed to make the printed equations agree with each other, and the tests hold them against the energy
by automatic differentiation:

- Eq. 25 is called the nominal stress, but with Lambda = F F^T it is the derivative of the energy only if it is the
  *true* (Cauchy) stress, force per deformed area. `nominal_stress_Pa` is that stress per undeformed area.
- The b of its Maxwell term is then the field in the deformed elastomer, F b, not the b of Eq. 19..21.

All functions take floats or arrays that broadcast together, in SI units, compute in float64, and raise `DomainError`
for NaN and for values outside the stated ranges. Tensors stand in the last two axes, in the order radial,
circumferential, axial.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from tormagd.lab.arrays import Array
from tormagd.physics.errors import DomainError, require
from tormagd.physics.force import MU0_H_M

Scalars: TypeAlias = float | Array

MIN_STRETCH, MAX_STRETCH = 0.05, 20.0
MAX_FIELD_T = 10.0
MAX_PRESSURE_PA = 1e15


class Stretches(NamedTuple):
    """Principal stretches of an incompressible cylinder (Eq. 10..14); made by `stretches`."""

    radial: Array
    circumferential: Array
    axial: Array

    @property
    def deformation_gradient(self) -> Array:
        """F, shape (..., 3, 3) (Eq. 13)."""
        return _diagonal(*self)

    @property
    def right_cauchy_green(self) -> Array:
        """C = F^T F, shape (..., 3, 3) (Eq. 15)."""
        return _diagonal(*(stretch**2 for stretch in self))


class Field(NamedTuple):
    """Flux density per undeformed area, T: radial b = a / R (Eq. 6) and axial b_Z; made by `field`."""

    radial_T: Array
    axial_T: Array


class Invariants(NamedTuple):
    """I1..I3 of C (Eq. 16..18), and I4..I6 of C and b, T^2 (Eq. 19..21)."""

    i1: Array
    i2: Array
    i3: Array
    i4_T2: Array
    i5_T2: Array
    i6_T2: Array


@dataclass(frozen=True, slots=True)
class MooneyRivlin:
    """Constants C10 and C01 (Pa) of Eq. 24 and the relative permeability mu_r.

    Raises `DomainError` unless both constants are from 0 to 1 GPa, their sum at least 0.5 Pa, and 1 <= mu_r <= 1000.
    """

    c10_Pa: float
    c01_Pa: float
    relative_permeability: float

    def __post_init__(self) -> None:
        require("c10_Pa", self.c10_Pa, 0.0, 1e9)
        require("c01_Pa", self.c01_Pa, 0.0, 1e9)
        require("relative_permeability", self.relative_permeability, 1.0, 1e3)
        if not self.c10_Pa + self.c01_Pa >= 0.5:
            raise DomainError("c10_Pa + c01_Pa", self.c10_Pa + self.c01_Pa, "at least 0.5 Pa")

    @property
    def shear_modulus_Pa(self) -> float:
        """Initial shear modulus without field, G0 = 2 (C10 + C01)."""
        return 2.0 * (self.c10_Pa + self.c01_Pa)

    @property
    def permeability_H_m(self) -> float:
        """Absolute permeability mu0 mu_r."""
        return MU0_H_M * self.relative_permeability


def stretches(radial: Scalars, circumferential: Scalars) -> Stretches:
    """Stretches with that radial and circumferential part; incompressibility gives the axial one (Eq. 14).

    Raises `DomainError` unless all three are within 0.05..20.
    """
    lambda_1, lambda_2 = _checked("radial", radial), _checked("circumferential", circumferential)
    for name, value in (("radial", lambda_1), ("circumferential", lambda_2)):
        require(name, value, MIN_STRETCH, MAX_STRETCH)
    lambda_3 = 1.0 / (lambda_1 * lambda_2)
    require("axial", lambda_3, MIN_STRETCH, MAX_STRETCH)
    return Stretches(*np.broadcast_arrays(lambda_1, lambda_2, lambda_3))


def field(radial_T: Scalars, axial_T: Scalars = 0.0) -> Field:
    """Field with those parts; `DomainError` unless both are within -10..10 T."""
    parts = {"radial_T": _checked("radial_T", radial_T), "axial_T": _checked("axial_T", axial_T)}
    for name, value in parts.items():
        require(name, value, -MAX_FIELD_T, MAX_FIELD_T)
    return Field(*np.broadcast_arrays(*parts.values()))


def invariants(stretch: Stretches, b: Field) -> Invariants:
    """The six invariants, each from its definition on the principal axes."""
    squares = [part**2 for part in stretch]
    i1 = squares[0] + squares[1] + squares[2]
    i2 = squares[0] * squares[1] + squares[1] * squares[2] + squares[2] * squares[0]
    i3 = squares[0] * squares[1] * squares[2]
    radial, axial = b.radial_T**2, b.axial_T**2
    return Invariants(
        i1,
        i2,
        i3,
        radial + axial,
        radial * squares[0] + axial * squares[2],
        radial * squares[0] ** 2 + axial * squares[2] ** 2,
    )


def strain_energy_J_m3(stretch: Stretches, material: MooneyRivlin) -> Array:
    """Elastic energy Omega per volume, J/m^3, >= 0 (Eq. 24); without loss of digits at small strain.

    With abc = 1, a^3 + b^3 + c^3 - 3 = (a + b + c) ((a - b)^2 + (b - c)^2 + (c - a)^2) / 2. For a = lambda_1^(2/3) and
    so on this is I1 - 3, and for the inverses I2 - 3: sums of squares in place of a difference of nearly equal numbers.
    """
    logs = _logarithms(stretch)
    energy: Array = material.c10_Pa * _excess(*logs) + material.c01_Pa * _excess(*(-log for log in logs))
    return energy


def magnetic_energy_J_m3(stretch: Stretches, b: Field, material: MooneyRivlin) -> Array:
    """Magnetic energy Psi per volume, J/m^3, >= 0 (Eq. 23)."""
    energy: Array = 0.5 * invariants(stretch, b).i5_T2 / material.permeability_H_m
    return energy


def total_energy_J_m3(stretch: Stretches, b: Field, material: MooneyRivlin) -> Array:
    """Omega* = Omega + Psi, J/m^3 (Eq. 22)."""
    return strain_energy_J_m3(stretch, material) + magnetic_energy_J_m3(stretch, b, material)


def cauchy_stress_Pa(stretch: Stretches, b: Field, material: MooneyRivlin, pressure_Pa: Scalars) -> Array:
    """True stress T, Pa, shape (..., 3, 3) (Eq. 25 and 27); tension is positive.

    `pressure_Pa` is the multiplier p of the incompressibility, which only the boundary settles: see
    `pressure_for_free_ends_Pa`. Without strain and field, p = 2 C10 + 4 C01 makes the stress zero.
    """
    pressure = _checked("pressure_Pa", pressure_Pa)
    require("pressure_Pa", pressure, -MAX_PRESSURE_PA, MAX_PRESSURE_PA)
    elastic = _elastic_parts(stretch, material)
    tensor = _diagonal(*(part - pressure for part in elastic))
    flux = _deformed_flux_T(stretch, b)
    total: Array = tensor + flux[..., :, None] * flux[..., None, :] / material.permeability_H_m
    return total


def nominal_stress_Pa(stretch: Stretches, b: Field, material: MooneyRivlin, pressure_Pa: Scalars) -> Array:
    """Force per *undeformed* area, Pa, shape (..., 3, 3): P = T F^-T, d Omega* / dF less p F^-T."""
    per_area = np.stack([1.0 / part for part in stretch], axis=-1)
    nominal: Array = cauchy_stress_Pa(stretch, b, material, pressure_Pa) * per_area[..., None, :]
    return nominal


def pressure_for_free_ends_Pa(stretch: Stretches, b: Field, material: MooneyRivlin) -> Array:
    """The multiplier p, Pa, that leaves the end faces without axial stress, T_zz = 0."""
    flux = _deformed_flux_T(stretch, b)
    pressure: Array = _elastic_parts(stretch, material)[2] + flux[..., 2] ** 2 / material.permeability_H_m
    return pressure


def _elastic_parts(stretch: Stretches, material: MooneyRivlin) -> list[Array]:
    """Diagonal of 2 C10 L + 2 C01 (I1 L - L^2), Pa; I1 - lambda_i^2 is the sum of the two other squares."""
    first, second, third = (part**2 for part in stretch)
    others = (second + third, third + first, first + second)
    return [
        2.0 * square * (material.c10_Pa + material.c01_Pa * other)
        for square, other in zip((first, second, third), others, strict=True)
    ]


def _deformed_flux_T(stretch: Stretches, b: Field) -> Array:
    """F b, T, shape (..., 3): the field per deformed area."""
    radial, axial = np.broadcast_arrays(stretch.radial * b.radial_T, stretch.axial * b.axial_T)
    return np.stack((radial, np.zeros_like(radial), axial), axis=-1)


def _logarithms(stretch: Stretches) -> tuple[Array, Array, Array]:
    """Logarithmic strains; their sum is zero by construction, not by rounding."""
    radial, circumferential = np.log(stretch.radial), np.log(stretch.circumferential)
    return radial, circumferential, -(radial + circumferential)


def _excess(first: Array, second: Array, third: Array) -> Array:
    """e^(2 first) + e^(2 second) + e^(2 third) - 3 for exponents whose sum is zero, as a sum of squares."""
    roots = [np.exp(2.0 / 3.0 * part) for part in (first, second, third)]
    squares = sum(
        (lower * np.expm1(2.0 / 3.0 * (upper_log - lower_log))) ** 2
        for lower, lower_log, upper_log in zip(roots, (first, second, third), (second, third, first), strict=True)
    )
    excess: Array = 0.5 * (roots[0] + roots[1] + roots[2]) * squares
    return excess


def _diagonal(*parts: Array) -> Array:
    row = np.stack(np.broadcast_arrays(*parts), axis=-1)
    return np.asarray(row[..., None] * np.eye(3))


def _checked(name: str, value: Scalars) -> Array:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DomainError(name, value, "a number, or an array of numbers") from error
