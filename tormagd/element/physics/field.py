"""Field laws: the radial moment of the magnets' field over their gap.

The field in the elastomer is taken as radial, b = (mu_r / 4) a / R (thesis Eq. 6 and 8). The *radial moment* a, in T m,
carries the dependence on the gap and serves every insert. With b independent of mu_r, as Eq. 6 literally says, weakly
filled inserts would be the strongest; table 2.4 shows the opposite.
"""

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from tormagd.element.physics.errors import Real, require

REFERENCE_PERMEABILITY = 4.0

PAD_RADIUS_M = 8.55e-3
"a / R at this radius is the mean field in a tactile pad between the magnets."

_TM_PER_MT_MM = 1e-6
_EQ7_C1, _EQ7_C2, _EQ7_P = 1.206, 1256.0, 1.867
_EQ7_MIN_MM, _EQ7_MAX_MM = 45.0, 95.0


@dataclass(frozen=True, slots=True)
class ThesisFieldLaw:
    """Eq. 7 of the thesis: a = c1 (95 - gap)^p + c2, in mT mm."""

    gap_range_mm: ClassVar[tuple[float, float]] = (_EQ7_MIN_MM, _EQ7_MAX_MM)

    def radial_moment_Tm(self, gap_mm: Real) -> Real:
        require("gap_mm", gap_mm, *self.gap_range_mm)
        return _TM_PER_MT_MM * (_EQ7_C1 * _power(_EQ7_MAX_MM - gap_mm, _EQ7_P) + _EQ7_C2)

    def gap_mm(self, radial_moment_Tm: Real) -> Real:
        _require_moment(radial_moment_Tm, self)
        # the weakest moment, times 1e6, may round to just under c2
        excess = abs(radial_moment_Tm / _TM_PER_MT_MM - _EQ7_C2)
        return _EQ7_MAX_MM - _power(excess / _EQ7_C1, 1.0 / _EQ7_P)

    def d_radial_moment_d_gap(self, gap_mm: Real) -> Real:
        require("gap_mm", gap_mm, *self.gap_range_mm)
        return -_TM_PER_MT_MM * _EQ7_C1 * _EQ7_P * _power(_EQ7_MAX_MM - gap_mm, _EQ7_P - 1.0)


@dataclass(frozen=True, slots=True)
class PowerFieldLaw:
    """The thesis's appendix: a = coefficient * gap^exponent, in T m with the gap in mm."""

    gap_range_mm: ClassVar[tuple[float, float]] = (1.0, 1e4)
    coefficient: float = 0.44
    exponent: float = -1.3

    def __post_init__(self) -> None:
        require("coefficient", self.coefficient, 1e-6, 1e3)
        require("exponent", self.exponent, -6.0, -0.1)

    def radial_moment_Tm(self, gap_mm: Real) -> Real:
        require("gap_mm", gap_mm, *self.gap_range_mm)
        return self.coefficient * _power(gap_mm, self.exponent)

    def gap_mm(self, radial_moment_Tm: Real) -> Real:
        _require_moment(radial_moment_Tm, self)
        return _power(radial_moment_Tm / self.coefficient, 1.0 / self.exponent)

    def d_radial_moment_d_gap(self, gap_mm: Real) -> Real:
        require("gap_mm", gap_mm, *self.gap_range_mm)
        return self.coefficient * self.exponent * _power(gap_mm, self.exponent - 1.0)


FieldLaw: TypeAlias = ThesisFieldLaw | PowerFieldLaw


def flux_density_T(radial_moment_Tm: Real, relative_permeability: float, radius_m: float) -> Real:
    """Return b in the elastomer (Eq. 6 with the permeability of Eq. 8)."""
    require("radial_moment_Tm", radial_moment_Tm, 0.0, 1e6)
    require("relative_permeability", relative_permeability, 1.0, 1e3)
    require("radius_m", radius_m, 1e-5, 1.0)
    return radial_moment_Tm * (relative_permeability / (REFERENCE_PERMEABILITY * radius_m))


def _require_moment(radial_moment_Tm: Real, law: FieldLaw) -> None:
    nearest_mm, farthest_mm = law.gap_range_mm
    weakest_Tm, strongest_Tm = law.radial_moment_Tm(farthest_mm), law.radial_moment_Tm(nearest_mm)
    require("radial_moment_Tm", radial_moment_Tm, weakest_Tm, strongest_Tm)


def _power(base: Real, exponent: float) -> Real:
    power: Real = base**exponent
    return power
