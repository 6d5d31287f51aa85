"""What a search for the field answers, and the interface that every search has."""

from enum import StrEnum
from typing import Final, Protocol, final

from firmware_protocol.value import Value
from tormagd.model.features import LARGEST, require_number
from tormagd.model.force_curve import ForceCurve


class Reach(StrEnum):
    """Whether the fields at hand can give the force that was asked."""

    INSIDE = "inside"
    BELOW = "below"  # less force was asked than the least that any field gives
    ABOVE = "above"  # more force was asked than the greatest that any field gives


@final
class FieldSolution(Value):
    """The field for a force, and what the model predicts there.

    `confidence` is 0..1 (see `ForceCurve.confidence`); `iterations` counts evaluations of the curve made one after the
    other (a pass over a whole grid of fields is one).
    """

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
    """What a search beside the plans is asked at `time_s`: the field at which the brake gives `force_N`, the handle
    being taken to move so; of several the one nearest `last_field_mT`."""

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
    """What a search beside the plans found for the question of `time_s`."""

    def __init__(self, time_s: float, solution: FieldSolution) -> None:
        self.time_s: Final = time_s
        self.solution: Final = solution


TIE: Final = 16.0 * 2.0**-52
"A sum of as many terms as a network has units is wrong by a few units of rounding: forces that near are the same."


class FieldSolver(Protocol):
    """A search for the field at which the brake gives `force_N`."""

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        """Answer with the field for `force_N`; where several fit, the one nearest `last_field_mT` when that is given.

        A force out of reach gets the field that comes nearest to it and says so in `reach`.
        Raises `DomainError` naming the argument that is not finite, or too large.
        """


def checked_near_mT(force_N: float, last_field_mT: float | None, least_mT: float) -> float:
    """The field from which distance counts: the last one, or `least_mT`, the opener gap, without one.

    Raises `DomainError` naming the first argument of a solve that is not finite, or too large.
    """
    near_mT = least_mT if last_field_mT is None else last_field_mT
    if not (-LARGEST <= near_mT <= LARGEST and -LARGEST <= force_N <= LARGEST):
        require_number("last_field_mT", near_mT)
        require_number("force_N", force_N)
    return near_mT


def tie_N(curve: ForceCurve) -> float:
    """Forces of `curve` that differ by less are the same."""
    return TIE * curve.magnitude_N


def answer(
    curve: ForceCurve, field_mT: float, force_N: float, predicted_N: float, iterations: int, reach: Reach
) -> FieldSolution:
    """A field and what `curve` predicts there as the solution for `force_N`, with its confidence."""
    trust = curve.confidence(field_mT, force_N - predicted_N)
    return FieldSolution(field_mT, predicted_N, trust, iterations, reach)
