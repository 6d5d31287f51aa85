"""`tormagctl calibrate --device`: the running daemon learns this device in under a minute and keeps it as its profile.

Nothing is fitted here: the daemon learns while it drives. This program gives it the occasion: forces over the whole
range, and a handle that reverses often enough for the sensor's zero. Steps then say how good the profile is.
"""

import sys
import time
from typing import Any

import msgspec
import numpy as np

from tormagd.ctl.calibrate_run import MOVING_MM_S, SOURCE, Columns, Range, armed, reach, seconds_bar
from tormagd.ctl.outcome import CommandError, Exit, Outcome
from tormagd.ctl.waveform import Sample, Waveform, by_legs
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.messages import ProfileReport, Status

COLUMNS = ("monotonic_s", "measured_cf", "handle_rate_mm_s")
"Columns of the control ticks by which the steps are judged."

CLEAR_N = 0.1
"Distance kept from F_min, which grows where the device proves stronger."
RAMPS_S = (6.0, 4.0, 4.0)
"Time from the least to the most force; then the same time back."
STEP_SHARES = (1.0, 0.0, 0.5, 1.0, 0.25, 0.75)
"Levels of the steps that judge, as shares of the range: none was held before."
STEP_S = 2.0
ARRIVED_S = 1.0
"Time at the start of every step that is left to the carriages and the fit."
MIN_SLIDING = 0.3
"A handle that moves for less than this share of the time has taught little."
KEPT_WITHIN_S = 5.0
DOUBTS = ("SENSOR", "OFFSET_UNKNOWN")


def lesson(forces: Range) -> tuple[Waveform, Waveform]:
    """Return two waveforms: RAMPS_S up and down, by which the device shows itself, and STEP_SHARES that judge what was
    learned.

    Both lie between CLEAR_N above the least force and the most; each step is held for STEP_S.
    """
    low_N = forces.least_N + CLEAR_N
    ramps = [(ramp_s, force_N) for ramp_s in RAMPS_S for force_N in (forces.most_N, low_N)]
    levels_N = [low_N + share * (forces.most_N - low_N) for share in STEP_SHARES]

    def on_steps(t_s: float) -> Sample:
        return Sample(levels_N[min(int(t_s / STEP_S), len(levels_N) - 1)])

    return by_legs(low_N, ramps), Waveform(STEP_S * len(levels_N), on_steps, low_N, forces.most_N)


def calibrate_device(endpoints: Endpoints, scene_most_N: float, wait_s: float) -> Outcome:
    """Let the daemon learn the device, judge it by steps, and wait until its profile is kept. The gap opens in the end.

    `scene_most_N` is the greatest force to ask for. The outcome holds serial number, what was learned, the figures of
    `judged`, and the profile's folder. Raises as `reach`, `armed`, `Run.wait_for_handle` and `Run.play`. Raises
    CommandError (REFUSED) where no profile is kept, the handle hardly moves, or the daemon doubts the force sensor.
    """
    with Client(endpoints, wait_s, SOURCE) as client:
        profile = client.status().profile
        if not profile.folder:
            raise _not_kept(profile)
        learning, judging = lesson(reach(client, scene_most_N))
        with armed(endpoints, client, COLUMNS, wait_s) as run:
            print("turn the handle to and fro, about 20 turns a minute, until the gap opens", file=sys.stderr)
            run.wait_for_handle(learning.at(0.0).force_N)
            with seconds_bar(learning.duration_s + judging.duration_s, "device") as bar:
                require_sliding(run.play(learning, bar))
                steps = run.play(judging, bar)
            status = client.status()
            require_believed(status)
        known = {"serial_number": status.link.serial_number, **msgspec.to_builtins(status.device)}
        result = known | judged(steps, judging, status.device.sensor_zero_N)
        result["profile"] = _kept(client).folder
    return Outcome(result, _text(result))


def judged(steps: Columns, waveform: Waveform, zero_N: float) -> dict[str, Any]:
    """Return how far the measured force is from the asked one on the steps, by keys of `--json`.

    `steps` counts those with a moving handle. Of each, ticks count after ARRIVED_S while the handle slides.
    `mean_error_N`, measured less asked, and `worst_error_N`, a size, are over the steps' means, less `zero_N`.
    `noise_N` is the median standard deviation within a step. Raises CommandError (REFUSED) where the handle hardly
    moved.
    """
    require_sliding(steps)
    begin_s = float(steps["monotonic_s"][0])
    since_s = steps["monotonic_s"] - begin_s
    moving = _sliding(steps) & np.isfinite(steps["measured_cf"])
    errors: list[float] = []
    noises: list[float] = []
    for start_s in np.arange(0.0, waveform.duration_s, STEP_S):
        arrived = moving & (since_s >= start_s + ARRIVED_S) & (since_s < start_s + STEP_S)
        if arrived.any():
            force_N = steps["measured_cf"][arrived] - zero_N
            errors.append(float(force_N.mean()) - waveform.at(float(start_s)).force_N)
            noises.append(float(force_N.std()))
    if not errors:
        raise _still(0.0)
    return {
        "steps": len(errors),
        "mean_error_N": round(float(np.mean(errors)), 4),
        "worst_error_N": round(max(max(errors), -min(errors)), 4),
        "noise_N": round(float(np.median(noises)), 4),
    }


def require_sliding(ticks: Columns) -> None:
    """Raise CommandError (REFUSED) where the handle moved for less than MIN_SLIDING of the ticks."""
    share = float(_sliding(ticks).mean()) if ticks["handle_rate_mm_s"].size else 0.0
    if share < MIN_SLIDING:
        raise _still(share)


def require_believed(status: Status) -> None:
    """Raise CommandError (REFUSED) where the daemon doubts the force sensor, by a limit of DOUBTS: then nothing was
    learned."""
    doubt = next((limit for limit in status.limit_details if limit.code in DOUBTS), None)
    if doubt is not None:
        raise CommandError(
            Exit.REFUSED, "sensor_doubted", f"{doubt.code}: {doubt.cause}: no profile is kept", doubt.remedy
        )


def _sliding(ticks: Columns) -> "np.ndarray[Any, np.dtype[np.bool_]]":
    return np.abs(ticks["handle_rate_mm_s"]) >= MOVING_MM_S


def _still(share: float) -> CommandError:
    """Return the error (REFUSED) for a handle that moved for only this share of the time."""
    return CommandError(
        Exit.REFUSED,
        "handle_still",
        f"the handle moved in {share:.0%} of the time: needed are {MIN_SLIDING:.0%}, at {MOVING_MM_S:g} mm/s",
        "turn it to and fro until the gap opens",
    )


def _kept(client: Client) -> ProfileReport:
    """Wait until the daemon has written the profile anew, and return its report; one written up to a second before
    counts.

    Raises CommandError (REFUSED) where the daemon says that it cannot write it, or has not within KEPT_WITHIN_S.
    """
    began_s = time.monotonic()
    while True:
        profile = client.status().profile
        if profile.age_s is not None and profile.age_s < time.monotonic() - began_s + 1.0 and not profile.refusal:
            return profile
        if profile.refusal or time.monotonic() - began_s > KEPT_WITHIN_S:
            raise _not_kept(profile)
        time.sleep(0.05)


def _not_kept(profile: ProfileReport) -> CommandError:
    """Return the error (REFUSED) for a daemon that keeps no profile, with the reason that `profile` gives."""
    return CommandError(
        Exit.REFUSED,
        "not_kept",
        f"no profile is kept: {profile.refusal or 'the daemon has written none'}",
        "name a folder that the daemon may write to in [device] profiles, and start it again",
    )


def _text(result: dict[str, Any]) -> str:
    """Say what the device showed of itself, how well the steps were followed, and where the profile is.

    `result` is that of `calibrate_device`: serial number, belief, the figures of `judged`, profile. Forces are told in
    mN.
    """
    return (
        f"device {result['serial_number']}: {result['scale']:.3f} +- {result['scale_sd']:.3f} times the model's force, "
        f"{result['offset_N'] * 1e3:+.0f} +- {result['offset_sd_N'] * 1e3:.0f} mN; its sensor reads "
        f"{result['sensor_zero_N'] * 1e3:+.0f} +- {result['sensor_zero_sd_N'] * 1e3:.0f} mN without a force\n"
        f"{result['steps']} steps, by that sensor: {result['mean_error_N'] * 1e3:+.0f} mN off in the mean, "
        f"{result['worst_error_N'] * 1e3:.0f} at worst (its noise: {result['noise_N'] * 1e3:.0f})\n"
        f"kept in {result['profile']}; the daemon begins with it the next time"
    )
