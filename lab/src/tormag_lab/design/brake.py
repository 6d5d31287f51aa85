"""A brake as a designer sees it: force over gap between two end positions, its slope and its inverse.

Under it stand the force law's stretch and slopes, of floats or arrays, and the elastomer's energy density at the shaft
(Eq. 16..18, 20, 22..24), J/m^3. The shaft is rigid: the hoop stretch is 1 there and the axial one 1 / lambda1. So
I1 = I2, and the strain energy asks for G0 = 2 (C10 + C01) alone. The field is radial.
"""

from dataclasses import dataclass

from scipy.optimize import brentq

from tormagd.element.physics.brake_curve import BrakeCurve
from tormagd.element.physics.errors import Real, require, require_that
from tormagd.element.physics.field import FieldLaw, PowerFieldLaw
from tormagd.element.physics.force import (
    MU0_H_M,
    TORMAG,
    Elastomer,
    Geometry,
    brake_force_N,
    max_radial_moment_Tm,
    reduced,
)

CLOSED_MM, OPEN_MM = 45.0, 95.0
"End positions of the thesis's device."


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
    compression_slope = (curve.b + curve.a * compression) / (1.0 - curve.a * load + compression)
    return (elastic + magnetic) * compression_slope + 4.0 * (1.0 + w) / stretch**3


def energy_at_shaft(radial: float, field_T: float, elastomer: Elastomer) -> dict[str, float]:
    """Return both parts of Eq. 22, J/m^3, for the radial stretch and the radial field there."""
    first_invariant = radial**2 + 1.0 + radial**-2
    strain = elastomer.shear_modulus_Pa / 2.0 * (first_invariant - 3.0)
    magnetic = (field_T * radial) ** 2 / (2.0 * MU0_H_M * elastomer.relative_permeability)
    return {"strain_J_m3": strain, "magnetic_J_m3": magnetic}


@dataclass(frozen=True, slots=True)
class Brake:
    """An elastomer in a geometry between magnets whose gap goes from `closed_mm` to `open_mm`."""

    field: FieldLaw
    elastomer: Elastomer
    geometry: Geometry
    closed_mm: float
    open_mm: float

    def __post_init__(self) -> None:
        for name in ("closed_mm", "open_mm"):
            require(name, getattr(self, name), *self.field.gap_range_mm)
        require_that(self.closed_mm < self.open_mm, "open_mm", self.open_mm, f"above closed_mm, {self.closed_mm:g}")
        strongest_Tm = max_radial_moment_Tm(self.elastomer, self.geometry)
        require("radial_moment_Tm", self.field.radial_moment_Tm(self.closed_mm), 0.0, strongest_Tm)

    @classmethod
    def as_built(cls, elastomer: Elastomer, field: FieldLaw | None = None) -> "Brake":
        return cls(field or PowerFieldLaw(), elastomer, TORMAG, CLOSED_MM, OPEN_MM)

    @property
    def range_N(self) -> float:
        return self.most_N - self.least_N

    @property
    def least_N(self) -> float:
        return self.force_N(self.open_mm)

    @property
    def most_N(self) -> float:
        return self.force_N(self.closed_mm)

    def force_N(self, gap_mm: Real) -> Real:
        return brake_force_N(self.field.radial_moment_Tm(gap_mm), self.elastomer, self.geometry)

    def slope_N_mm(self, gap_mm: Real) -> Real:
        """Return |dF/dgap|, the bracket of Eq. 36."""
        return abs(d_force_d_gap(gap_mm, self.field, self.elastomer, self.geometry))

    def gap_mm(self, force_N: float) -> float:
        """Return the gap that gives the force: the inverse of `force_N`."""
        require("force_N", force_N, self.least_N, self.most_N)
        found: float = brentq(lambda gap_mm: self.force_N(gap_mm) - force_N, self.closed_mm, self.open_mm, xtol=1e-10)
        return found
