"""From the publisher's setpoint to the force that will be asked of the device, with the reason for every difference."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tormagd.config import Limits
from tormagd.control.device_fit import DeviceFit
from tormagd.control.periodicity import LONGEST_STEP_S, NOTHING_LEARNED, Periodicity, forecast_N, observe
from tormagd.control.portrait import Portrait
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Force

Array = npt.NDArray[np.float64]

SLOPE_FILTER_S = 0.003
AHEAD_S = 0.05
"Setpoints are carried forward along their slope, or past the end of their preview, by no more than this."
PATH_S = np.linspace(0.0, 0.03, 7)
"The times, from the moment that is planned for, at which a plan looks at the force to come."
PATH_S.flags.writeable = False


class TimedSetpoint(NamedTuple):
    """The newest valid setpoint. `stamp_s` is when the publisher meant it, on the clock of `now_s`; `preview_N` are the
    forces that follow it, `preview_dt_s` apart.
    """

    force_N: float
    stamp_s: float
    valid_for_s: float
    displacement_mm: float | None = None
    rate_mm_s: float | None = None
    preview_N: tuple[float, ...] = ()
    preview_dt_s: float = 0.0


class GovernorState(NamedTuple):
    """What the governor remembers between plans."""

    time_s: float
    governed_N: float
    stamp_s: float = float("-inf")
    slope_N_s: float = 0.0
    last_N: float = 0.0
    periodicity: Periodicity = NOTHING_LEARNED


class Governed(NamedTuple):
    """The force to render now, what it will be PATH_S after the moment that is planned for, and what holds it back.

    `foresight`, 0..1, is how well what comes is known: 1 from a preview, less where the force repeats itself, 0 where
    it is extrapolated.
    """

    force_N: float
    path_N: Array
    age_s: float | None
    limits: tuple[Limit, ...]
    foresight: float = 0.0


def govern(
    state: GovernorState,
    now_s: float,
    setpoint: TimedSetpoint | None,
    *,
    portrait: Portrait,
    device: DeviceFit,
    scene: Force,
    limits: Limits,
    gap_speed_mm_s: float,
    lead_s: float,
    lag_s: float,
) -> tuple[GovernorState, Governed]:
    """One decision, for `lead_s` from now and, where what comes is known, up to `lag_s` later: an extrapolation that
    far is a guess. The force is within what the scene allows and `device`, as far as it has shown itself, gives. A
    missing or stale setpoint decays to F_min along `limits.stale_ramp_N_s`: never a jump, never a force held for ever.
    """
    elapsed = max(0.0, now_s - state.time_s)
    lowest, highest = max(device.force_N(portrait.least_N), 0.0), max(device.force_N(portrait.most_N), 0.0)
    age = None if setpoint is None else now_s - setpoint.stamp_s
    if setpoint is None or age is None or age > setpoint.valid_for_s:
        reason = Limit.NO_SETPOINT if setpoint is None else Limit.STALE
        force = max(lowest, state.governed_N - limits.stale_ramp_N_s * elapsed)
        rested = GovernorState(now_s, force)
        return rested, Governed(force, np.full(len(PATH_S), force), age, (reason,))
    force, reasons = _within_range(setpoint.force_N, lowest, highest, scene)
    slope = state.slope_N_s
    spacing = setpoint.stamp_s - state.stamp_s
    if spacing > LONGEST_STEP_S:
        slope = 0.0
    elif spacing > 0.0:
        renderable = device.scale * portrait.force_rate_N_s(device.model_N(force), gap_speed_mm_s)
        between = min(max((force - state.last_N) / spacing, -renderable), renderable)
        slope += spacing / (SLOPE_FILTER_S + spacing) * (between - slope)
    least, most = min(max(scene.least_N, lowest), highest), min(max(scene.most_N, lowest), highest)
    soon_s = max(age, 0.0) + lead_s
    if setpoint.preview_N:
        periodicity, foresight = NOTHING_LEARNED, 1.0
        path = _previewed(setpoint, soon_s + lag_s + PATH_S)
    else:
        periodicity = observe(state.periodicity, setpoint.stamp_s, force, slope)
        # one that has fallen silent for longer than a stream may is not believed to go on as it did
        foresight = periodicity.trust if age <= LONGEST_STEP_S else 0.0
        ahead_s = soon_s + foresight * lag_s + PATH_S
        path = force + slope * np.minimum(ahead_s, AHEAD_S)
        if foresight > 0.0:
            path += foresight * (forecast_N(periodicity, ahead_s) - path)
    within = np.minimum(np.maximum(path, least), most)
    rendered = GovernorState(now_s, force, setpoint.stamp_s, slope, force, periodicity)
    return rendered, Governed(force, within, age, reasons, foresight)


def _previewed(setpoint: TimedSetpoint, ahead_s: Array) -> Array:
    """The forces at these times after the setpoint's stamp."""
    known_N = np.array([setpoint.force_N, *setpoint.preview_N])
    known_s = setpoint.preview_dt_s * np.arange(len(known_N))
    mean_N_s = (known_N[-1] - known_N[0]) / known_s[-1]
    beyond_s = np.clip(ahead_s - known_s[-1], 0.0, AHEAD_S)
    # past its end a short preview goes on as it has run so far; a long one has no end in sight
    to_come: Array = np.interp(ahead_s, known_s, known_N) + mean_N_s * np.minimum(beyond_s, known_s[-1])
    return to_come


def _within_range(asked_N: float, lowest_N: float, highest_N: float, scene: Force) -> tuple[float, tuple[Limit, ...]]:
    """The force nearest the one asked that the scene allows and the device gives: never over `scene.most_N`, unless the
    open gap itself makes more."""
    reasons: list[Limit] = []
    force = min(max(asked_N, scene.least_N), scene.most_N)
    if force != asked_N:
        reasons.append(Limit.RANGE)
    if force < lowest_N:
        force = lowest_N
        reasons.append(Limit.F_MIN)
    elif force > highest_N:
        force = highest_N
        reasons.append(Limit.F_MAX)
    return force, tuple(reasons)
