"""`tormagctl replay`: a black box run again, bit for bit, or with the simulator in place of the device.

The running is `python -m tormagd.replay`, a process of its own: what operates a daemon does not load its core.
"""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from tormagd.ctl.outcome import Exit, Outcome, usage_error

LONGEST_S = 900.0
"Half a minute takes some seconds, interpreted and simulated twice some minutes."


def replay(
    path: Path,
    from_s: float,
    settings: Sequence[str],
    plant: str,
    faults: Sequence[str],
    config_file: Path | None,
) -> Outcome:
    """Runs the file. An outcome that is not bit-exact has the exit code REFUSED. Raises CommandError (USAGE) where file
    or options cannot be used."""
    command = [sys.executable, "-P", "-m", "tormagd.replay", f"--from={from_s!r}", f"--plant={plant}"]
    command += [f"--set={setting}" for setting in settings] + [f"--fault={fault}" for fault in faults]
    command += [f"--config={config_file}"] if config_file else []
    try:
        done = subprocess.run(
            [*command, "--", str(path)], capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise usage_error(f"{path}: not done after {LONGEST_S:g} s", "is it a black box?") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise usage_error(lines[-1], "tormagctl blackbox makes one, and the daemon on a fault; tormagctl replay --help")
    result: dict[str, Any] = msgspec.json.decode(done.stdout)
    notes = "".join(f"\nnot as it was: {each}" for each in result["differences"])
    if not result["is_complete"]:
        notes += "\nthe file is cut short"
    if "rerun" not in result:
        return Outcome(result, _instead(result) + notes)
    text, is_exact = _rerun(result["rerun"])
    return Outcome(result, text + notes, Exit.DONE if is_exact else Exit.REFUSED)


def _rerun(done: dict[str, Any]) -> tuple[str, bool]:
    gaps = f"; {done['gaps']} gaps in it were passed over" if done["gaps"] else ""
    span = f"{done['ticks']:,} ticks from {done['from_s']:.3f} to {done['to_s']:.3f} s"
    difference, notes = done["difference"], gaps + _damage(done)
    if difference is None:
        frames = f"{done['frames']:,} frames give the measurements again" if done["frames"] else "no frames are in it"
        return f"bit-exact, {span}; {done['snapshots']} snapshots of the state between them, too; {frames}{notes}", True
    frame = "" if difference["frame"] is None else f" at frame {difference['frame']:,}"
    return (
        f"tick {difference['tick']:,} at {difference['time_s']:.3f} s differs{frame}: {difference['field']} was "
        f"{difference['recorded']}, is {difference['replayed']}; before it bit-exact, {done['ticks']:,} ticks{notes}"
    ), False


def _damage(done: dict[str, Any]) -> str:
    first = done["first_damage"]
    if first is None:
        return ""
    return (
        f"; {done['damaged']:,} of them came damaged ({done['resynchronised']:,} resynchronisations), the first is "
        f"frame {first['frame']:,} at {first['time_s']:.3f} s: {first['why']}"
    )


def _instead(result: dict[str, Any]) -> str:
    told = {"recorded": result["recorded"], "simulated as configured then": result["simulated"]}
    if result["instead"] is not None:
        told[f"simulated with {', '.join(result['settings'])}"] = result["instead"]
    lines = [f"{name}: {_happened(what)}" for name, what in told.items()]
    faults = "".join(f", with {fault}" for fault in result["faults"])
    missing = set(result["recorded"]["faults"]) - set(result["simulated"]["faults"])
    if missing:
        lines.append(
            f"{', '.join(sorted(missing))} did not come in the simulation as configured then: what the change does to "
            "that is not known"
        )
    return "\n".join(
        (
            *lines,
            f"The simulated device is {result['plant']}{faults}, with the recorded setpoints, commands and handle. "
            "What else the recorded device did, it does only where --fault says so.",
        )
    )


def _happened(what: dict[str, Any]) -> str:
    faults = ", ".join(f"{name} at {at_s:.3f} s" for name, at_s in what["faults"].items()) or "no fault"
    limits = ", ".join(f"{name} {held_s:.3f} s" for name, held_s in what["limits"].items()) or "none"
    refused = f"; refused: {', '.join(what['refused'])}" if what["refused"] else ""
    return f"{faults}; limits: {limits}{refused}"
