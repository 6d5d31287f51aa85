"""`tormagctl calibrate --motors`: a log of one motor's voltage, current and motion, for `tormag-lab identify-motor`.

It asks for forces, so all limits of the daemon apply. They are chosen for the motion they cause: slow ramps show
friction, fast ones the speed term, jumps the inertia.
"""

from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from tormagd.commission.procedure import Columns
from tormagd.ctl.calibrate_run import SOURCE, Range, armed, reach
from tormagd.ctl.outcome import WRITABLE, CommandError, Exit, Outcome, as_usage_error
from tormagd.ctl.waveform import Waveform, by_legs
from tormagd.ground.files import new_file
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints

Side: TypeAlias = Literal["left", "right"]

COLUMNS = (
    "device_time_s",
    "left_duty",
    "right_duty",
    "supply_V",
    "left_mm",
    "right_mm",
    "left_current_A",
    "right_current_A",
    "measured_cf",
    "reference_gap_mm",
)
LOG_COLUMNS = ("t_s", "input_V", "position_mm", "current_A", "force_N", "reference_mm")

CLEAR_N = 0.1
"At the open end the firmware holds back a duty that would push on."
RAMPS_S = (12.0, 6.0, 3.0)
"Up, then the same time down."
JUMP_SHARES = (0.0, 0.5, 0.2, 0.8, 0.35, 1.0, 0.6, 0.9, 0.1, 0.7, 0.3, 0.55, 0.0)
"Shares of the range: small and large jumps, up and down, over the whole stroke."
JUMP_S = 0.6
ROUNDS = 2
"One half is fitted, the other judges."
MIN_HZ = 900.0
"A log of 500 Hz makes a motor's delay wrong and the rest less exact."
LONGEST_HOLE_S = 0.02


def excitation(forces: Range, rounds: int = ROUNDS) -> Waveform:
    """Return the waveform to ask for: ramps, then jumps, `rounds` times."""
    low_N, high_N = forces.least_N + CLEAR_N, forces.most_N
    ramps = [(ramp_s, force_N) for ramp_s in RAMPS_S for force_N in (high_N, low_N)]
    # each takes a millisecond, and is held
    jumps = [(lasts_s, low_N + share * (high_N - low_N)) for share in JUMP_SHARES for lasts_s in (1e-3, JUMP_S)]
    return by_legs(low_N, rounds * (ramps + jumps))


def calibrate_motors(endpoints: Endpoints, scene_most_N: float, path: Path, side: Side, wait_s: float) -> Outcome:
    """Drive both carriages through `excitation`, and write the log of one as CSV."""
    with Client(endpoints, wait_s, SOURCE) as client:
        status = client.status()
        waveform = excitation(reach(status, scene_most_N))
        hz = status.rates["control"].hz
        if hz < MIN_HZ:
            raise CommandError(
                Exit.REFUSED,
                "slow_control",
                f"the daemon controls {hz:.0f} times a second: allowed for a motor log is 1000",
                "state control_hz = 1000 under [rates] in its configuration, and start it again; where it stands "
                "there, tormagctl doctor",
            )
        with armed(endpoints, client, waveform.least_N) as run:
            run.progress.begin("motors", waveform.duration_s)
            columns = run.play(waveform)
    log = motor_log(columns, side)
    rows = len(log["t_s"])
    with as_usage_error(OSError, hint=WRITABLE), new_file(path):
        table = np.column_stack([log[name] for name in LOG_COLUMNS])
        np.savetxt(path, table, "%.6f", ",", header=",".join(LOG_COLUMNS), comments="")
    result = {"file": str(path), "side": side, "rows": rows, "seconds": round(float(log["t_s"][-1]), 3)}
    text = f"{path}: {rows} rows of the {side} carriage. next: tormag-lab identify-motor {path}"
    return Outcome(result, text)


def motor_log(ticks: Columns, side: Side) -> Columns:
    """Return the motor log of one side, evenly spaced on the device's clock."""
    known = np.isfinite(np.column_stack([ticks[name] for name in COLUMNS])).all(axis=1)
    time_s = ticks["device_time_s"][known]
    # of ticks with the same measurement, the device follows the last one's duty
    fresh = np.append(np.diff(time_s) > 0.0, True)[: len(time_s)]
    time_s = time_s[fresh]
    holes = np.diff(time_s)
    if len(time_s) < 2 or holes.max() > LONGEST_HOLE_S:
        longest = "no measurements" if len(time_s) < 2 else f"a silence of {holes.max() * 1e3:.0f} ms"
        raise CommandError(
            Exit.REFUSED,
            "holes",
            f"{longest} in the ticks: allowed are {LONGEST_HOLE_S * 1e3:.0f} ms",
            "run it again on a machine with less load; tormagctl doctor",
        )
    column = {name: ticks[name][known][fresh] for name in COLUMNS}
    period_s = float(np.median(holes))
    even_s = np.arange(time_s[0], time_s[-1], period_s)
    held = np.searchsorted(time_s, even_s + period_s / 2.0, side="right") - 1
    volts = column[f"{side}_duty"] * column["supply_V"]
    straight = {
        "position_mm": column[f"{side}_mm"],
        "current_A": column[f"{side}_current_A"],
        "force_N": column["measured_cf"],
        "reference_mm": column["reference_gap_mm"] / 2.0,
    }
    return {
        "t_s": even_s - even_s[0],
        "input_V": volts[held],
        **{name: np.interp(even_s, time_s, values) for name, values in straight.items()},
    }
