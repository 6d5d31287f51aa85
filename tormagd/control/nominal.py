"""The nominal device: the field of a gap, and the model's force over the field for the handle's motion."""

import math
from typing import Final, final

from tormagd.control.contact import ElementContact
from tormagd.control.records import Measured, Outside, TimedSetpoint
from tormagd.element.model.features import FEATURES
from tormagd.element.model.force_curve import ForceCurve, within
from tormagd.element.model.model_file import ForceModel
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import PowerFieldLaw, flux_density_T


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


@final
class Nominal:
    def __init__(self, model: ForceModel, contact: ElementContact, cip_percent: float, has_rate: bool) -> None:
        self._network: Final = model.network
        self.contact: Final = contact
        self._cip_percent: Final = cip_percent
        self._has_rate: Final = has_rate
        known_mm = model.feature_ranges[0]
        # a handle is planned for with friction mobilised: before that the hand sets the force, whatever the field
        mobilised_mm = within(contact.displacement_mm, known_mm)
        self._displacements_mm: Final = (mobilised_mm, mobilised_mm) if contact.slides else known_mm
        self._rates_mm_s: Final = model.feature_ranges[1]
        self.fields_mT: Final = model.feature_ranges[2]
        self.only: Final[ForceCurve] = self.curve(contact.displacement_mm, contact.rate_mm_s)

    def now(self, measured: Measured) -> ForceCurve:
        if not self._has_rate:
            return self.only
        displacement_mm, rate_mm_s = self.contact.motion_now(measured)
        return self.curve(displacement_mm, rate_mm_s)

    def planned(
        self, setpoint: TimedSetpoint | None, measured: Measured | None
    ) -> tuple[ForceCurve, tuple[Outside, ...]]:
        """Return the force over the field for the motion to plan for, and what of it is out of range."""
        if not self._has_rate:
            return self.only, ()
        displacement_mm, rate_mm_s = self.contact.planned(setpoint, measured)
        curve = self.curve(displacement_mm, rate_mm_s)
        outside: tuple[Outside, ...] = ()
        if curve.displacement_mm != displacement_mm:
            outside = (Outside(FEATURES[0], displacement_mm, curve.displacement_mm),)
        if curve.rate_mm_s != rate_mm_s:
            outside = (*outside, Outside(FEATURES[1], rate_mm_s, curve.rate_mm_s))
        return curve, outside

    def curve(self, displacement_mm: float, rate_mm_s: float) -> ForceCurve:
        known_mm, known_mm_s = within(displacement_mm, self._displacements_mm), within(rate_mm_s, self._rates_mm_s)
        return self._network.curve(known_mm, known_mm_s, self._cip_percent)
