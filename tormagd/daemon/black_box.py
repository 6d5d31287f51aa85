"""The stream: all inputs of the core, and all traffic with the device, for the black box and for recorders.

The control thread writes references into a journal, and hands on PART_TICKS at once: to recorders by ZeroMQ, and into
a ring in shared memory. Another process writes the ring to files, and outlives the daemon, however the daemon ends.
"""

import contextlib
import importlib.util
import logging
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import Config
from tormagd.control.assembly.build import Core, platform_name, sources_hash
from tormagd.control.core import Planner, Stepper
from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.child_process import ChildProcess
from tormagd.ground.plain_values import plain
from tormagd.hardware.connection import Connection
from tormagd.record.keeper import (
    REQUEST,
    SHARED_MEMORY,
    End,
    Part,
    Ring,
    Write,
    Written,
    box_path,
    in_shared_memory,
)
from tormagd.record.stream import COLUMNS, FORMAT, STATE, Journal, Moment, TickRecord, core_hash, packed
from tormagd_client.messages import BlackBoxReport

KEEPER = "tormagd.record.keeper"
"The keeper's main module, with the descriptors of its socket and of the ring as arguments."
PART_TICKS = 10
"Control periods that are handed over at once; at 1000 and 50 Hz between two telemetry messages."
OF_CORE = (
    "format",
    "sources_sha256",
    "platform",
    "scene_folder",
    "core_sha256",
    "columns",
)
"What a replay needs beside what `describe` says."
SNAPSHOT_S = 1.0
"Time between snapshots: a replay may begin at each."
AFTER_FAULT_S = 2.0
"How long a black box goes on after its fault: the gap opens."
LEAVING_S, AGAIN_S = 2.0, 1.0
"How long the end of a keeper is waited for, and how soon one that has ended is replaced."
MAX_REQUESTED, MAX_OF_FAULTS = 8, 20
"Boxes still to be written, at most."

log = logging.getLogger(__name__)


def header(config: Config, core: Core) -> dict[str, str]:
    """Return what a replay needs to build the same core again."""
    return {
        "format": str(FORMAT),
        "version": __version__,
        "build": str(settle()),
        "sources_sha256": sources_hash(),
        "platform": platform_name(),
        "configuration": msgspec.json.encode(config).decode(),
        "scene": msgspec.json.encode(core.scene).decode(),
        "scene_folder": str(core.models),
        "model": core.model,
        "core_sha256": core_hash(core.config, core.scene, core.model),
        "columns": msgspec.json.encode(COLUMNS).decode(),
    }


class BlackBox:
    """Keeps the core's journal in a ring, from which the keeper, another process, writes black boxes into `folder`."""

    def __init__(self, folder: Path | None, header: dict[str, str], control_hz: int) -> None:
        self._folder, self.header = folder, header | {"folder": str(folder)}
        self._refusal, self._newest, self._dropped = "", "", 0
        self._beside: ChildProcess | None = None
        self._ring: Ring | None = None
        self._due_s, self.is_heard = 0.0, False
        self._unwritten: dict[str, tuple[float, Write]] = {}
        "By name, and when due. A new keeper is asked for all of it."
        self._asked = ""
        "The name in the newest request."
        if folder is None:
            self._refusal = "no folder is named for black boxes"
        elif importlib.util.find_spec("mcap") is None:
            self._refusal = "mcap is not installed: pip install 'tormagd[record]'"
            log.warning("no black box is kept: %s; next: mend that and start the daemon again", self._refusal)
        else:
            self._ring = Ring(in_shared_memory(str(folder)))
            self.look()
        self.journal = Journal(is_kept=self._ring is not None)
        self._ticks = PART_TICKS // 2
        self._ticks_per_snapshot = max(1, round(SNAPSHOT_S * control_hz / PART_TICKS)) * PART_TICKS
        self._connection: Connection | None = None

    def begin(self, stepper: Stepper, planner: Planner, connection: Connection) -> None:
        """Begin the journal with a snapshot of both states, which are those before the first tick."""
        self._connection, connection.traffic = connection, self.journal.note
        self._snapshot(stepper, planner)

    def begin_scene(self, header: dict[str, str], stepper: Stepper, planner: Planner) -> None:
        """Begin anew with the core of another scene, from a snapshot of these states."""
        self.header = header | {"folder": str(self._folder)}
        self._begin_anew(stepper, planner)

    def ticked(self, moment: Moment, stepper: Stepper, planner: Planner) -> tuple[bytes, list[Any]] | None:
        """Add a tick to the journal; when there are PART_TICKS, return all entries, encoded, and the ticks."""
        was_kept, self.journal.is_kept = self.journal.is_kept, self._ring is not None or self.is_heard
        if not (was_kept and self.journal.is_kept):  # from the end of this period
            self._ticks = 0
            self._begin_anew(stepper, planner)
            return None
        part: tuple[bytes, list[Any]] | None = None
        try:
            self.journal.add(moment)
            self._ticks += 1
            if self._ticks % PART_TICKS == 0:
                entries = self.journal.take()
                part = packed(entries), [each for each in entries if isinstance(each, TickRecord)]
                if self._ring is not None:
                    self._ring.put(self.header, Part(moment.time_s, part[0]))
        except (TypeError, ValueError, OverflowError, OSError) as error:  # control goes on, whatever is in it
            if not self._dropped:
                log.error(
                    "some ticks are in no black box: %s; next: make room in %s, or report that", error, SHARED_MEMORY
                )
            self._refusal, self._dropped = f"an entry that cannot be written: {error}", self._dropped + 1
            self.journal.lose()
            self._ticks = -PART_TICKS  # a snapshot follows the next part
        if self._ticks % self._ticks_per_snapshot == 0:
            self._snapshot(stepper, planner)
        return part

    def write(self, reason: str, after_s: float, details: dict[str, str]) -> Path:
        """Have a black box written in `after_s`, and return its path."""
        if self._ring is None:
            raise RefusedError(
                "no_black_box",
                f"there is no black box: {self._refusal}",
                "name [black_box] folder in the daemon's configuration, and start it again",
            )
        is_requested = reason == REQUEST
        alike = sum((asked.reason == REQUEST) is is_requested for _, asked in self._unwritten.values())
        if alike >= (MAX_REQUESTED if is_requested else MAX_OF_FAULTS):
            self._refusal = f"{alike} black boxes are still to be written"
            raise RefusedError("busy", self._refusal, "ask again in a few seconds")
        path = box_path(str(self._folder), reason)
        self._refusal = ""
        self._unwritten[path.name] = time.monotonic() + after_s, Write(str(path), reason, self.header | details)
        self._ask()
        return path

    @property
    def is_missing(self) -> bool:
        """Whether another keeper is due."""
        return self._ring is not None and self._beside is None

    def look(self) -> None:
        """Start a keeper where one is due, note its answers, and ask it for what is due."""
        if self._ring is not None and self._beside is None and time.monotonic() >= self._due_s:
            try:
                self._beside = ChildProcess(KEEPER, self._ring.file)
            except OSError as error:
                self._wait(f"the process that writes it did not start: {error.strerror}")
            else:
                self._refusal = self._asked = ""
        while self._beside is not None and (data := self._beside.receive()) is not None:
            answer = msgspec.msgpack.decode(data, type=Written)
            self._refusal, self._asked = answer.refusal, ""
            self._unwritten.pop(answer.name, None)
            if answer.refusal:
                log.error("the black box %s was not written: %s", answer.name, answer.refusal)
            else:
                self._newest = answer.name
                log.info("black box: %s/%s", self._folder, answer.name)
        self._ask()
        if self._beside is not None and self._beside.is_gone:
            self._beside.close()
            self._beside = None
            self._wait("the process that writes it has ended")

    def report(self) -> BlackBoxReport:
        """Return the state of the black box: its folder, the newest file, what went wrong, parts lost since
        the start."""
        return BlackBoxReport(
            folder="" if self._folder is None else str(self._folder),
            newest=self._newest,
            refusal=self._refusal,
            dropped=self._dropped,
        )

    def close(self) -> None:
        """Tell the keeper to end once it has written what it was asked for; wait LEAVING_S at most, and
        leave it then."""
        if self._ring is not None:
            self._ring.path.unlink(missing_ok=True)
        if (beside := self._beside) is not None:
            beside.socket.settimeout(LEAVING_S)  # it holds a dozen requests
            all(
                beside.send(msgspec.msgpack.encode(each))
                for each in (*(asked for _, asked in self._unwritten.values()), End())
            )
            beside.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                beside.process.wait(LEAVING_S)

    def _ask(self) -> None:
        """Ask for the next box that is due, faults' first."""
        if self._beside is None or self._asked in self._unwritten:
            return
        due = [asked for due_s, asked in self._unwritten.values() if due_s <= time.monotonic()]
        due.sort(key=lambda asked: asked.reason == REQUEST)
        if due and self._beside.send(msgspec.msgpack.encode(due[0])):
            self._asked = Path(due[0].path).name

    def _begin_anew(self, stepper: Stepper, planner: Planner) -> None:
        """Forget what was not handed over."""
        self.journal.lose()
        self._snapshot(stepper, planner)

    def _snapshot(self, stepper: Stepper, planner: Planner) -> None:
        if self.journal.is_kept:
            memory = None if self._connection is None else self._connection.memory()
            core = self.header.get("core_sha256", "")
            self.journal.note(STATE, plain(stepper), plain(planner), memory, core)

    def _wait(self, reason: str) -> None:
        """Have another keeper started soon."""
        log.error("no black box is written: %s; another one starts in %g s", reason, AGAIN_S)
        self._refusal, self._due_s = reason, time.monotonic() + AGAIN_S
