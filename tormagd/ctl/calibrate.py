"""`tormagctl calibrate`: choose what is calibrated; for an insert, sweep the force and have a model fitted.

The sweep asks for forces through the running daemon, so all its limits apply. A process of its own (`FITTING`) makes
training data of it, fits, judges and saves: neither the daemon nor this program loads the training.
"""

import csv
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from tormagd.commission.procedure import Columns, handle_moved
from tormagd.config import Config
from tormagd.ctl.calibrate_device import calibrate_device
from tormagd.ctl.calibrate_motors import calibrate_motors
from tormagd.ctl.calibrate_run import SOURCE, Range, Run, armed, interrupted_run, known_of
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, is_terminal, usage_error
from tormagd.ctl.waveform import Waveform, by_legs
from tormagd.ground.terminal import interrupted_by
from tormagd.scenes.scene import Scene, load_scene
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ConfigError, Endpoints

COLUMNS = ("monotonic_s", "left_mm", "right_mm", "handle_mm", "handle_rate_mm_s", "measured_cf")
FILE_COLUMNS = ("time_s", "sweep", "gap_mm", "handle_mm", "rate_mm_s", "force_N")
EVERY = 4
"Neighbouring ticks are nearly the same."

PACES = ("steadily, about 20 turns a minute", "slowly, about 10 turns a minute", "quickly, about 25 turns a minute")
FITTING = "tormagd.lab.training.calibration"
POLL_S = 0.2


def calibrate_insert(
    config: Config,
    endpoints: Endpoints,
    scene: Scene,
    insert: str,
    out: Path,
    training_csv: Path | None,
    rates_N_s: Sequence[float],
    by_law: bool,
    wait_s: float,
) -> Outcome:
    """Sweep the force up and down at each rate, have a model of `insert` fitted, and save it."""
    law = ("--law",) if by_law else ()
    _ask_fitter("--insert", insert, *law)  # an unknown insert is reported now, not after the sweeps
    with Client(endpoints, wait_s, SOURCE) as client:
        known = known_of(config, client.status(), scene.force.most_N)
        forces = Range(known.least_N, known.most_N)
        with armed(endpoints, client, forces.least_N) as run:
            sweeps = [_sweep(run, forces, number, rates_N_s) for number in range(len(rates_N_s))]
    with tempfile.TemporaryDirectory(prefix="tormag") as folder:
        table = Path(folder) / "sweep.csv"
        write_sweeps(table, sweeps)
        result = _ask_fitter(
            str(table),
            *("--insert", insert, "--out", str(out), *law),
            *("--inner-radius-mm", str(scene.insert.inner_radius_mm)),
            *([] if training_csv is None else ["--csv", str(training_csv)]),
        )
    return Outcome(result, _text(result))


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


def write_sweeps(path: Path, sweeps: Sequence[Columns]) -> None:
    start_s = min((float(sweep["monotonic_s"][0]) for sweep in sweeps if sweep["monotonic_s"].size), default=0.0)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FILE_COLUMNS)
        for number, sweep in enumerate(sweeps):
            known = np.isfinite(np.column_stack([sweep[name] for name in COLUMNS])).all(axis=1)
            kept = {name: sweep[name][known][::EVERY] for name in COLUMNS}
            rows = (
                kept["monotonic_s"] - start_s,
                np.full(len(kept["monotonic_s"]), number),
                kept["left_mm"] + kept["right_mm"],
                kept["handle_mm"],
                kept["handle_rate_mm_s"],
                kept["measured_cf"],
            )
            writer.writerows(zip(*(column.tolist() for column in rows), strict=True))


def _ask_fitter(*arguments: str) -> dict[str, Any]:
    """Run the fitting process, and return the `result` that it prints."""
    command = [sys.executable, "-m", FITTING, *arguments]
    with (
        interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted,
        subprocess.Popen(command, stdout=subprocess.PIPE) as fitter,
    ):
        said = None
        while said is None:
            try:
                said, _ = fitter.communicate(timeout=POLL_S)
            except subprocess.TimeoutExpired:
                if is_interrupted():
                    fitter.terminate()
    try:
        answer = msgspec.json.decode(said, type=dict[str, dict[str, Any]])
    except msgspec.DecodeError as error:
        if is_interrupted():
            raise interrupted_run() from error
        raise CommandError(
            Exit.REFUSED,
            "fit_failed",
            f"the fitting process ended with {fitter.returncode} and said nothing",
            "its last words are above; calibrate again",
        ) from error
    if "error" in answer:
        told = answer["error"]
        raise CommandError(Exit.REFUSED, told["code"], told["message"], told["hint"])
    return answer["result"]


def _text(result: dict[str, Any]) -> str:
    metrics = result["metrics"]
    return (
        f"{result['model']}: {result['insert']}, {result['created']}, {result['rows']} rows. On sweeps kept from the "
        f"fit R2 {metrics['judged_r2']:.4f}, mean error {metrics['judged_mae_N'] * 1e3:.1f} mN (allowed "
        f"{metrics['most_mae_N'] * 1e3:.1f}; the sensor's noise alone {metrics['noise_mae_N'] * 1e3:.1f})\n"
        f"next: name the file as insert.model in a scene file of your own"
    )


def calibrate(
    config: Config,
    endpoints: Endpoints,
    wait_s: float,
    device: bool,
    insert: str | None,
    motors: bool,
    out: Path | None,
    csv: Path | None,
    rates_N_s: Sequence[float],
    by_law: bool,
    side: Literal["left", "right"],
    is_agreed: bool,
) -> Outcome:
    """Calibrate the device, an `insert`, or the `motors`, with a person's agreement."""
    if [insert is not None, motors, device].count(True) != 1:
        raise usage_error("calibrate takes one of three things", "give one of --insert NAME, --motors and --device")
    if insert is None and csv is not None:
        raise usage_error(
            "--csv is for --insert alone: the training data", "leave it out; with --motors, --out is the log"
        )
    if insert is None and by_law:
        raise usage_error("--law is for --insert alone: the kind of its model", "leave it out")
    if device is (out is not None):
        raise usage_error(
            "--out is not for --device" if device else "--out is missing: the file of the model or the log",
            "leave it out: the daemon keeps the profile" if device else "give --out FILE",
        )
    for option, path in (("--out", out), ("--csv", csv)):
        if path is not None and path.exists():
            raise usage_error(f"{option} {path} exists", "give another name; nothing is overwritten")
        if path is not None and not path.parent.is_dir():
            raise usage_error(
                f"{option} {path}: {path.parent} is not a directory", "give a file in one you may write to"
            )
    with as_usage_error(ConfigError, hint="correct the scene, or give the daemon's own --config"):
        scene = load_scene(config.scene)
    if not is_agreed:
        agree()
    most_N = scene.force.most_N
    if out is None:
        return calibrate_device(config, endpoints, most_N, wait_s)
    if insert is None:
        return calibrate_motors(endpoints, most_N, out, side, wait_s)
    return calibrate_insert(config, endpoints, scene, insert, out, csv, rates_N_s, by_law, wait_s)


def agree() -> None:
    """Say that the carriages will move, and wait until a person presses Enter."""
    if not is_terminal(sys.stdin):
        raise usage_error("stdin is no terminal: nobody can agree to the carriages moving", "a script says --yes")
    print("The device homes where needed, enables, and moves its carriages. Press Enter, or Ctrl-C.", file=sys.stderr)
    if not sys.stdin.readline():
        raise usage_error("input ended: nobody agreed to the carriages moving", "press Enter to agree")
