"""The nominal device: the model's force over the field for the handle's present or planned motion."""

from typing import Final, final

from tormagd.control.contact import ElementContact
from tormagd.control.records import Measured, Outside, TimedSetpoint
from tormagd.model.features import FEATURES
from tormagd.model.force_curve import ForceCurve, within
from tormagd.model.model_file import ForceModel


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
