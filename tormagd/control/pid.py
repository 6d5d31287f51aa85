"""PID on position with two degrees of freedom: filtered derivative of the measurement, feed-forward of the reference,
back-calculation against wind-up. Pure functions.
"""

from typing import Final, final

from firmware_protocol.value import Value
from tormagd.config import Position

ON_TARGET_MM: Final = 0.001
"Just over half a count of 4,480 on 8 mm: a carriage cannot be told to stand nearer."


@final
class Gains(Value):
    """What of `config.Position` the PID needs; gains per mm, times in s, the duty's limit."""

    def __init__(
        self,
        proportional_per_mm: float,
        integral_time_s: float,
        derivative_time_s: float,
        back_calculation_s: float,
        duty_limit: float,
    ) -> None:
        self.proportional_per_mm: Final = proportional_per_mm
        self.integral_time_s: Final = integral_time_s
        self.derivative_time_s: Final = derivative_time_s
        self.back_calculation_s: Final = back_calculation_s
        self.duty_limit: Final = duty_limit

    @classmethod
    def of(cls, position: Position) -> "Gains":
        """Those of a configuration."""
        return cls(
            position.proportional_per_mm,
            position.integral_time_s,
            position.derivative_time_s,
            position.back_calculation_s,
            position.duty_limit,
        )


@final
class Error(Value):
    """How far a carriage is from where it is expected, mm and mm/s."""

    def __init__(self, position_mm: float, speed_mm_s: float) -> None:
        self.position_mm: Final = position_mm
        self.speed_mm_s: Final = speed_mm_s


@final
class PidState(Value):
    """The integral action, duty. Starting it at 0 is bumpless: holding takes no duty, because friction holds."""

    def __init__(self, integral: float = 0.0) -> None:
        self.integral: Final = integral


@final
class PidOutput(Value):
    """Duty in -limit..limit, and whether the limit held it back."""

    def __init__(self, duty: float, is_saturated: bool) -> None:
        self.duty: Final = duty
        self.is_saturated: Final = is_saturated


def rested(gains: Gains, state: PidState, error: Error, dt_s: float) -> PidState:
    """The state before an update at a reference that rests. On target friction holds the carriage, and no error would
    ever take back what the integral learned on the way, which is wrong on the way back: it forgets in its own time.
    """
    if abs(error.position_mm) > ON_TARGET_MM:
        return state
    return PidState(state.integral * gains.integral_time_s / (gains.integral_time_s + dt_s))


def pid(
    gains: Gains, state: PidState, error: Error, feed_forward: float, dt_s: float, *, is_blocked: bool = False
) -> tuple[PidState, PidOutput]:
    """One update, `dt_s` > 0 after the last; the feed-forward is a duty. The speed error carries the derivative action:
    its measured half is the filtered derivative of the position, its other half the speed that is expected, so that a
    moving reference gives no derivative kick and no lag. Where `is_blocked`, opening moves nothing: no duty above 0 is
    given, the integral does not rise against that, and it is no saturation.
    """
    proportional = gains.proportional_per_mm * error.position_mm
    derivative = gains.proportional_per_mm * gains.derivative_time_s * error.speed_mm_s
    asked = proportional + state.integral + derivative + feed_forward
    within = min(max(asked, -gains.duty_limit), gains.duty_limit)
    duty = min(within, 0.0) if is_blocked else within
    growth = proportional / gains.integral_time_s + (duty - asked) / gains.back_calculation_s
    if is_blocked:
        growth = min(growth, 0.0)
    # the integral never needs more than the whole duty, whatever a long saturation makes of back-calculation
    integral = min(max(state.integral + growth * dt_s, -gains.duty_limit), gains.duty_limit)
    return PidState(integral), PidOutput(duty, within != asked and duty == within)
