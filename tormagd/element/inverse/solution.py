"""The interface of a search for the field, and its answer."""

from enum import StrEnum
from typing import Final, Protocol, final

from firmware_protocol.value import Value
from tormagd.element.model.features import LARGEST, require_number
from tormagd.element.model.force_curve import ForceCurve


class Reach(StrEnum):
    """Whether the fields in range can give the force that was asked."""

    INSIDE = "inside"
    BELOW = "below"  # less than any field gives
    ABOVE = "above"  # more than any field gives


@final
class FieldSolution(Value):
    """The field for a force, and the force that the model predicts there."""

    def __init__(
        self, field_mT: float, predicted_force_N: float, confidence: float, iterations: int, reach: Reach
    ) -> None:
        self.field_mT: Final = field_mT
        self.predicted_force_N: Final = predicted_force_N
        self.confidence: Final = confidence
        self.iterations: Final = iterations
        self.reach: Final = reach


@final
class Question(Value):
    """A question to a search in its own process: which field gives `force_N`?"""

    def __init__(
        self, time_s: float, displacement_mm: float, rate_mm_s: float, force_N: float, last_field_mT: float
    ) -> None:
        self.time_s: Final = time_s
        self.displacement_mm: Final = displacement_mm
        self.rate_mm_s: Final = rate_mm_s
        self.force_N: Final = force_N
        self.last_field_mT: Final = last_field_mT


@final
class Answer(Value):
    def __init__(self, time_s: float, solution: FieldSolution) -> None:
        self.time_s: Final = time_s
        self.solution: Final = solution


TIE: Final = 16.0 * 2.0**-52
"Forces that differ by less than this share of a sum's magnitude are equal up to rounding."


class FieldSolver(Protocol):
    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """Return the field for `force_N`; of several, the one nearest `last_field_mT` (None: the least)."""


def checked_near_mT(force_N: float, last_field_mT: float | None, least_mT: float) -> float:
    """Check a search's arguments, and return the field to be near."""
    near_mT = least_mT if last_field_mT is None else last_field_mT
    if not (-LARGEST <= near_mT <= LARGEST and -LARGEST <= force_N <= LARGEST):
        require_number("last_field_mT", near_mT)
        require_number("force_N", force_N)
    return near_mT


def tie_N(curve: ForceCurve) -> float:
    return TIE * curve.magnitude_N


def answer(
    curve: ForceCurve, field_mT: float, force_N: float, predicted_N: float, iterations: int, reach: Reach
) -> FieldSolution:
    trust = curve.confidence(field_mT, force_N - predicted_N)
    return FieldSolution(field_mT, predicted_N, trust, iterations, reach)
