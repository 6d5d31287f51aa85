"""A low-pass filter of first order."""


def low_pass(value: float, towards: float, dt_s: float, time_s: float) -> float:
    """Return `value` after `dt_s` on its way to `towards` with the time constant `time_s` (implicit Euler)."""
    return value + dt_s / (time_s + dt_s) * (towards - value)
