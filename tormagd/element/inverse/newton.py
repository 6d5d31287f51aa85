"""Newton's method for the field, where the force is known to rise with the field: the search of the hot path."""

from typing import Final, final

from tormagd.element.inverse.solution import FieldSolution, Reach, answer, checked_near_mT, tie_N
from tormagd.element.model.features import require_number
from tormagd.element.model.force_curve import ForceCurve
from tormagd.element.physics.errors import DomainError

ACCURACY_MT: Final = 1e-3
"A twentieth of the largest change of field over one encoder count (1/560 mm)."

LOOKED_AT_MT: Final = 0.25 * ACCURACY_MT
"A step that should end this near the root is the last, and needs no slope."

MAX_EVALUATIONS: Final = 60
"Bisection alone needs 20 from 1000 mT; three times as many allow for steps between bisections."


@final
class RisingSearch:
    """Newton's method from the last field, in a bracket that begins as the whole range."""

    def __init__(self, field_range_mT: tuple[float, float]) -> None:
        low_mT, high_mT = field_range_mT
        require_number("field_range_mT", low_mT)
        require_number("field_range_mT", high_mT)
        if not low_mT < high_mT:
            raise DomainError("field_range_mT", field_range_mT, "a least field below the greatest")
        self._low_mT = low_mT
        self._high_mT = high_mT

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        low, high = self._low_mT, self._high_mT
        span = high - low
        field = checked_near_mT(force_N, last_field_mT, low)
        field = low if field < low else high if field > high else field
        same_N = tie_N(curve)
        left, right, left_seen, right_seen = low, high, False, False
        # a step ends at about its square times this from the root: a parabola's at first
        bend_per_mT, before = 1.0 / span, 2.0 * span
        predicted_N, evaluations = 0.0, 0
        while True:
            predicted_N, slope = curve.force_and_slope(field)
            evaluations += 1
            excess_N = predicted_N - force_N
            if abs(excess_N) <= same_N:
                break
            if excess_N < 0.0:
                if field >= high:
                    return answer(curve, field, force_N, predicted_N, evaluations, Reach.ABOVE)
                left, left_seen = field, True
            else:
                if field <= low:
                    return answer(curve, field, force_N, predicted_N, evaluations, Reach.BELOW)
                right, right_seen = field, True
            # an end that was not evaluated does not close the bracket: the force may be out of reach
            if (left_seen and right_seen and right - left <= ACCURACY_MT) or evaluations >= MAX_EVALUATIONS:
                break
            # a slope that rounding made flat gives no direction, but the force rises
            step = -excess_N / slope if slope > 0.0 else span if excess_N < 0.0 else -span
            following = field + step
            if following > right - ACCURACY_MT and not right_seen:
                following = right
            elif following < left + ACCURACY_MT and not left_seen:
                following = left
            elif not left < following < right or 2.0 * abs(step) > abs(before):
                following = 0.5 * (left + right)
            else:
                if evaluations > 1:
                    bend_per_mT = abs(step / before / before)
                if bend_per_mT * step * step <= LOOKED_AT_MT:
                    there_N = curve.force_N(following)
                    evaluations += 1
                    # with a tenth of the excess left the slope is known to a third
                    allowed_N = min(0.5 * ACCURACY_MT * slope, 0.1 * abs(excess_N))
                    if abs(there_N - force_N) <= max(allowed_N, same_N):
                        return answer(curve, following, force_N, there_N, evaluations, Reach.INSIDE)
            before, field = following - field, following
        return answer(curve, field, force_N, predicted_N, evaluations, Reach.INSIDE)
