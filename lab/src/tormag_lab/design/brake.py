"""A brake as a designer sees it: force over gap between two end positions, its slope and its inverse."""

from dataclasses import dataclass

from scipy.optimize import brentq

from tormag_lab.design.force_law import d_force_d_gap
from tormagd.element.physics.errors import Real, require, require_that
from tormagd.element.physics.field import FieldLaw, PowerFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, Geometry, brake_force_N, max_radial_moment_Tm

CLOSED_MM, OPEN_MM = 45.0, 95.0
"End positions of the thesis's device."


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
