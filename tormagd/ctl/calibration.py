"""`tormagctl calibrate`: which of the three it is to be, and whether a person agrees to the carriages moving."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from tormagd.config import Config
from tormagd.ctl.calibrate import calibrate, require_new
from tormagd.ctl.calibrate_device import calibrate_device
from tormagd.ctl.calibrate_motors import calibrate_motors
from tormagd.ctl.outcome import Outcome, is_terminal, usage_error
from tormagd.scenes.scene import load_scene
from tormagd_client.endpoints import ConfigError, Endpoints


def calibration(
    config: Config,
    endpoints: Endpoints,
    wait_s: float,
    device: bool,
    insert: str | None,
    motors: bool,
    out: Path | None,
    csv: Path | None,
    rates_N_s: Sequence[float],
    side: Literal["left", "right"],
    is_agreed: bool,
) -> Outcome:
    """Of a device, an insert, or the motors. Raises CommandError: USAGE for options that do not fit each other and for
    a faulty scene, and as the three do."""
    if [insert is not None, motors, device].count(True) != 1:
        raise usage_error("give one of --insert NAME, --motors and --device", "tormagctl calibrate --help shows them")
    if insert is None and csv is not None:
        raise usage_error("--csv is the training data of an insert", "with --motors, --out is the log")
    if device is (out is not None):
        raise usage_error(
            "--out is the file of a model or of a log",
            "leave it out: the daemon keeps the profile" if device else "give one",
        )
    for name, path in (("--out", out), ("--csv", csv)):
        if path is not None:
            require_new(path, name)
    try:
        scene = load_scene(config.scene)
    except ConfigError as error:
        raise usage_error(str(error), "correct the scene, or give the daemon's own --config") from error
    if not is_agreed:
        _agree()
    most_N = scene.force.most_N
    if out is None:
        return calibrate_device(endpoints, most_N, wait_s)
    if insert is None:
        return calibrate_motors(endpoints, most_N, out, side, wait_s)
    return calibrate(endpoints, scene, insert, out, csv, rates_N_s, wait_s)


def _agree() -> None:
    """Armed on purpose: a person agrees, or a script says --yes."""
    if not is_terminal(sys.stdin):
        raise usage_error("nobody can agree to the carriages moving", "a script says --yes")
    print("The device homes where needed, enables, and moves its carriages. Press Enter, or Ctrl-C.", file=sys.stderr)
    sys.stdin.readline()
