"""`tormagctl replay`: run a black box again, bit for bit, or with the simulator in place of the device.

`tormagd.simulation.rehearse` does the other, in a process of its own.
"""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from tormagd.ctl.outcome import Exit, Outcome, answer_of, as_usage_error, usage_error
from tormagd.record.black_box import Recorded, ReplayError, rebuilt, told
from tormagd.record.reader import RecordingError
from tormagd.record.rerun import rerun
from tormagd_client.endpoints import ConfigError

LONGEST_S = 900.0
"Half a minute, interpreted and simulated twice, takes some minutes."
HINT = "tormagctl blackbox makes one, and the daemon on a fault; tormagctl replay --help"


def replay(
    path: Path,
    from_s: float,
    settings: Sequence[str],
    plant: str | None,
    faults: Sequence[str],
) -> Outcome:
    """Replay a black box; with `settings` or `faults`, on the simulated `plant`."""
    changes = [*(f"--set={setting}" for setting in settings), *(f"--fault={fault}" for fault in faults)]
    if from_s if changes else plant:
        said = "--from: allowed only without" if changes else "--plant: allowed only with"
        raise usage_error(f"{said} --set or --fault", "tormagctl replay --help")
    rehearsed = [f"--plant={plant or 'sample_1'}", *changes]
    result = _rehearsed(path, rehearsed) if changes else _again(path, from_s)
    head = f"altered: {result['odd']}\n" if result["odd"] else ""
    notes = "".join(f"\nnot as it was: {each}" for each in result["differences"])
    notes += "" if result["is_complete"] else "\nthe file is cut short"
    if "rerun" not in result:
        return Outcome(result, head + _instead(result) + notes, Exit.REFUSED if result["odd"] else Exit.DONE)
    text, is_exact = _rerun(result["rerun"])
    return Outcome(result, head + text + notes, Exit.DONE if is_exact and not result["odd"] else Exit.REFUSED)


def _again(path: Path, from_s: float) -> dict[str, Any]:
    """Run the same core over the recorded inputs."""
    logging.getLogger("tormagd").addHandler(logging.NullHandler())  # a replayed connection has no news

    def run(known: Recorded) -> dict[str, Any]:
        return {"rerun": msgspec.to_builtins(rerun(rebuilt(known), known.box.entries, from_s))}

    with as_usage_error(ConfigError, RecordingError, ReplayError, OSError, hint=HINT):
        return told(path, run)


def _rehearsed(path: Path, arguments: list[str]) -> dict[str, Any]:
    try:
        answer = answer_of("tormagd.simulation.rehearse", [*arguments, "--", str(path)], LONGEST_S)
    except TimeoutError as error:
        raise usage_error(f"{path}: {error}", "is it a black box?") from error
    except ChildProcessError as error:
        raise usage_error(str(error), HINT) from error
    result: dict[str, Any] = json.loads(answer)  # names in it need not be UTF-8
    return result


def _rerun(done: dict[str, Any]) -> tuple[str, bool]:
    """Return the text on the report's `rerun`, and whether it was bit-exact."""
    notes = f"; {done['gaps']} gaps in it were passed over" if done["gaps"] else ""
    difference = done["difference"]
    span = f"{done['ticks']:,} ticks from {done['from_s']:.3f} to {done['to_s']:.3f} s"
    if difference is None:
        frames = f"{done['frames']:,} frames give the measurements again" if done["frames"] else "no frames are in it"
        return f"bit-exact, {span}; {done['snapshots']} snapshots of the state between them, too; {frames}{notes}", True
    frame = "" if difference["frame"] is None else f" at frame {difference['frame']:,}"
    return (
        f"tick {difference['tick']:,} at {difference['time_s']:.3f} s differs{frame}: {difference['field']} was "
        f"{difference['recorded']}, is {difference['replayed']}; before it bit-exact, {done['ticks']:,} ticks{notes}"
    ), False


def _instead(result: dict[str, Any]) -> str:
    """Say what was recorded, and what the simulator met with the old and the new settings."""
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
