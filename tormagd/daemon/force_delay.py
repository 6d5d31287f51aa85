"""The delay from the sensor on the patient's side to the force at the handle, in parts, against a budget.

The first part is from the stamp, by the corrected clock of its source, to the first duty that follows it. The second is
from a Drive to its State, by the link. The third is the believed lag of the carriages. Delay before the stamp, such as
that of the sensor's filters, cannot be seen here.
"""

import math

from msgspec import UNSET

from tormagd.control.records import Plan
from tormagd.daemon.rate_group import Histogram
from tormagd.scenes.scene import Budget
from tormagd_client.messages import WayReport

BUDGET_MS = 400.0
"A longer delay slows a task down and hardens its contacts."


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
        to_duty_us, carriages_ms, total_ms = self.to_duty.report, 1e3 * lag_s, None
        if to_duty_us.max > 0.0 and device_us is not None:
            total_ms = round((to_duty_us.p99 + device_us) * 1e-3 + carriages_ms, 2)
        return WayReport(
            to_duty_us=to_duty_us,
            device_us=device_us,
            carriages_ms=round(carriages_ms, 2),
            total_ms=total_ms,
            budget_ms=BUDGET_MS if budget.delay_ms is UNSET else budget.delay_ms,
        )
