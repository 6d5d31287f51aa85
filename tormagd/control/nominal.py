"""The nominal device: the model's force over the field, for the handle as it moves or is planned for."""

from typing import Final, final

from tormagd.control.contact import Contact
from tormagd.control.records import Measured, Outside, TimedSetpoint
from tormagd.model.features import FEATURES
from tormagd.model.force_curve import ForceCurve, within
from tormagd.model.model_file import ForceModel


@final
class Nominal:
    """One element's force as one model has it. It changes nothing, and asks the model about nothing that this was not
    trained on. Without `has_rate` the handle is always taken to move as the portrait is drawn for: `only`."""

    def __init__(self, model: ForceModel, contact: Contact, cip_percent: float, has_rate: bool) -> None:
        self._network: Final = model.network
        self.contact: Final = contact
        self._cip_percent: Final = cip_percent
        self._has_rate: Final = has_rate
        known_mm = model.feature_ranges[0]
        # what slides is planned for mobilised: the handle's way there is no force that a field could be found for
        mobilised_mm = within(contact.displacement_mm, known_mm)
        self._displacements_mm: Final = (mobilised_mm, mobilised_mm) if contact.slides else known_mm
        self._rates_mm_s: Final = model.feature_ranges[1]
        self.fields_mT: Final = model.feature_ranges[2]
        self.only: Final[ForceCurve] = self.curve(contact.displacement_mm, contact.rate_mm_s)

    def now(self, measured: Measured) -> ForceCurve:
        """The force over the field, of the handle as it moves now."""
        if not self._has_rate:
            return self.only
        displacement_mm, rate_mm_s = self.contact.present(measured)
        return self.curve(displacement_mm, rate_mm_s)

    def planned(
        self, setpoint: TimedSetpoint | None, measured: Measured | None
    ) -> tuple[ForceCurve, tuple[Outside, ...]]:
        """The force over the field, of the handle as a setpoint is planned for; and what of that the model does not
        know, with what it was asked about instead."""
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
        """Of a handle with this displacement and rate, or what of them the model knows."""
        known_mm, known_mm_s = within(displacement_mm, self._displacements_mm), within(rate_mm_s, self._rates_mm_s)
        return self._network.curve(known_mm, known_mm_s, self._cip_percent)
