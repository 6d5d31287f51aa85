"""`tormagctl calibrate --device`: the running daemon learns this device in under a minute and keeps its profile.

The daemon learns while it drives. This program gives it the occasion: forces over the whole range, and a handle that
reverses often enough for the sensor's zero. Steps then show how good the profile is.
"""

import sys
import time
from typing import Any

import msgspec

from tormagd.commission.force_findings import RAMPS_S, STEP_S, STEP_SHARES, force_over_gap, steps
from tormagd.config import Config
from tormagd.ctl.calibrate_run import SOURCE, armed, known_of
from tormagd.ctl.outcome import CommandError, Exit, Outcome
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.messages import ProfileReport, Status

KEPT_WITHIN_S = 5.0
DOUBTS = ("SENSOR", "OFFSET_UNKNOWN")


def calibrate_device(config: Config, endpoints: Endpoints, scene_most_N: float, wait_s: float) -> Outcome:
    with Client(endpoints, wait_s, SOURCE) as client:
        status = client.status()
        if not status.profile.folder:
            raise _not_kept(status.profile)
        known = known_of(config, status, scene_most_N)
        with armed(endpoints, client, known.force_N(0.0)) as run:
            print("turn the handle to and fro, about 20 turns a minute, until the gap opens", file=sys.stderr)
            run.progress.begin("device", 2.0 * sum(RAMPS_S) + STEP_S * len(STEP_SHARES))
            run.follow(force_over_gap(known))
            mean, worst, *_ = run.follow(steps(known))
            status = client.status()
            require_believed(status)
        result = {"serial_number": status.link.serial_number, **msgspec.to_builtins(status.device)}
        result |= {"steps": len(STEP_SHARES), "mean_error_N": _in_N(mean.value), "worst_error_N": _in_N(worst.value)}
        result["profile"] = _kept(client).folder
    return Outcome(result, _text(result))


def _in_N(value_mN: float | None) -> float:
    return round((value_mN or 0.0) * 1e-3, 4)


def require_believed(status: Status) -> None:
    """Raise CommandError if the daemon doubts the force sensor, and so has learned nothing."""
    doubt = next((limit for limit in status.limit_details if limit.code in DOUBTS), None)
    if doubt is not None:
        raise CommandError(
            Exit.REFUSED, "sensor_doubted", f"{doubt.code}: {doubt.cause}: no profile is kept", doubt.remedy
        )


def _kept(client: Client) -> ProfileReport:
    began_s = time.monotonic()
    while True:
        profile = client.status().profile
        if profile.age_s is not None and profile.age_s < time.monotonic() - began_s + 1.0 and not profile.refusal:
            return profile
        if profile.refusal or time.monotonic() - began_s > KEPT_WITHIN_S:
            raise _not_kept(profile)
        time.sleep(0.05)


def _not_kept(profile: ProfileReport) -> CommandError:
    return CommandError(
        Exit.REFUSED,
        "not_kept",
        f"no profile is kept: {profile.refusal or 'the daemon has written none'}",
        "name a folder that the daemon may write to in [device] profiles, and start it again",
    )


def _text(result: dict[str, Any]) -> str:
    return (
        f"device {result['serial_number']}: {result['scale']:.3f} +- {result['scale_sd']:.3f} times the model's force, "
        f"{result['offset_N'] * 1e3:+.0f} +- {result['offset_sd_N'] * 1e3:.0f} mN; its sensor reads "
        f"{result['sensor_zero_N'] * 1e3:+.0f} +- {result['sensor_zero_sd_N'] * 1e3:.0f} mN without a force\n"
        f"{result['steps']} steps, by that sensor: {result['mean_error_N'] * 1e3:+.0f} mN off in the mean, "
        f"{result['worst_error_N'] * 1e3:.0f} at worst\n"
        f"kept in {result['profile']}; the daemon begins with it the next time"
    )
