"""The verdict on a setpoint: rendered, arrives in some time, or cannot, and why. Pure functions."""

from typing import NamedTuple

from tormagd.control.aim.portrait import Portrait
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Plan
from tormagd.control.safety.codes import Limit
from tormagd.control.safety.operating_state import OperatingState

RENDERED, ARRIVES, CANNOT = "rendered", "arrives", "cannot"
HOLDING = frozenset({Limit.RANGE, Limit.STANDBY, Limit.F_MIN, Limit.F_MAX})
"These keep a force from coming, as CEILING and MODEL_RANGE may; the others only delay it."
FORGOTTEN = frozenset({Limit.STALE, Limit.OTHER_SOURCE})
FIELD = "field_mT"
"If this feature is outside the model's range, the force is out of reach."


class Judged(NamedTuple):
    outcome: str
    arrives_ms: float | None
    why: tuple[str, ...] = ()


def judged(
    plan: Plan,
    state: OperatingState,
    gap_mm: float | None,
    portrait: Portrait,
    device: DeviceFit,
    *,
    gap_speed_mm_s: float,
    lag_s: float,
    tolerance_N: float,
    release_N_s: float,
) -> Judged:
    asked_N = plan.setpoint_N
    if state is not OperatingState.ENABLED or gap_mm is None:
        return Judged(CANNOT, None, (str(state),))
    if asked_N is None:
        return Judged(CANNOT, None, tuple(str(limit) for limit in plan.limits if limit in FORGOTTEN))
    aim_mm = portrait.gap_mm_at(device.model_N(asked_N))
    # unless the gap is held, it differs from the portrait's by the element's memory and the handle's rate
    if Limit.CEILING not in plan.limits and Limit.MODEL_RANGE not in plan.limits:
        gap_mm -= plan.gap_mm - portrait.gap_mm_at(device.model_N(plan.governed_N))
    if abs(device.force_N(portrait.force_N_at(gap_mm)) - asked_N) <= tolerance_N:
        return Judged(RENDERED, 0.0)
    if why := tuple(str(limit) for limit in plan.limits if _holds(limit, plan, aim_mm)):
        return Judged(CANNOT, None, why)
    moves_s = abs(aim_mm - gap_mm) / gap_speed_mm_s
    if Limit.TAKEOVER in plan.limits:
        moves_s = max(moves_s, abs(asked_N - plan.governed_N) / release_N_s)
    return Judged(ARRIVES, round(1e3 * (moves_s + lag_s), 1))


def _holds(limit: Limit, plan: Plan, aim_mm: float) -> bool:
    """Tell whether `limit` keeps the gap from `aim_mm` for good, and not only on the way there."""
    if limit is Limit.CEILING:
        return aim_mm < plan.min_gap_mm
    if limit is Limit.F_MIN:
        return (plan.setpoint_N or 0.0) <= plan.governed_N
    if limit is Limit.MODEL_RANGE:
        return any(each.quantity == FIELD for each in plan.outside)
    return limit in HOLDING
