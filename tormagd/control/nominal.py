"""The nominal device: contact of hand and element, the field of a gap, and the model's force over the field.

Each kind of contact states, in the model's terms, the motion that the model is asked for, `planned` ahead (a publisher
may have told its own) and `motion_now`, and whether the latter `is_known`. Its `displacement_mm` and `rate_mm_s` are
the motion that the portrait is drawn for. Where it `slides`, friction makes the force.
"""

import math
from typing import Final, TypeAlias, final

from tormagd.control.records import Measured, Outside, TimedSetpoint
from tormagd.element.model.displacement import MOBILISED_MM, MOVING_MM_S
from tormagd.element.model.features import FEATURES
from tormagd.element.model.force_curve import NetworkCurve, within
from tormagd.element.model.model_file import ForceModel
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.field import PowerFieldLaw, flux_density_T

ROLLER_RATE_MM_S: Final = 42.0
"The thesis turns at 20 rpm; the portrait is drawn for a handle in motion."
CREEP_MM_S: Final = 0.5
"A slower handle is planned for at this rate, because its friction is static."
GONE_BACK_MM: Final = 0.01
"A handle that has gone back by more (just over one encoder count) may be turning."
PRESSED: Final = 0.9
"A finger that is less deep than this share of the scene's depth is on its way in or out."


@final
class Sliding:
    """The sliding handle of a brake. Plans take it as moving, with its friction mobilised."""

    displacement_mm: Final[float] = MOBILISED_MM
    rate_mm_s: Final[float] = ROLLER_RATE_MM_S
    slides: Final[bool] = True

    def planned(self, told_mm: float | None, told_mm_s: float | None, measured: Measured | None) -> tuple[float, float]:
        rate_mm_s = MOVING_MM_S if measured is None else measured.handle.sliding_mm_s
        # the device's fit is learned at the measured rate; at the stated rate it would describe another device
        if told_mm_s is not None and (measured is None or not self.is_known(measured)):
            rate_mm_s = abs(told_mm_s)
        return MOBILISED_MM if told_mm is None else told_mm, max(rate_mm_s, CREEP_MM_S)

    def motion_now(self, measured: Measured) -> tuple[float, float]:
        return MOBILISED_MM, abs(measured.handle.rate_mm_s)

    def is_known(self, measured: Measured) -> bool:
        """Tell whether friction is mobilised, so that the model can give the present force."""
        handle = measured.handle
        gone_back_mm = abs(measured.handle_mm - handle.turn.furthest_mm)
        return handle.displacement_mm >= MOBILISED_MM and gone_back_mm <= GONE_BACK_MM


@final
class Pressing:
    """A finger that presses into a pad. Until `is_known`, the force is planned for the scene's depth, at rest."""

    rate_mm_s: Final[float] = 0.0
    slides: Final[bool] = False

    def __init__(self, depth_mm: float) -> None:
        self.displacement_mm: Final = depth_mm

    def planned(self, told_mm: float | None, told_mm_s: float | None, measured: Measured | None) -> tuple[float, float]:
        depth_mm, rate_mm_s = self.displacement_mm, 0.0
        if measured is not None and self.is_known(measured):
            depth_mm, rate_mm_s = self.motion_now(measured)
        return depth_mm if told_mm is None else told_mm, rate_mm_s if told_mm_s is None else told_mm_s

    def motion_now(self, measured: Measured) -> tuple[float, float]:
        return measured.handle.displacement_mm, measured.handle.rate_mm_s

    def is_known(self, measured: Measured) -> bool:
        return measured.handle.displacement_mm >= PRESSED * self.displacement_mm


ElementContact: TypeAlias = Sliding | Pressing


@final
class FieldOfGap:
    """The flux density at the shaft's surface over the gap: Eq. 6 with a power law of the gap."""

    def __init__(self, law: PowerFieldLaw, relative_permeability: float, inner_radius_m: float) -> None:
        self._coefficient: Final = law.coefficient
        self._exponent: Final = law.exponent
        self._inverse: Final = 1.0 / law.exponent
        self._per_moment_T: Final = flux_density_T(1.0, relative_permeability, inner_radius_m)
        self._range_mm: Final = law.gap_range_mm
        self._strongest_mT: Final = self.field_mT(law.gap_range_mm[0])
        self._weakest_mT: Final = self.field_mT(law.gap_range_mm[1])

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
        self.only: Final = self.curve(contact.displacement_mm, contact.rate_mm_s)

    def now(self, measured: Measured) -> NetworkCurve:
        displacement_mm, rate_mm_s = self.contact.motion_now(measured)
        return self.curve(displacement_mm, rate_mm_s) if self._has_rate else self.only

    def planned(
        self, setpoint: TimedSetpoint | None, measured: Measured | None
    ) -> tuple[NetworkCurve, tuple[Outside, ...]]:
        """Return the force over the field for the motion to plan for, and what of it is out of range."""
        if not self._has_rate:
            return self.only, ()
        told_mm = None if setpoint is None else setpoint.displacement_mm
        told_mm_s = None if setpoint is None else setpoint.rate_mm_s
        displacement_mm, rate_mm_s = self.contact.planned(told_mm, told_mm_s, measured)
        curve = self.curve(displacement_mm, rate_mm_s)
        known_mm, known_mm_s = curve.displacement_mm, curve.rate_mm_s
        return curve, (
            ((Outside(FEATURES[0], displacement_mm, known_mm),) if known_mm != displacement_mm else ())
            + ((Outside(FEATURES[1], rate_mm_s, known_mm_s),) if known_mm_s != rate_mm_s else ())
        )

    def curve(self, displacement_mm: float, rate_mm_s: float) -> NetworkCurve:
        known_mm, known_mm_s = within(displacement_mm, self._displacements_mm), within(rate_mm_s, self._rates_mm_s)
        return self._network.curve(known_mm, known_mm_s, self._cip_percent)
