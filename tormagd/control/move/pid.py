"""PID controller on position with two degrees of freedom.

    asked  u = Kp (e + Td e' + integral of e / Ti) + f        e position error, e' speed error, f feed-forward
    limit  back-calculation: the integral also takes (duty - u) / Tb

The speed error carries the derivative action: the expected speed, less the filtered derivative of the measured
position.
"""

import math
from typing import Final, final

from tormagd.config import Position
from tormagd.element.model.features import require_number

ON_TARGET_MM: Final = 0.001
"Just over half an encoder count: a carriage cannot be told to stand nearer."


@final
class Pid:
    """The position loop of one carriage."""

    integral: float = 0.0
    is_saturated: bool = False

    def __init__(self, position: Position) -> None:
        self._proportional_per_mm: Final = position.proportional_per_mm
        self._integral_time_s: Final = position.integral_time_s
        self._derivative_time_s: Final = position.derivative_time_s
        self._back_calculation_s: Final = position.back_calculation_s
        self._limit: Final = position.duty_limit

    def rest(self, error_mm: float, dt_s: float) -> None:
        """Let the integral decay while the carriage is on its target."""
        if abs(error_mm) <= ON_TARGET_MM:
            self.integral = self.integral * self._integral_time_s / (self._integral_time_s + dt_s)

    def update(self, error_mm: float, error_mm_s: float, feed_forward: float, dt_s: float, is_blocked: bool) -> float:
        """Return the duty after `dt_s` > 0."""
        proportional = self._proportional_per_mm * error_mm
        derivative = self._proportional_per_mm * self._derivative_time_s * error_mm_s
        asked = proportional + self.integral + derivative + feed_forward
        if not -math.inf < asked < math.inf:
            require_number("duty", asked)
        within = min(max(asked, -self._limit), self._limit)
        duty = min(within, 0.0) if is_blocked else within
        growth = proportional / self._integral_time_s + (duty - asked) / self._back_calculation_s
        if is_blocked:
            growth = min(growth, 0.0)
        # no carriage needs more than the whole duty from the integral
        self.integral = min(max(self.integral + growth * dt_s, -self._limit), self._limit)
        self.is_saturated = within != asked and duty == within
        return duty
