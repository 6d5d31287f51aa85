"""`tormagctl record`, `mark`, `recordings` and `replay`: write what the daemon publishes to MCAP files, look after a
folder of them, and run one again.

The recorder is a process of its own. A replay runs the same core here, or `tormagd.simulation.rehearse`, in a process
of its own, with the simulator in place of the device.
"""

import contextlib
import hashlib
import json
import logging
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import zmq

from tormagd.config import Config
from tormagd.ctl.outcome import (
    WRITABLE,
    CommandError,
    Exit,
    Outcome,
    answer_of,
    as_usage_error,
    refused,
    usage_error,
)
from tormagd.ground.files import new_file
from tormagd.ground.terminal import interrupted_by, write_line
from tormagd.record.folder import RecordingFolder, Segment, mark as mark_segment
from tormagd.record.reader import Contents, RecordingError, damage_in, overview_of
from tormagd.record.rerun import ReplayError, rebuilt, reopened, rerun
from tormagd.record.ticks import MAX_BATCH_BYTES, decode_ticks
from tormagd.record.writer import RecordingWriter
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ConfigError, Endpoints
from tormagd_client.errors import ClientError, unreachable
from tormagd_client.messages import MessageError
from tormagd_client.printable import printable
from tormagd_client.regular_file import require_regular
from tormagd_client.wire import connect, keys_of

QUEUE = 10_000
"Over three minutes for a slow listener."
POLL_MS = 100
LONGEST_END_S = 60.0
SILENT_S = 1.0
"After this silence at the end, the daemon has gone."
LONGEST_REHEARSAL_S = 900.0
"Half a minute, interpreted and simulated twice, takes some minutes."
REPLAYED = "tormagctl blackbox makes one, and the daemon on a fault; tormagctl replay --help"


@contextlib.contextmanager
def listening(
    endpoints: Endpoints, context: "zmq.Context[zmq.Socket[bytes]] | None" = None
) -> Iterator["zmq.Socket[bytes]"]:
    """Yield a SUB socket that hears the daemon's ticks."""
    with context or zmq.Context() as own, own.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVHWM, QUEUE)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_BATCH_BYTES)
        socket.subscribe(b"")
        connect(socket, endpoints.recording, keys_of(endpoints.curve))
        yield socket


def record(config: Config, endpoints: Endpoints, path: Path, duration_s: float, wait_s: float) -> Outcome:
    """Record for `duration_s` or until SIGINT or SIGTERM, to a file, or to segments in a folder."""
    if not (is_folder := path.is_dir()) and path.suffix != ".mcap":
        with as_usage_error(OSError, hint="name a folder that is there, or a new file that ends in .mcap"):
            list(path.iterdir())
    with listening(endpoints) as ticks, interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted:
        if not _is_ready(ticks, wait_s, is_interrupted):
            raise unreachable(endpoints.recording, f"nothing is published there within {wait_s:g} s")
        about = _about(endpoints, wait_s)
        with as_usage_error(OSError, hint=WRITABLE):
            place = RecordingFolder(path, config.recordings) if is_folder else path
            writer = RecordingWriter(place, about, config.recordings.one_tick_of)
        try:
            with writer:
                outcome = _record(writer, ticks, duration_s, is_interrupted)
                with contextlib.suppress(ClientError):  # if the daemon has gone, what was true at the start remains
                    writer.describe(_about(endpoints, min(wait_s, SILENT_S)))
                return outcome
        except OSError as error:
            remedy = refused(error, f"see that {writer.path.parent} stays in place and takes files").hint
            raise CommandError(
                Exit.REFUSED,
                "not_written",
                f"{writer.path}: {error.strerror}, after {writer.tick_count} ticks and {writer.telemetry_count} "
                "snapshots",
                f"{remedy}; what is in the file, all but about the last second, reads like any other recording",
            ) from error


def _about(endpoints: Endpoints, wait_s: float) -> dict[str, str]:
    """Ask the daemon what it runs, as metadata."""
    with Client(endpoints, wait_s) as client:
        known = msgspec.to_builtins(client.describe())
    return {
        name: value if isinstance(value, str) else msgspec.json.encode(value).decode()
        for name, value in (known | known.pop("core")).items()
        if value is not None
    }


def _is_ready(socket: "zmq.Socket[bytes]", wait_s: float, is_interrupted: Callable[[], bool]) -> bool:
    """Wait until the socket has a message; return False after `wait_s` or an interrupt."""
    end_s = time.monotonic() + wait_s
    while True:
        is_ready = bool(socket.poll(POLL_MS))
        if is_ready or time.monotonic() >= end_s or is_interrupted():
            return is_ready


def _record(
    writer: RecordingWriter, ticks: "zmq.Socket[bytes]", duration_s: float, is_interrupted: Callable[[], bool]
) -> Outcome:
    unreadable = 0
    start_s = heard_s = time.monotonic()
    is_over = False
    while not is_over:
        ticks.poll(POLL_MS)
        is_over = is_interrupted() or time.monotonic() >= start_s + duration_s
        # what waits at the end came before it
        until_s = time.monotonic() + (LONGEST_END_S if is_over else POLL_MS / 1e3)
        while ticks.poll(0) and time.monotonic() < until_s:
            try:
                writer.ticks(decode_ticks(ticks.recv_multipart()[-1]))
                heard_s = time.monotonic()
            except (MessageError, msgspec.MsgspecError, TypeError, LookupError) as error:
                unreadable += 1
                if unreadable == 1:
                    write_line(f"tormagctl record: left out a message: {printable(str(error))}", sys.stderr)
    end_s = time.monotonic()
    silent_s = end_s - heard_s
    result = {
        "file": str(writer.path),
        "seconds": round(end_s - start_s, 3),
        "telemetry": writer.telemetry_count,
        "ticks": writer.tick_count,
        "ticks_lost": writer.ticks_lost,
        "restarts": writer.restarts,
        "silent_ms": round(silent_s * 1e3, 3),
        "unreadable": unreadable,
    }
    text = (
        f"{writer.path}: {writer.tick_count} ticks, {writer.telemetry_count} snapshots; {writer.ticks_lost} ticks lost"
    )
    if writer.restarts:
        text += f"; the daemon began anew {writer.restarts} times, and nothing is known of between"
    if silent_s > SILENT_S:
        text += f"; nothing came in the last {silent_s:.1f} s: the daemon has gone, or does not run any more"
        return Outcome(result, text, Exit.UNREACHABLE)
    return Outcome(result, text, Exit.REFUSED if writer.ticks_lost or writer.restarts else Exit.DONE)


def mark(client: Client, text: str) -> Outcome:
    """Put an event into telemetry, and so into every recording; a folder's present segment is then kept
    from pruning."""
    return Outcome(client.request("mark", text=text), f"marked: {text}")


def recordings(config: Config, action: str, path: Path | None, target: Path | None) -> Outcome:
    """List a folder, prune it to its budget, mark a recording so that it is kept, or copy it to `target`."""
    if target is not None and action != "export":
        raise usage_error(
            "--to: allowed only for recordings export", "tormagctl recordings export FILE.mcap --to FOLDER"
        )
    with as_usage_error(OSError, ValueError, hint="tormagctl recordings --help"):
        if action in ("list", "prune"):
            folder = RecordingFolder(path or Path(config.recordings.folder), config.recordings)
            with as_usage_error(OSError, hint="name the folder, or set [recordings] folder"):
                list(folder.path.iterdir())
            return _list(folder) if action == "list" else _prune(folder)
        if path is None:
            raise usage_error(f"{action}: no recording is named", f"tormagctl recordings {action} FILE.mcap")
        if action == "mark":
            kept = mark_segment(path)
            return Outcome({"file": str(kept)}, f"{kept} stays until somebody takes it away")
        return _export(path, target)


def _list(folder: RecordingFolder) -> Outcome:
    """Describe each segment of the folder, the oldest first, and say their total size."""
    rows = [_row(segment) for segment in folder.segments()]
    size_MB = sum(row["MB"] for row in rows)
    lines = [
        f"{row['name']:<44} {row['MB']:9.1f} MB {row['seconds'] or 0.0:9.1f} s  "
        f"{'marked' if row['is_marked'] else '':<7}{row['said']}"
        for row in rows
    ]
    total = f"{_count(rows)}, {size_MB:.1f} of {folder.budget.most_MB:.1f} MB in {folder.path}"
    return Outcome({"folder": str(folder.path), "recordings": rows, "MB": size_MB}, "\n".join([*lines, total]))


def _row(segment: Segment) -> dict[str, Any]:
    """Describe one segment by its overview, and what is wrong."""
    try:
        overview, known = overview_of(segment.path)
        said = known.notes or ([] if overview else ["no overview: another tormagd wrote it"])
    except RecordingError as error:
        overview, said = None, [str(error).removeprefix(f"{segment.path}: ")]
    faults = [] if overview is None else list(overview.spans_s("faults"))
    marks = [] if overview is None else [each.text for each in overview.marks]
    return {
        "name": segment.path.name,
        "began_s": segment.began_s,
        "MB": round(segment.bytes / 1e6, 3),
        "is_marked": segment.is_marked,
        "seconds": None if overview is None else round(overview.duration_s, 3),
        "faults": faults,
        "marks": marks,
        "said": ", ".join([*said, *faults, *(f"“{text}”" for text in marks)]),
    }


def _prune(folder: RecordingFolder) -> Outcome:
    """Delete what is over the budget, and say what was deleted and whether that is enough."""
    gone = folder.prune()
    over = folder.over(folder.segments())
    result = {"removed": [each.path.name for each in gone], "over": over}
    text = f"{_count(gone)} taken away, {sum(each.bytes for each in gone) / 1e6:.1f} MB\n{over}"
    return Outcome(result, text.strip(), Exit.REFUSED if over else Exit.DONE)


def _count(of: Sequence[object]) -> str:
    return f"{len(of)} recording{'s' * (len(of) != 1)}"


def _export(path: Path, target: Path | None) -> Outcome:
    """Copy a recording to a new file, check the copy's CRCs, and tell its SHA-256; REFUSED where it is not whole."""
    if target is None:
        raise usage_error("export: no place is named", f"tormagctl recordings export {path} --to FOLDER")
    copy = target / path.name if target.is_dir() else target
    if not copy.suffix:
        raise usage_error(f"{target}: no such folder", f"mkdir -p {target}, or name a file: COPY.mcap")
    require_regular(path)
    with new_file(copy):
        shutil.copyfile(path, copy)
    with copy.open("rb") as made:
        digest = hashlib.file_digest(made, "sha256").hexdigest()
        known = Contents(made)
        known.damage = damage_in(made)
    exit_code = Exit.DONE if known.is_complete and not known.damage else Exit.REFUSED
    result = {"file": str(copy), "sha256": digest, "damage": known.damage, "notes": known.notes}
    return Outcome(result, "\n".join([f"{copy}: SHA-256 {digest}", *known.notes]), exit_code)


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
    result = _rehearsed(path, [f"--plant={plant or 'sample_1'}", *changes]) if changes else _again(path, from_s)
    head = f"altered: {result['odd']}\n" if result["odd"] else ""
    notes = "".join(f"\nnot as it was: {each}" for each in result["differences"])
    notes += "" if result["is_complete"] else "\nthe file is cut short"
    text = _instead(result) if changes else _rerun(result["rerun"])
    is_exact = bool(changes) or result["rerun"]["difference"] is None
    return Outcome(result, head + text + notes, Exit.DONE if is_exact and not result["odd"] else Exit.REFUSED)


def _again(path: Path, from_s: float) -> dict[str, Any]:
    """Run the same core over the recorded inputs."""
    logging.getLogger("tormagd").addHandler(logging.NullHandler())  # a replayed connection has no news

    with (
        as_usage_error(ConfigError, RecordingError, ReplayError, OSError, hint=REPLAYED),
        reopened(path) as (known, told),
    ):
        return told | {"rerun": msgspec.to_builtins(rerun(rebuilt(known), known.box.entries, from_s))}


def _rehearsed(path: Path, arguments: list[str]) -> dict[str, Any]:
    with as_usage_error(TimeoutError, ChildProcessError, hint=REPLAYED):
        answer = answer_of("tormagd.simulation.rehearse", [*arguments, "--", str(path)], LONGEST_REHEARSAL_S)
    return dict(json.loads(answer))  # names in it need not be UTF-8


def _rerun(done: dict[str, Any]) -> str:
    """Say whether the report's `rerun` was bit-exact."""
    notes = f"; {done['gaps']} gaps in it were passed over" if done["gaps"] else ""
    difference = done["difference"]
    span = f"{done['ticks']:,} ticks from {done['from_s']:.3f} to {done['to_s']:.3f} s"
    if difference is None:
        frames = f"{done['frames']:,} frames give the measurements again" if done["frames"] else "no frames are in it"
        return f"bit-exact, {span}; {done['snapshots']} snapshots of the state between them, too; {frames}{notes}"
    frame = "" if difference["frame"] is None else f" at frame {difference['frame']:,}"
    return (
        f"tick {difference['tick']:,} at {difference['time_s']:.3f} s differs{frame}: {difference['field']} was "
        f"{difference['recorded']}, is {difference['replayed']}; before it bit-exact, {done['ticks']:,} ticks{notes}"
    )


def _instead(result: dict[str, Any]) -> str:
    """Say what was recorded, and what the simulator met with the old and the new settings."""
    ran = {"recorded": result["recorded"], "simulated as configured then": result["simulated"]}
    if result["instead"] is not None:
        ran[f"simulated with {', '.join(result['settings'])}"] = result["instead"]
    lines = [f"{name}: {_happened(what)}" for name, what in ran.items()]
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
