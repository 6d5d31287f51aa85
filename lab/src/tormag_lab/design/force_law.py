"""The force law's stretch and slopes, of floats or arrays, and the elastomer's energy density at the shaft (Eq. 16..18,
20, 22..24), J/m^3.

The shaft is rigid: the hoop stretch is 1 there and the axial one 1 / lambda1. So I1 = I2, and the strain energy asks
for G0 = 2 (C10 + C01) alone. The field is radial.
"""

from typing import NamedTuple

from tormagd.element.physics.brake_curve import BrakeCurve
from tormagd.element.physics.errors import Real, require
from tormagd.element.physics.field import FieldLaw
from tormagd.element.physics.force import MU0_H_M, Elastomer, Geometry, reduced


def stretch_minus_one(radial_moment_Tm: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return lambda1 - 1 at the shaft (Eq. 29), from -0.95 to 0."""
    law = reduced(elastomer, geometry)
    require("radial_moment_Tm", radial_moment_Tm, 0.0, law.max_moment_Tm)
    return -law.curve.compression(law.load(radial_moment_Tm))


def d_force_d_moment(radial_moment_Tm: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the slope of the brake force over the radial moment, N / (T m)."""
    law = reduced(elastomer, geometry)
    require("radial_moment_Tm", radial_moment_Tm, 0.0, law.max_moment_Tm)
    load = law.load(radial_moment_Tm)
    slope = force_slope(law.curve, law.curve.compression(load), load)
    return 2.0 * law.force_scale_N * law.load_root_per_Tm**2 * radial_moment_Tm * slope


def d_force_d_gap(gap_mm: Real, field: FieldLaw, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the slope of the force over the gap, N/mm, <= 0 (the bracket of Eq. 36)."""
    return d_force_d_moment(field.radial_moment_Tm(gap_mm), elastomer, geometry) * field.d_radial_moment_d_gap(gap_mm)


def force_slope(curve: BrakeCurve, compression: Real, load: Real) -> Real:
    """Return d phi / d y, the slope of the reduced force phi over the load y."""
    stretch, w = 1.0 - compression, curve.wall
    # d phi / d eps at constant load, then d phi / d y at constant stretch
    elastic, magnetic = 5.0 / stretch**6 - 1.0 / stretch**2, 12.0 * (1.0 + w) * load / stretch**4
    return (elastic + magnetic) * _compression_slope(curve, compression, load) + 4.0 * (1.0 + w) / stretch**3


def _compression_slope(curve: BrakeCurve, compression: Real, load: Real) -> Real:
    return (curve.b + curve.a * compression) / (1.0 - curve.a * load + compression)


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
