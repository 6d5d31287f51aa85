"""The way of a setpoint from the sensor there to the force here: its parts as they are measured, against a budget.

From the stamp to the first duty that follows it, by the corrected clock of its source; from a Drive to its State, by
the link; and how far the gap is behind where the plan wants it, in time. What the sensor's own filters and the stamp
leave out, nobody here can see.
"""

import math

from tormagd.control.plan import PlanState
from tormagd.control.step import StepState
from tormagd.daemon.rate_group import Histogram
from tormagd_client.messages import ExecReport, WayReport

BUDGET_MS = 400.0
"Over this, a delayed force makes a task slower and its contacts harder."
MEMORY_S = 5.0
"The carriages' delay is that of about so much of their movement."
LEAST_MOVED_MM2_S = 5.0
"Of less movement, speed squared over time, no delay is told: 5 mm/s for 0.2 s."
MOST_BEHIND_MM = 1.0
"A gap that is further behind is on its way after a jump."


class Way:
    """Takes every control tick; remembers a bounded number of figures."""

    def __init__(self) -> None:
        self._to_duty = Histogram()
        self._stamp_s = -math.inf
        self._tick_s = -math.inf
        self._behind = self._moved = 0.0
        self._summary = self._to_duty.summary()

    def ticked(self, state: StepState, used: PlanState) -> None:
        """One control tick, and what had been planned when it ran."""
        now_s, stamp_s = state.time_s, used.governor.stamp_s
        if stamp_s != self._stamp_s:
            self._stamp_s = stamp_s
            if stamp_s > -math.inf:  # a duty that follows no setpoint ends no way
                self._to_duty.add_at(now_s, (now_s - stamp_s) * 1e6)
        elapsed_s, self._tick_s = now_s - self._tick_s, now_s
        reference, estimate = state.reference, state.estimate
        if reference is None or estimate is None or not 0.0 < elapsed_s < MEMORY_S:
            return
        speed_mm_s = reference.speed_mm_s
        behind_mm = used.plan.gap_mm - estimate.gap_mm
        if -MOST_BEHIND_MM < behind_mm < MOST_BEHIND_MM:
            kept = 1.0 - elapsed_s / MEMORY_S
            self._behind = kept * self._behind + elapsed_s * behind_mm * speed_mm_s
            self._moved = kept * self._moved + elapsed_s * speed_mm_s * speed_mm_s

    def refresh(self) -> None:
        """Makes the percentiles anew, for `report`."""
        self._summary = self._to_duty.summary()

    def report(self, device_us: float | None) -> WayReport:
        """The way's parts; `device_us` is the link's."""
        # the least squares' slope of how far behind over how fast
        carriages_ms = 1e3 * self._behind / self._moved if self._moved > LEAST_MOVED_MM2_S else None
        to_duty: ExecReport = self._summary
        total_ms = None
        if to_duty.max > 0.0 and device_us is not None and carriages_ms is not None:
            total_ms = round((to_duty.p99 + device_us) * 1e-3 + max(carriages_ms, 0.0), 2)
        return WayReport(
            to_duty_us=to_duty,
            device_us=device_us,
            carriages_ms=None if carriages_ms is None else round(carriages_ms, 2),
            total_ms=total_ms,
            budget_ms=BUDGET_MS,
        )
