"""`tormagctl calibrate`: the running daemon asks the device for forces, so all its limits apply.

--device  the daemon learns while it drives: forces over the whole range, a handle that reverses often enough for
          the sensor's zero, and steps that show how good the profile is, in under a minute
--insert  sweeps of the force, for `tormag-lab calibrate`
--motors  a log of one motor's voltage, current and motion, for `tormag-lab identify-motor`: slow ramps show
          friction, fast ones the speed term, jumps the inertia
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np

from tormagd.commission.finding import Array
from tormagd.commission.force_findings import RAMPS_S, STEP_S, STEP_SHARES, force_over_gap, steps
from tormagd.commission.procedure import CLEAR_N, Columns, Known, handle_moved
from tormagd.config import Config
from tormagd.ctl.calibrate_run import SOURCE, Run, armed, known_of, reach
from tormagd.ctl.operate import statuses
from tormagd.ctl.outcome import (
    NEW_FILE,
    WRITABLE,
    CommandError,
    Exit,
    Outcome,
    as_usage_error,
    is_terminal,
    usage_error,
)
from tormagd.ctl.waveform import Waveform, by_legs
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.inserts import insert
from tormagd.ground.files import new_file
from tormagd.ground.terminal import write_line
from tormagd.scenes.scene import Scene, load_scene
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ConfigError, Endpoints
from tormagd_client.messages import ProfileReport, Status

Side: TypeAlias = Literal["left", "right"]
SWEPT_COLUMNS = ("monotonic_s", "left_mm", "right_mm", "handle_mm", "handle_rate_mm_s", "measured_cf")
SWEEP_COLUMNS = ("time_s", "sweep", "gap_mm", "handle_mm", "rate_mm_s", "force_N")
EVERY = 4
"Neighbouring ticks are nearly the same."

PACES = ("steadily, about 20 turns a minute", "slowly, about 10 turns a minute", "quickly, about 25 turns a minute")


def calibrate_insert(
    config: Config,
    endpoints: Endpoints,
    scene: Scene,
    insert_name: str,
    out: Path,
    rates_N_s: Sequence[float],
    wait_s: float,
) -> Outcome:
    """Sweep the force up and down at each rate, and write the sweeps of this insert as CSV."""
    with as_usage_error(DomainError, hint="give the insert that is fitted"):
        insert(insert_name)
    with Client(endpoints, wait_s, SOURCE) as client:
        known = known_of(config, client.status(), scene.force.most_N)
        with armed(endpoints, client, known.least_N) as run:
            sweeps = [_sweep(run, known, number, rates_N_s) for number in range(len(rates_N_s))]
    rows = write_sweeps(out, sweeps)
    fitting = f"tormag-lab calibrate {out} --insert {insert_name} --out MODEL.safetensors"
    text = f"{out}: {rows} rows of {len(sweeps)} sweeps. next: {fitting}"
    return Outcome({"file": str(out), "insert": insert_name, "rows": rows}, text)


def _sweep(run: Run, known: Known, number: int, rates_N_s: Sequence[float]) -> Columns:
    """Ask for a moving handle, then play one sweep and return its ticks."""
    waveform = up_and_down(known.least_N, known.most_N, rates_N_s[number])
    sweep = f"sweep {number + 1} of {len(rates_N_s)}"
    write_line(f"{sweep}: turn the handle to and fro {PACES[number % len(PACES)]}", sys.stderr)
    run.follow(handle_moved(known.least_N))
    run.progress.begin(sweep, waveform.duration_s)
    return run.play(waveform)


def up_and_down(least_N: float, most_N: float, rate_N_s: float) -> Waveform:
    half_s = (most_N - least_N) / rate_N_s
    return by_legs(least_N, [(half_s, most_N), (half_s, least_N)])


def write_sweeps(path: Path, sweeps: Sequence[Columns]) -> int:
    """Write the ticks of all sweeps to a new file, and return how many rows they give."""
    start_s = min((float(sweep["monotonic_s"][0]) for sweep in sweeps if sweep["monotonic_s"].size), default=0.0)
    rows = []
    for number, sweep in enumerate(sweeps):
        ticks = np.column_stack([sweep[name] for name in SWEPT_COLUMNS])
        time_s, left_mm, right_mm, *others = ticks[np.isfinite(ticks).all(axis=1)][::EVERY].T
        rows.append(np.column_stack([time_s - start_s, np.full_like(time_s, number), left_mm + right_mm, *others]))
    return _saved(path, np.concatenate(rows), "%.9g", SWEEP_COLUMNS)


def _saved(path: Path, table: Array, form: str, names: Sequence[str]) -> int:
    """Write a new CSV file, and return its number of rows."""
    with as_usage_error(OSError, hint=WRITABLE), new_file(path):
        np.savetxt(path, table, form, ",", header=",".join(names), comments="")
    return len(table)


def calibrate(
    config: Config,
    endpoints: Endpoints,
    wait_s: float,
    device: bool,
    insert: str | None,
    motors: bool,
    out: Path | None,
    rates_N_s: Sequence[float],
    side: Side,
    is_agreed: bool,
) -> Outcome:
    """Calibrate the device, an `insert`, or the `motors`, with a person's agreement."""
    if [insert is not None, motors, device].count(True) != 1:
        raise usage_error("calibrate takes one of three things", "give one of --insert NAME, --motors and --device")
    if device is (out is not None):
        raise usage_error(
            "--out is not for --device" if device else "--out is missing: the file of the sweeps or the log",
            "leave it out: the daemon keeps the profile" if device else "give --out FILE",
        )
    if out is not None and (out.exists() or not out.parent.is_dir()):
        raise usage_error(f"--out {out}: {NEW_FILE}", "give another name; nothing is overwritten")
    with as_usage_error(ConfigError, hint="correct the scene, or give the daemon's own --config"):
        scene = load_scene(config.scene)
    if not is_agreed:
        agree()
    most_N = scene.force.most_N
    if out is None:
        return calibrate_device(config, endpoints, most_N, wait_s)
    if insert is None:
        return calibrate_motors(endpoints, most_N, out, side, wait_s)
    return calibrate_insert(config, endpoints, scene, insert, out, rates_N_s, wait_s)


def agree() -> None:
    """Say that the carriages will move, and wait until a person presses Enter."""
    if not is_terminal(sys.stdin):
        raise usage_error("stdin is no terminal: nobody can agree to the carriages moving", "a script says --yes")
    print("The device homes where needed, enables, and moves its carriages. Press Enter, or Ctrl-C.", file=sys.stderr)
    if not sys.stdin.readline():
        raise usage_error("input ended: nobody agreed to the carriages moving", "press Enter to agree")


KEPT_WITHIN_S = 5.0
DOUBTS = ("SENSOR", "OFFSET_UNKNOWN")


def calibrate_device(config: Config, endpoints: Endpoints, scene_most_N: float, wait_s: float) -> Outcome:
    with Client(endpoints, wait_s, SOURCE) as client:
        status = client.status()
        if not status.profile.folder:
            raise _not_kept(status.profile)
        known = known_of(config, status, scene_most_N)
        with armed(endpoints, client, known.force_N(0.0)) as run:
            write_line("turn the handle to and fro, about 20 turns a minute, until the gap opens", sys.stderr)
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
    for waited_s, status in statuses(client, KEPT_WITHIN_S):
        if status.profile.refusal:
            break
        if status.profile.age_s is not None and status.profile.age_s < waited_s + 1.0:
            return status.profile
    raise _not_kept(status.profile)


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


MOTOR_COLUMNS = (
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

MOTOR_RAMPS_S = (12.0, 6.0, 3.0)
"Up, then the same time down."
JUMP_SHARES = (0.0, 0.5, 0.2, 0.8, 0.35, 1.0, 0.6, 0.9, 0.1, 0.7, 0.3, 0.55, 0.0)
"Shares of the range: small and large jumps, up and down, over the whole stroke."
JUMP_S = 0.6
ROUNDS = 2
"One half is fitted, the other judges."
MIN_HZ = 900.0
"A log of 500 Hz makes a motor's delay wrong and the rest less exact."
LONGEST_HOLE_S = 0.02


def excitation(least_N: float, most_N: float, rounds: int = ROUNDS) -> Waveform:
    """Return the waveform to ask for: ramps, then jumps, `rounds` times."""
    low_N = least_N + CLEAR_N
    ramps = [(ramp_s, force_N) for ramp_s in MOTOR_RAMPS_S for force_N in (most_N, low_N)]
    # each takes a millisecond, and is held
    jumps = [(lasts_s, low_N + share * (most_N - low_N)) for share in JUMP_SHARES for lasts_s in (1e-3, JUMP_S)]
    return by_legs(low_N, rounds * (ramps + jumps))


def calibrate_motors(endpoints: Endpoints, scene_most_N: float, path: Path, side: Side, wait_s: float) -> Outcome:
    """Drive both carriages through `excitation`, and write the log of one as CSV."""
    with Client(endpoints, wait_s, SOURCE) as client:
        status = client.status()
        waveform = excitation(*reach(status, scene_most_N))
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
    rows = _saved(path, np.column_stack([log[name] for name in LOG_COLUMNS]), "%.6f", LOG_COLUMNS)
    result = {"file": str(path), "side": side, "rows": rows, "seconds": round(float(log["t_s"][-1]), 3)}
    text = f"{path}: {rows} rows of the {side} carriage. next: tormag-lab identify-motor {path}"
    return Outcome(result, text)


def motor_log(ticks: Columns, side: Side) -> Columns:
    """Return the motor log of one side, evenly spaced on the device's clock."""
    known = np.isfinite(np.column_stack([ticks[name] for name in MOTOR_COLUMNS])).all(axis=1)
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
    column = {name: ticks[name][known][fresh] for name in MOTOR_COLUMNS}
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
