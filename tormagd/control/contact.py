"""What the hand does to the element, in the model's terms: a handle slides, a finger presses."""

from typing import Final, final

from tormagd.control.records import Measured, TimedSetpoint
from tormagd.model.displacement import MOBILISED_MM, MOVING_MM_S

ROLLER_RATE_MM_S: Final = 42.0
"Surface speed of the roller at the thesis's 20 rpm: the portrait is drawn for a handle in motion."
CREEP_MM_S: Final = 0.5
"A slower handle is planned for as if it crept: its friction is static."
GONE_BACK_MM: Final = 0.01
"A handle that has gone back by more, just over a count of its encoder, may be turning: its friction falls already."
PRESSED: Final = 0.9
"A finger that is less deep than this share of the scene's depth is on its way there, or gone."


class Contact:
    """How a scene's element is touched. `displacement_mm` and `rate_mm_s` are those that its portrait is drawn for, and
    what a model is asked about that knows of no others; `slides` tells whether friction makes the force."""

    def __init__(self, displacement_mm: float, rate_mm_s: float, slides: bool) -> None:
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.slides: Final = slides

    def planned(self, setpoint: TimedSetpoint | None, measured: Measured | None) -> tuple[float, float]:
        """Displacement, mm, and rate, mm/s, that the force is planned for: the setpoint's own where it states them, but
        of a handle that slides the measured rate."""
        raise NotImplementedError

    def present(self, measured: Measured) -> tuple[float, float]:
        """Displacement, mm, and rate, mm/s, at which the model gives the force of now."""
        raise NotImplementedError

    def is_known(self, measured: Measured) -> bool:
        """Whether the model knows the force of now."""
        raise NotImplementedError


@final
class Sliding(Contact):
    """The brake's handle, planned for at full mobilisation and in motion: the field sets how much friction there can
    be. Before break-away the force is the hand's choice, and the inverse is ill-posed."""

    def __init__(self) -> None:
        super().__init__(MOBILISED_MM, ROLLER_RATE_MM_S, slides=True)

    def planned(self, setpoint: TimedSetpoint | None, measured: Measured | None) -> tuple[float, float]:
        """See `Contact.planned`."""
        displacement_mm = MOBILISED_MM
        rate_mm_s = MOVING_MM_S if measured is None else measured.handle.sliding_mm_s
        if setpoint is not None:
            if setpoint.displacement_mm is not None:
                displacement_mm = setpoint.displacement_mm
            # learned of the measured rate, a device would be taken for another at the stated one
            if setpoint.rate_mm_s is not None and (measured is None or not self.is_known(measured)):
                rate_mm_s = abs(setpoint.rate_mm_s)
        return displacement_mm, max(rate_mm_s, CREEP_MM_S)

    def present(self, measured: Measured) -> tuple[float, float]:
        """See `Contact.present`."""
        return MOBILISED_MM, abs(measured.handle.rate_mm_s)

    def is_known(self, measured: Measured) -> bool:
        """Whether the handle has gone far enough one way, and not begun to come back: its friction is mobilised."""
        handle = measured.handle
        gone_back_mm = abs(measured.handle_mm - handle.turn.furthest_mm)
        return handle.displacement_mm >= MOBILISED_MM and gone_back_mm <= GONE_BACK_MM


@final
class Pressing(Contact):
    """A finger in a pad. Until it is about as deep as the scene says, the force is planned for that depth: what the pad
    gives before, no field changes much, and carriages that ran to and fro for it would be late where it counts."""

    def __init__(self, depth_mm: float) -> None:
        super().__init__(depth_mm, 0.0, slides=False)

    def planned(self, setpoint: TimedSetpoint | None, measured: Measured | None) -> tuple[float, float]:
        """See `Contact.planned`."""
        depth_mm, rate_mm_s = self.displacement_mm, 0.0
        if measured is not None and self.is_known(measured):
            depth_mm, rate_mm_s = self.present(measured)
        if setpoint is not None:
            if setpoint.displacement_mm is not None:
                depth_mm = setpoint.displacement_mm
            if setpoint.rate_mm_s is not None:
                rate_mm_s = setpoint.rate_mm_s
        return depth_mm, rate_mm_s

    def present(self, measured: Measured) -> tuple[float, float]:
        """See `Contact.present`."""
        return measured.handle.displacement_mm, measured.handle.rate_mm_s

    def is_known(self, measured: Measured) -> bool:
        """Whether the finger is about as deep as the scene says, or deeper."""
        return measured.handle.displacement_mm >= PRESSED * self.displacement_mm
