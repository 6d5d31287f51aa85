"""Lag of the carriages: the time constant T of a first-order lag from planned to measured gap.

    model    T de/dt + e = g           g planned gap, e expected gap, mm
    error    y = e - (x + v age)       x measured gap, mm, v its speed, mm/s, `age` before the plan
    update   dM = (v^2 - M / tau) dt   recursive least squares with forgetting: since de/dT = -v, v is the regressor
             dT = y v dt / (P + M)     M is the information so far, P the prior's: T = 0 at the start

T is learned only from plans that know what comes, and not while the carriages are behind a jump.
"""

from typing import Final, final

from tormagd.control.interpolation import low_pass

MAX_LAG_S: Final = 0.06
"The plant card's carriages are 50 ms late at most."
FORGETTING_S: Final = 3.0
"tau; on sample 1 2 to 5 s do as well."
PRIOR_MM2_S: Final = 50.0
"P: 35 ms at full speed count as much as the prior. Chosen on sample 1, where 25 to 150 do as well."
SETTLED_MM: Final = 0.1
"After a jump the error is of use again once it is this small."
MAX_DT_S: Final = 0.02
"A longer pause between plans, or between readings, counts as this."
AGE_S: Final = 0.0015
"The carriages were measured so long before the plan."


@final
class CarriageLag:
    """Estimator of one device's carriage lag: the time constant `lag_s` from planned to measured gap."""

    lag_s: float = 0.0
    "T, 0..MAX_LAG_S."
    information_mm2_s: float = 0.0
    "M, which grows with speed and forgets."
    expected_mm: float | None = None
    "e; None: it begins with the next plan's gap."
    is_settling: bool = False
    "Whether the carriages are still behind a jump."

    def update(
        self, dt_s: float, planned_mm: float | None, gap_mm: float, speed_mm_s: float, top_speed_mm_s: float
    ) -> None:
        """Learn from one plan, made `dt_s` after the last, with the gap and its speed measured AGE_S before it."""
        if planned_mm is None:
            self.expected_mm, self.is_settling = None, False
            return
        dt_s = min(max(dt_s, 0.0), MAX_DT_S)
        before_mm = planned_mm if self.expected_mm is None else self.expected_mm
        expected_mm = self.expected_mm = low_pass(before_mm, planned_mm, dt_s, self.lag_s) if dt_s > 0.0 else before_mm
        error_mm = expected_mm - gap_mm - speed_mm_s * AGE_S
        self.is_settling = abs(error_mm) > (SETTLED_MM if self.is_settling else MAX_LAG_S * top_speed_mm_s)
        if not self.is_settling:
            self.information_mm2_s += dt_s * (speed_mm_s * speed_mm_s - self.information_mm2_s / FORGETTING_S)
            lag_s = self.lag_s + dt_s * error_mm * speed_mm_s / (PRIOR_MM2_S + self.information_mm2_s)
            self.lag_s = min(max(lag_s, 0.0), MAX_LAG_S)
