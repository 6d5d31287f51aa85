"""`tormagctl record`: write what the daemon publishes to an MCAP file, in a process of its own."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import msgspec
import zmq

from tormagd.ctl.outcome import CommandError, Exit, Outcome, usage_error
from tormagd.interrupt import interrupted_by
from tormagd.output import write_line
from tormagd.recording.ticks import decode_ticks, listening
from tormagd.recording.writer import RecordingWriter
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import ClientError, unreachable
from tormagd_client.messages import TELEMETRY_TOPIC, MessageError, Telemetry, decode
from tormagd_client.printable import printable
from tormagd_client.wire import keys_of

POLL_MS = 100
LONGEST_END_S = 60.0
"What has arrived until the end is written down, but no longer than that."
SILENT_S = 1.0
"A daemon that was silent for so long at the end has gone."


def record(endpoints: Endpoints, path: Path, duration_s: float, wait_s: float) -> Outcome:
    """Record telemetry and ticks for `duration_s` or until SIGINT or SIGTERM; in a folder, to a file of its own.

    What is recorded is asked of the daemon and written down first, and again at the end: a device may have been
    connected, or have shown itself, meanwhile.

    Raises CommandError: USAGE where the file exists or cannot be made, UNREACHABLE where nothing is published within
    `wait_s`, or the daemon cannot be asked what it runs; then there is no file. REFUSED where the disk takes no more;
    what it took stays. A message that cannot be read is counted, and the first one's reason told. The outcome's exit
    code is REFUSED where ticks were lost, UNREACHABLE where the daemon was gone at the end.
    """
    keys = keys_of(endpoints.curve)
    context = zmq.Context()
    try:
        telemetry = listening(context, endpoints.telemetry, keys, TELEMETRY_TOPIC)
        ticks = listening(context, endpoints.recording, keys)
        with interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted:
            if not _any_ready((telemetry, ticks), wait_s, is_interrupted):
                raise unreachable(endpoints.telemetry, f"nothing is published there within {wait_s:g} s")
            about = _about(endpoints, wait_s)
            if path.is_dir():
                path /= f"{datetime.now():%Y-%m-%dT%H-%M-%S}.mcap"
            try:
                writer = RecordingWriter(path, about)
            except FileExistsError as error:
                raise usage_error(f"{path} exists", "give another name; recordings are never overwritten") from error
            except OSError as error:
                raise usage_error(f"{path}: {error.strerror}", "give a file in a directory you may write to") from error
            try:
                with writer:
                    outcome = _record(writer, path, telemetry, ticks, duration_s, is_interrupted)
                    with contextlib.suppress(ClientError):  # the daemon has gone: what was true at the start stands
                        writer.describe(_about(endpoints, min(wait_s, SILENT_S)))
                    return outcome
            except OSError as error:
                raise CommandError(
                    Exit.REFUSED,
                    "not_written",
                    f"{path}: {error.strerror}, after {writer.tick_count} ticks and {writer.telemetry_count} snapshots",
                    "make room; what is in the file, all but about the last second, reads like any other recording",
                ) from error
    finally:
        context.destroy(linger=0)


def _about(endpoints: Endpoints, wait_s: float) -> dict[str, str]:
    """What is recorded, as metadata: what is not a text of its own is JSON; what is not known is left out."""
    with Client(endpoints, wait_s) as client:
        known = msgspec.to_builtins(client.describe())
    return {
        name: value if isinstance(value, str) else msgspec.json.encode(value).decode()
        for name, value in known.items()
        if value is not None
    }


def _any_ready(sockets: tuple["zmq.Socket[bytes]", ...], wait_s: float, is_interrupted: Callable[[], bool]) -> bool:
    poller = zmq.Poller()
    for socket in sockets:
        poller.register(socket, zmq.POLLIN)
    end_s = time.monotonic() + wait_s
    while not (ready := poller.poll(POLL_MS)) and time.monotonic() < end_s and not is_interrupted():
        pass
    return bool(ready)


def _record(
    writer: RecordingWriter,
    path: Path,
    telemetry: "zmq.Socket[bytes]",
    ticks: "zmq.Socket[bytes]",
    duration_s: float,
    is_interrupted: Callable[[], bool],
) -> Outcome:
    unreadable = 0
    start_s = heard_s = time.monotonic()
    is_over = False
    while not is_over:
        left_s = start_s + duration_s - time.monotonic()
        is_over = is_interrupted() or left_s <= 0.0
        if not is_over:
            _any_ready((telemetry, ticks), min(left_s, POLL_MS / 1e3), is_interrupted)
        # what waits when it is over came before that, and belongs into the file
        until_s = time.monotonic() + (LONGEST_END_S if is_over else POLL_MS / 1e3)
        for socket in (telemetry, ticks):
            while socket.poll(0) and time.monotonic() < until_s:
                data = socket.recv_multipart()[-1]
                try:
                    if socket is telemetry:
                        writer.telemetry(decode(data, Telemetry))
                    else:
                        writer.ticks(decode_ticks(data))
                        heard_s = time.monotonic()
                except MessageError as error:
                    unreadable += 1
                    if unreadable == 1:
                        write_line(f"tormagctl record: left out a message: {printable(str(error))}", sys.stderr)
    end_s = time.monotonic()
    silent_s = end_s - heard_s
    is_silent = writer.note_silence(round(silent_s * 1e9))
    result = {
        "file": str(path),
        "seconds": round(end_s - start_s, 3),
        "telemetry": writer.telemetry_count,
        "telemetry_lost": writer.telemetry_lost,
        "ticks": writer.tick_count,
        "ticks_lost": writer.ticks_lost,
        "gaps": writer.gaps,
        "longest_gap_ms": round(writer.longest_gap_ms, 3),
        "silent_ms": round(silent_s * 1e3, 3) if is_silent else 0.0,
        "unreadable": unreadable,
    }
    losses = (
        f"{writer.gaps} gaps (longest {writer.longest_gap_ms:.0f} ms), {writer.ticks_lost} ticks and "
        f"{writer.telemetry_lost} snapshots lost"
    )
    text = f"{path}: {writer.tick_count} ticks, {writer.telemetry_count} snapshots; {losses}"
    if is_silent and silent_s > SILENT_S:
        text += f"; nothing came in the last {silent_s:.1f} s: the daemon has gone, or does not run any more"
        return Outcome(result, text, Exit.UNREACHABLE)
    return Outcome(result, text, Exit.REFUSED if writer.ticks_lost else Exit.DONE)
