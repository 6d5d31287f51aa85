"""From the publisher's setpoint to the force that will be asked of the device, with the reason for every difference."""

from typing import NamedTuple

from tormagd.config import Limits
from tormagd.control.portrait import Portrait
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Force

SLOPE_FILTER_S = 0.003
AHEAD_S = 0.05
"Setpoints are carried forward along their slope by no more than this."
LONGEST_STEP_S = 0.1
"Setpoints further apart than this have no slope between them."


class TimedSetpoint(NamedTuple):
    """The newest valid setpoint. `stamp_s` is when the publisher meant it, on the clock of `now_s`."""

    force_N: float
    stamp_s: float
    valid_for_s: float
    displacement_mm: float | None = None
    rate_mm_s: float | None = None


class GovernorState(NamedTuple):
    """What the governor remembers between plans."""

    time_s: float
    governed_N: float
    stamp_s: float = float("-inf")
    slope_N_s: float = 0.0
    last_N: float = 0.0


class Governed(NamedTuple):
    """The force to render now, how it changes, where it will be `lead_s` from now, and what holds it back."""

    force_N: float
    slope_N_s: float
    ahead_N: float
    age_s: float | None
    limits: tuple[Limit, ...]


def govern(
    state: GovernorState,
    now_s: float,
    setpoint: TimedSetpoint | None,
    *,
    portrait: Portrait,
    scene: Force,
    limits: Limits,
    gap_speed_mm_s: float,
    lead_s: float,
) -> tuple[GovernorState, Governed]:
    """One decision. A missing or stale setpoint decays to F_min along `limits.stale_ramp_N_s`: never a jump, never a
    force held for ever.
    """
    elapsed = max(0.0, now_s - state.time_s)
    age = None if setpoint is None else now_s - setpoint.stamp_s
    if setpoint is None or age is None or age > setpoint.valid_for_s:
        reason = Limit.NO_SETPOINT if setpoint is None else Limit.STALE
        force = max(portrait.least_N, state.governed_N - limits.stale_ramp_N_s * elapsed)
        rested = GovernorState(now_s, force)
        return rested, Governed(force, 0.0, force, age, (reason,))
    force, reasons = _within_range(setpoint.force_N, portrait, scene)
    slope = state.slope_N_s
    spacing = setpoint.stamp_s - state.stamp_s
    if spacing > LONGEST_STEP_S:
        slope = 0.0
    elif spacing > 0.0:
        renderable = portrait.force_rate_N_s(force, gap_speed_mm_s)
        between = min(max((force - state.last_N) / spacing, -renderable), renderable)
        slope += spacing / (SLOPE_FILTER_S + spacing) * (between - slope)
    ahead = force + slope * min(max(age, 0.0) + lead_s, AHEAD_S)
    ahead = min(max(ahead, portrait.least_N), portrait.most_N)
    return GovernorState(now_s, force, setpoint.stamp_s, slope, force), Governed(force, slope, ahead, age, reasons)


def _within_range(asked_N: float, portrait: Portrait, scene: Force) -> tuple[float, tuple[Limit, ...]]:
    reasons: list[Limit] = []
    force = min(max(asked_N, scene.least_N), scene.most_N)
    if force != asked_N:
        reasons.append(Limit.RANGE)
    if force < portrait.least_N:
        force = portrait.least_N
        reasons.append(Limit.F_MIN)
    elif force > portrait.most_N:
        force = portrait.most_N
        reasons.append(Limit.F_MAX)
    return force, tuple(reasons)
