"""What a search for the field answers, how far to trust it, and the interface that every search has."""

import math
from enum import StrEnum
from typing import NamedTuple, Protocol

from tormagd.learning.features import FIELD, require_inputs, require_number
from tormagd.learning.model_file import ForceModel


class Reach(StrEnum):
    """Whether the fields at hand can give the force that was asked."""

    INSIDE = "inside"
    BELOW = "below"  # less force was asked than the least that any field gives
    ABOVE = "above"  # more force was asked than the greatest that any field gives


class FieldSolution(NamedTuple):
    """The field for a force, and what the model predicts there.

    `confidence` is 0..1 (see `confidence`); `iterations` counts evaluations of the network made one after the other (a
    pass over the whole field grid is one).
    """

    field_mT: float
    predicted_force_N: float
    confidence: float
    iterations: int
    reach: Reach


class FieldSolver(Protocol):
    """A search for the field at which the brake gives `force_N`."""

    def solve(
        self,
        displacement_mm: float,
        rate_mm_s: float,
        force_N: float,
        cip_percent: float,
        last_field_mT: float | None,
    ) -> FieldSolution:
        """Answer with the field for `force_N`; where several fit, the one nearest `last_field_mT` when that is given.

        A force out of reach gets the field that comes nearest to it and says so in `reach`.
        Raises `DomainError` on a non-finite input.
        """
        ...


def checked_near_mT(
    displacement_mm: float,
    rate_mm_s: float,
    force_N: float,
    cip_percent: float,
    last_field_mT: float | None,
    least_mT: float,
) -> float:
    """The field from which distance counts: the last one, or `least_mT`, the opener gap, without one.

    Raises `DomainError` naming the first argument of a solve that is not finite, or too large.
    """
    near_mT = least_mT if last_field_mT is None else last_field_mT
    require_inputs(displacement_mm, rate_mm_s, near_mT, cip_percent)
    require_number("force_N", force_N)
    return near_mT


def answer(
    model: ForceModel,
    features: tuple[float, float, float, float],
    force_N: float,
    predicted_force_N: float,
    iterations: int,
    reach: Reach,
) -> FieldSolution:
    """The field among `features` (order of `FEATURES`) as the solution for `force_N`, with its confidence."""
    trust = confidence(model, features, force_N, predicted_force_N)
    return FieldSolution(features[FIELD], predicted_force_N, trust, iterations, reach)


EXTRAPOLATION_RATE = 4.0
"""Confidence falls to 1/e when the inputs lie a quarter of their training range outside it, features summed."""

RESIDUAL_RATE = 20.0
"""Confidence falls to 1/e when 5% of the training force span remains between force asked and force predicted."""


def confidence(
    model: ForceModel, features: tuple[float, float, float, float], force_N: float, predicted_force_N: float
) -> float:
    """Trust in an answer, 0..1: exp(-4 e - 20 r).

    e is the distance of each of `features` (order of `FEATURES`) outside its training range, as a share of that range,
    summed; a feature that never varied in training counts as a share of its magnitude (at least 1 unit).
    r is |force_N - predicted_force_N| as a share of the force span seen in training.
    """
    excess = 0.0
    for value, (low, high) in zip(features, model.feature_ranges, strict=True):
        outside = max(low - value, value - high)
        if outside > 0:
            excess += outside / ((high - low) or max(abs(low), 1.0))
    residual = abs(force_N - predicted_force_N) / model.force_span_N
    return math.exp(-EXTRAPOLATION_RATE * excess - RESIDUAL_RATE * residual)
