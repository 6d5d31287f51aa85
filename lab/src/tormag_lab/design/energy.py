"""The elastomer's energy density at the shaft (Eq. 16..18, 20, 22..24), J/m^3.

The shaft is rigid: the hoop stretch is 1 there and the axial one 1 / lambda1. So I1 = I2, and the strain energy asks
for G0 = 2 (C10 + C01) alone. The field is radial.
"""

from typing import NamedTuple

from tormagd.element.physics.force import MU0_H_M, Elastomer


class Invariants(NamedTuple):
    first: float
    second: float
    third: float


class Energy(NamedTuple):
    strain_J_m3: float
    magnetic_J_m3: float


def invariants(radial: float, hoop: float, axial: float) -> Invariants:
    """Return I1, I2, I3 of the right Cauchy-Green tensor for the principal stretches (Eq. 16..18)."""
    squares = radial**2, hoop**2, axial**2
    trace = sum(squares)
    second = (trace**2 - sum(each**2 for each in squares)) / 2.0
    return Invariants(trace, second, squares[0] * squares[1] * squares[2])


def energy_at_shaft(radial: float, field_T: float, elastomer: Elastomer) -> Energy:
    """Return both parts of Eq. 22 for the radial stretch and the radial field there."""
    strain = elastomer.shear_modulus_Pa / 2.0 * (invariants(radial, 1.0, 1.0 / radial).first - 3.0)
    return Energy(strain, (field_T * radial) ** 2 / (2.0 * MU0_H_M * elastomer.relative_permeability))
