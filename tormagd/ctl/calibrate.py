"""`tormagctl calibrate`: choose what is calibrated; for an insert, sweep the force for `tormag-lab calibrate`.

The sweep asks for forces through the running daemon, so all its limits apply.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from tormagd.commission.procedure import Columns, handle_moved
from tormagd.config import Config
from tormagd.ctl.calibrate_device import calibrate_device
from tormagd.ctl.calibrate_motors import calibrate_motors
from tormagd.ctl.calibrate_run import SOURCE, Range, Run, armed, known_of
from tormagd.ctl.outcome import WRITABLE, Outcome, as_usage_error, is_terminal, usage_error
from tormagd.ctl.waveform import Waveform, by_legs
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.inserts import insert
from tormagd.ground.files import new_file
from tormagd.scenes.scene import Scene, load_scene
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ConfigError, Endpoints

COLUMNS = ("monotonic_s", "left_mm", "right_mm", "handle_mm", "handle_rate_mm_s", "measured_cf")
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
        forces = Range(known.least_N, known.most_N)
        with armed(endpoints, client, forces.least_N) as run:
            sweeps = [_sweep(run, forces, number, rates_N_s) for number in range(len(rates_N_s))]
    rows = write_sweeps(out, sweeps)
    fitting = f"tormag-lab calibrate {out} --insert {insert_name} --out MODEL.safetensors"
    text = f"{out}: {rows} rows of {len(sweeps)} sweeps. next: {fitting}"
    return Outcome({"file": str(out), "insert": insert_name, "rows": rows}, text)


def _sweep(run: Run, forces: Range, number: int, rates_N_s: Sequence[float]) -> Columns:
    """Ask for a moving handle, then play one sweep and return its ticks."""
    waveform = up_and_down(forces, rates_N_s[number])
    label = f"sweep {number + 1} of {len(rates_N_s)}"
    print(f"{label}: turn the handle to and fro {PACES[number % len(PACES)]}", file=sys.stderr)
    run.follow(handle_moved(forces.least_N))
    run.progress.begin(label, waveform.duration_s)
    return run.play(waveform)


def up_and_down(forces: Range, rate_N_s: float) -> Waveform:
    half_s = (forces.most_N - forces.least_N) / rate_N_s
    return by_legs(forces.least_N, [(half_s, forces.most_N), (half_s, forces.least_N)])


def write_sweeps(path: Path, sweeps: Sequence[Columns]) -> int:
    """Write the ticks of all sweeps to a new file, and return how many rows they give."""
    start_s = min((float(sweep["monotonic_s"][0]) for sweep in sweeps if sweep["monotonic_s"].size), default=0.0)
    rows = []
    for number, sweep in enumerate(sweeps):
        ticks = np.column_stack([sweep[name] for name in COLUMNS])
        time_s, left_mm, right_mm, *others = ticks[np.isfinite(ticks).all(axis=1)][::EVERY].T
        rows.append(np.column_stack([time_s - start_s, np.full_like(time_s, number), left_mm + right_mm, *others]))
    table = np.concatenate(rows)
    with as_usage_error(OSError, hint=WRITABLE), new_file(path):
        np.savetxt(path, table, "%.9g", ",", header=",".join(SWEEP_COLUMNS), comments="")
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
    side: Literal["left", "right"],
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
    if insert is not None and out is not None and out.suffix != ".csv":
        raise usage_error(f"--out {out}: allowed is a name that ends with .csv", "tormag-lab calibrate fits the model")
    if out is not None and out.exists():
        raise usage_error(f"--out {out} exists", "give another name; nothing is overwritten")
    if out is not None and not out.parent.is_dir():
        raise usage_error(f"--out {out}: {out.parent} is not a directory", "give a file in one you may write to")
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
