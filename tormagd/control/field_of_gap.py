"""The field that a gap makes in the elastomer, and the gap that makes a field."""

import math
from typing import Final, final

from tormagd.physics.errors import DomainError
from tormagd.physics.field import PowerFieldLaw, flux_density_T


@final
class FieldOfGap:
    """The flux density at the shaft's surface over the gap: Eq. 6 with a power law of the gap."""

    def __init__(self, law: PowerFieldLaw, relative_permeability: float, inner_radius_m: float) -> None:
        self._coefficient: Final = law.coefficient
        self._exponent: Final = law.exponent
        self._inverse: Final = 1.0 / law.exponent
        self._per_moment_T: Final = flux_density_T(1.0, relative_permeability, inner_radius_m)
        self._range_mm: Final = law.gap_range_mm
        nearest_mm, farthest_mm = law.gap_range_mm
        self._strongest_mT: Final = self.field_mT(nearest_mm)
        self._weakest_mT: Final = self.field_mT(farthest_mm)

    def field_mT(self, gap_mm: float) -> float:
        if not self._range_mm[0] <= gap_mm <= self._range_mm[1]:
            raise DomainError("gap_mm", gap_mm, f"a number from {self._range_mm[0]:g} to {self._range_mm[1]:g}")
        return 1e3 * (self._coefficient * math.pow(gap_mm, self._exponent) * self._per_moment_T)

    def gap_mm(self, field_mT: float) -> float:
        """Return the gap that gives `field_mT`; it may lie outside the scene's range."""
        if not self._weakest_mT <= field_mT <= self._strongest_mT:
            raise DomainError(
                "field_mT", field_mT, f"a number from {self._weakest_mT:g} to {self._strongest_mT:g}, which gaps give"
            )
        return math.pow(1e-3 * field_mT / self._per_moment_T / self._coefficient, self._inverse)
