"""What becomes of a setpoint: the verdict on it, and its delay from the sensor on the patient's side to the handle.

The verdict is rendered, arrives in some time, or cannot, and why. The first part of the delay is from the stamp, by the
corrected clock of its source, to the first duty that follows it. The second is from a Drive to its State, by the link.
The third is the believed lag of the carriages. Delay before the stamp, such as of the sensor's filters, cannot be seen.
"""

import math
from typing import NamedTuple

from msgspec import UNSET

from tormagd.control.aim.portrait import Portrait
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Plan
from tormagd.control.safety.codes import Limit
from tormagd.control.safety.operating_state import OperatingState
from tormagd.daemon.rate_group import Histogram
from tormagd.scenes.scene import Budget
from tormagd_client.messages import WayReport

RENDERED, ARRIVES, CANNOT = "rendered", "arrives", "cannot"
HOLDING = frozenset({Limit.RANGE, Limit.STANDBY, Limit.F_MIN, Limit.F_MAX})
"These keep a force from coming, as CEILING and MODEL_RANGE may; the others only delay it."
FORGOTTEN = frozenset({Limit.STALE, Limit.OTHER_SOURCE})
FIELD = "field_mT"
"If this feature is outside the model's range, the force is out of reach."
BUDGET_MS = 400.0
"A longer delay slows a task down and hardens its contacts."


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


class ForceDelay:
    def __init__(self) -> None:
        self.to_duty = Histogram()
        self._stamp_s = -math.inf

    def ticked(self, now_s: float, used: Plan, playout_s: float) -> None:
        stamp_s = used.stamp_s
        if stamp_s != self._stamp_s:
            self._stamp_s = stamp_s
            if stamp_s > -math.inf:  # -inf: the plan follows no setpoint
                self.to_duty.add(now_s, (now_s - stamp_s + playout_s) * 1e6)

    def report(self, device_us: float | None, lag_s: float, budget: Budget) -> WayReport:
        to_duty_us, carriages_ms, total_ms = self.to_duty.report(), 1e3 * lag_s, None
        if to_duty_us.max > 0.0 and device_us is not None:
            total_ms = round((to_duty_us.p99 + device_us) * 1e-3 + carriages_ms, 2)
        return WayReport(
            to_duty_us=to_duty_us,
            device_us=device_us,
            carriages_ms=round(carriages_ms, 2),
            total_ms=total_ms,
            budget_ms=BUDGET_MS if budget.delay_ms is UNSET else budget.delay_ms,
        )
