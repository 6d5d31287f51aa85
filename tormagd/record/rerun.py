"""Runs a core again over its recorded inputs: the same bits, or the first tick and field that differ.

The conversation with the device is run again, too: the same `Connection`, fed what was read at the recorded times.
"""

import contextlib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from firmware_protocol.build import settle
from firmware_protocol.codec import Message
from tormagd import __version__
from tormagd.config import Config, Device, checked
from tormagd.control.assembly.build import Core, build_core, platform_name, sources_hash
from tormagd.control.believe.sensor import Disputed
from tormagd.control.core import PLAN_ERRORS
from tormagd.control.records import Duty, Plan, TimedSetpoint
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.ground.plain_values import first_difference, packed, plain, restore, restored
from tormagd.hardware import connection
from tormagd.hardware.backend import BackendError, Sent, Stream
from tormagd.hardware.measurement import Measurement
from tormagd.hardware.streams import CanStream, FrameStream, SecondHostError
from tormagd.record import stream
from tormagd.record.reader import BlackBoxFile
from tormagd.record.writer import frames_in, is_tick
from tormagd.scenes.scene import Scene
from tormagd_client.endpoints import ConfigError

NEEDED = (
    "format", "version", "sources_sha256", "platform", "configuration", "scene", "scene_folder", "model",
    "core_sha256", "columns",
)  # fmt: skip
SHOWN = 12
"Digits of a hash that messages show."


class ReplayError(ValueError):
    """A black box that cannot be run again here."""


class Recorded(NamedTuple):
    """A black box whose header has been checked."""

    box: BlackBoxFile
    config: Config
    scene: Scene


@contextlib.contextmanager
def reopened(path: Path) -> Iterator[tuple[Recorded, dict[str, Any]]]:
    """Yield a black box that may be run again, and what is told of it: what it is, and what differs here."""
    box = BlackBoxFile(path)
    try:
        known = recorded(box)
        told = {
            "file": str(path),
            "odd": box.odd,
            "version": box.metadata["version"],
            "reason": box.metadata.get("reason", ""),
            "build": str(settle()),
            "is_complete": box.is_complete,
            "differences": differences(box.metadata),
        }
        yield known, told
    except ReplayError as error:
        other = box.metadata.get("sources_sha256", "") not in ("", sources_hash())
        hint = "; another tormagd wrote it: replay it with that one" * other
        raise ReplayError(f"{path}: {error}{f'; damaged: {box.damage}' if box.damage else hint}") from error


def recorded(box: BlackBoxFile) -> Recorded:
    """Check a black box's header."""
    header = box.metadata
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise ReplayError(f"its header has no {missing[0]!r}: it is no black box of this version")
    if header["format"] != str(stream.FORMAT):
        raise ReplayError(
            f"format = {header['format'][:20]!r}, written by tormagd {header['version'][:20]!r}: allowed is "
            f"{stream.FORMAT}, which tormagd {__version__} writes; replay it with the version that wrote it"
        )
    if box.described("columns", tuple[str, ...]) != stream.COLUMNS:
        raise ReplayError(f"its ticks have other columns: tormagd {header['version'][:20]!r} wrote it")
    try:
        config = checked(box.described("configuration", dict[str, Any]), Config)
        return Recorded(box, config, checked(box.described("scene", dict[str, Any]), Scene))
    except (ConfigError, RecursionError) as error:
        raise ReplayError(f"its configuration is refused: {error}") from error


def rebuilt(known: Recorded, config: Config | None = None) -> Core:
    """Build the recorded core, or that of another configuration with the recorded scene."""
    found, model = "", known.box.metadata["model"]
    for folder in (Path(known.box.metadata["scene_folder"]), known.box.path.absolute().parent):
        try:
            core = build_core(config or known.config, known.scene, folder)
        except (ConfigError, ValueError, OSError) as error:
            found = found or str(error)
            continue
        if core.model == model:
            return core
        found = f"the model {known.scene.insert.model!r} that is here has the hash {core.model[:SHOWN]}"
    raise ReplayError(f"the model with the hash {model[:SHOWN]!r} has to be beside the file: {found}")


def differences(header: dict[str, str]) -> list[str]:
    """List what differs since the file was written: build, platform."""
    found = []
    here, there = sources_hash(), header["sources_sha256"]
    if here != there:
        found.append(
            f"build: tormagd {header['version'][:20]} with the sources {there[:SHOWN]} was recorded, here is "
            f"tormagd {__version__} with {here[:SHOWN]}"
        )
    if header["platform"] != platform_name():
        found.append(f"platform: {header['platform'][:80]} was recorded, here is {platform_name()}")
    return found


class Found(msgspec.Struct, frozen=True):
    """The first difference: its field, both values, and the frame that it belongs to. `tick` counts from 1, `time_s`
    from the file's first tick."""

    field: str
    recorded: Any
    replayed: Any
    frame: int | None = None
    tick: int = 0
    time_s: float = 0.0


class DifferenceError(Exception):
    """What is run differs from what was recorded, as the argument tells, which is Found."""


def require_same(where: str, recorded: Any, replayed: Any, frame: int | None = None) -> None:
    """Raise DifferenceError at the first difference between two plain values, its field prefixed with `where`."""
    found = first_difference(recorded, replayed)
    if found is not None:
        raise DifferenceError(Found(f"{where}.{found[0]}".strip("."), *found[1:], frame))


class Conversation:
    """The link with the device as it was when it had this `memory`; what it reads and writes is recorded."""

    def __init__(self, memory: Any) -> None:
        told = memory["stream"]
        is_serial = FrameStream.__name__ in told
        self.stream: Stream = FrameStream() if is_serial else CanStream(told[CanStream.__name__]["node"])
        self._unread: Sequence[Any] = ()
        self._written: list[Sent] = []
        self.connection = connection.Connection(Device(), lambda: self, lambda: None)
        self.connection.open(0.0)
        self.connection.remember(memory, stream.KNOWN)

    def read(self, now_s: float, raw: Any) -> None:
        self._unread = raw if isinstance(raw, list) else [raw]
        self.connection.receive(now_s)

    def write(self, now_s: float, unsent: int, output: Duty) -> list[Sent]:
        """Send a step's `output` again, and return the frames."""
        self._written, self.stream.statistics.unsent = [], unsent
        self.connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        return self._written

    def receive(self) -> list[Message]:
        """Decode what `read` was last given; empty when called again."""
        pieces, self._unread = self._unread, ()
        if isinstance(self.stream, FrameStream):
            return [message for piece in pieces for message in self.stream.unpack(piece)]
        try:
            return self.stream.unpack_all(msgspec.convert(pieces, list[tuple[int, bytes]]))
        except SecondHostError as error:
            raise BackendError("another host drives the node") from error

    def send(self, message: Message) -> None:
        self._written.append(self.stream.pack(message))

    def close(self) -> None:
        """Do nothing: no port is open."""


def _shown(frame: Any) -> str:
    """Return a frame as hexadecimal text, behind the identifier and "#" on a bus."""
    if frame is None:
        return "nothing"
    if isinstance(frame, bytes):
        return frame.hex()
    identifier, data = frame
    return f"{identifier:03X}#{data.hex()}"


UNTAKEN = (
    TypeError, AttributeError, ValueError, ArithmeticError, LookupError, AssertionError, RuntimeError, RecursionError,
)  # fmt: skip
"The core may raise these for values that it never makes itself."
SETPOINT = tuple[
    float, float, float, float | None, float | None, tuple[float, ...], float, int, tuple[Limit, ...], float | None,
    Any,
]  # fmt: skip
NOT_THE_CORES = 1
"Leading columns that the core does not make: `t_ns`, from the clock."


def planned_for(entry: Any) -> tuple[float, TimedSetpoint | None]:
    """Return when a recorded plan began, and its setpoint."""
    now_s, fields = msgspec.convert(entry[1:], tuple[float, SETPOINT | None])
    return now_s, None if fields is None else TimedSetpoint(*fields[:-1], restored(fields[-1], stream.KNOWN))


class Rerun(msgspec.Struct, frozen=True):
    """What a replay gave: `ticks` that agree to the bit, from `from_s` to `to_s`."""

    ticks: int
    from_s: float
    to_s: float
    snapshots: int
    gaps: int
    frames: int
    difference: Found | None


def ticks_of(entries: list[Any]) -> dict[int, Any]:
    """Return the ticks by their place among the entries."""
    records: dict[int, Any] = {}
    for place, entry in enumerate(entries):
        if is_tick(entry):
            try:
                records[place] = msgspec.convert(entry, stream.TickRecord)
            except msgspec.ValidationError as error:
                raise ReplayError(f"tick {len(records) + 1}: {error}") from error
    if not records:
        raise ReplayError("there is no tick in it")
    return records


def rerun(core: Core, entries: list[Any], from_s: float = 0.0) -> Rerun:
    """Run `core` over the entries, up to the first difference or the last tick."""
    records = ticks_of(entries)
    places = list(records)
    first_s = records[places[0]].monotonic_s
    lasts_s = records[places[-1]].monotonic_s - first_s
    if not 0.0 <= from_s <= lasts_s:
        raise ReplayError(f"--from = {from_s:g}: allowed is 0..{lasts_s:.3f} s")
    at = _start(entries, records, first_s + from_s)
    number = bisect_right(places, at)
    from_s, agreed, to_s = records[places[number]].monotonic_s - first_s, 0, 0.0
    difference: Found | None = None
    running = _Running(core)
    try:
        running.frame = sum(len(frames_in(entry)) for entry in entries[:at])
        for place in places[number:]:
            number += 1
            time_s = records[place].monotonic_s - first_s
            running.run(entries[at:place], records[place])
            at = place + 1
            if running.is_known:
                agreed, to_s = agreed + 1, time_s
    except DifferenceError as error:
        (found,) = error.args
        told = {"recorded": _short(found.recorded), "replayed": _short(found.replayed)}
        difference = msgspec.structs.replace(found, tick=number, time_s=round(time_s, 6), **told)
    except UNTAKEN as error:
        raise ReplayError(f"tick {number}: the core does not take what stands there: {_short(error)}") from error
    return Rerun(agreed, from_s, to_s, running.snapshots, running.gaps, running.frames, difference)


def _start(entries: list[Any], records: dict[int, Any], until_s: float) -> int:
    """Return the index of the newest snapshot that a tick follows by `until_s`, else of the first."""
    places = list(records)
    snapshots = [place for place, entry in enumerate(entries[: places[-1]]) if name_of(entry) == stream.STATE]
    if not snapshots:
        raise ReplayError("there is no snapshot in it that is followed by a tick: under a second was kept")
    early = [each for each in snapshots if records[places[bisect_right(places, each)]].monotonic_s <= until_s]
    return early[-1] if early else snapshots[0]


class _Running:
    def __init__(self, core: Core) -> None:
        self._core = stream.core_hash(core.config, core.scene, core.model)
        self._stepper, self._planner = core.stepper(), core.planner()
        self._ran: tuple[Duty, Plan, Measurement | None] | None = None
        "Output, plan and measurement of the newest step."
        self._link: Conversation | None = None
        self._of_frames: list[tuple[str, Any, Any, int]] = []
        "What the frames give, as recorded and replayed: a tick's columns are compared before."
        self._failure: Exception | None = None
        self.is_known = False
        self.frame = self.frames = self.snapshots = self.gaps = 0

    def run(self, entries: list[Any], record: Any) -> None:
        """Run the entries of one control period, whose tick comes after them. Raises DifferenceError."""
        for entry in entries:
            name, frames = name_of(entry), len(frames_in(entry))
            self.frame += frames
            if name == stream.STATE:
                self._begin(*entry[1:])
            elif name == stream.MISSING:
                self.gaps += self.is_known
                self.is_known = False
            elif self.is_known:
                self.frames += frames
                self._take(name, entry, record)
        if self.is_known:
            self._compare(record)

    def _take(self, name: str, entry: Any, record: Any) -> None:
        """Do what one entry tells: a step, something of the link, or something of the core."""
        match name:
            case stream.STEP:
                self._step(record)
            case connection.CONNECTED:
                self._link = None if entry[1] is None else Conversation(entry[1])
            case connection.READ if self._link is not None:
                self._link.read(*entry[1:])
            case connection.WROTE if self._link is not None:
                self._write(self._link, *entry[1:])
            case stream.LOSE_LINK:
                self._stepper.lose_link()
            case stream.TOLD:
                pass
            case _:
                self._run(name, entry)

    def _run(self, name: str, entry: Any) -> None:
        """Do what one entry of the core tells: plan, learning, command or fault."""
        match name:
            case stream.PLAN:
                self._plan(*planned_for(entry))
            case stream.FORESEE:
                self._planner.governor.foresee()
            case stream.AFRESH:
                self._failure = None
                self._planner.afresh(msgspec.convert(entry[1], float))
            case stream.TEACH:
                self._planner.believe.teach(restored(entry[1], stream.KNOWN))
            case stream.ANSWER:
                self._planner.aim.answer = restored(entry[1], stream.KNOWN)
            case stream.CONFIRM:
                self._planner.believe.confirm(msgspec.convert(entry[1], Disputed))
            case stream.COMMAND:
                self._command(*msgspec.convert(entry[1:], tuple[str, float, bool, dict[str, Any]]))
            case stream.LATCH:
                self._stepper.latch(Fault(entry[1]))
            case _:
                raise ValueError(f"{name[:40]!r}: no entry of a black box")

    def _plan(self, now_s: float, timed: TimedSetpoint | None) -> None:
        try:
            self._planner.plan(now_s, timed, self._stepper.measured, self._stepper.is_followed)
        except PLAN_ERRORS as error:
            self._failure = error

    def _step(self, record: Any) -> None:
        measurement, plan = stream.measurement_of(record), self._planner.planned
        told = plain(measurement)
        own = told if self._link is None else plain(self._link.connection.measurement)
        self._of_frames = [("measurement", told, own, self.frame)]
        self._ran = self._stepper.step(record.monotonic_s, measurement, plan), plan, measurement

    def _write(self, link: Conversation, now_s: float, recorded: list[Any], unsent: int) -> None:
        if self._ran is None:
            raise ValueError("something written without a step")
        pairs = zip_longest(recorded, link.write(now_s, unsent, self._ran[0]))
        for number, (told, own) in enumerate(pairs, self.frame - len(recorded) + 1):
            self._of_frames.append(("written", _shown(told), _shown(own), number))

    def _command(self, name: str, now_s: float, was_refused: bool, given: dict[str, Any]) -> None:
        refusal = "taken"
        try:
            self._stepper.command(name, now_s, restored(given, stream.KNOWN))
        except RefusedError as error:
            refusal = f"refused: {error.message}"
        if was_refused is (refusal == "taken"):
            raise DifferenceError(Found(name, "refused" if was_refused else "taken", refusal))

    def _compare(self, record: Any) -> None:
        """Compare what is run with the recorded tick, column by column, and then what its frames gave."""
        if self._ran is None:
            raise ValueError("a tick without a step")
        if self._failure is not None:
            raise DifferenceError(Found("plan", "made", f"failed: {self._failure}"))
        given = stream.Moment(self._stepper, *self._ran, record.lateness_us, record.exec_us, record.tick).row()
        left, right = msgspec.structs.astuple(record)[NOT_THE_CORES:], msgspec.structs.astuple(given)[NOT_THE_CORES:]
        if packed(left) != packed(right):
            rows = zip(stream.COLUMNS[NOT_THE_CORES:], left, right, strict=True)
            raise DifferenceError(next(Found(*row) for row in rows if packed(row[1]) != packed(row[2])))
        for pair in self._of_frames:
            require_same(*pair)

    def _begin(self, step: Any, plan: Any, memory: Any, core: str) -> None:
        """Compare the states with a snapshot's, if they are known, and then take them."""
        require_same("core", core, self._core)
        if self.is_known:
            self.snapshots += 1
            require_same("state.step", step, plain(self._stepper))
            require_same("state.plan", plan, plain(self._planner))
            own = None if self._link is None else self._link.connection.memory()
            require_same("state.connection", memory, own, self.frame)
        self._link = None if memory is None else Conversation(memory)
        restore(self._stepper, step, stream.KNOWN)
        restore(self._planner, plan, stream.KNOWN)
        self._failure, self.is_known = None, True


def name_of(entry: Any) -> str:
    """Return the word at the head of an entry; empty for a tick."""
    is_named = isinstance(entry, list) and bool(entry) and isinstance(entry[0], str)
    return entry[0] if is_named else ""


def _short(thing: object) -> str:
    text = str(thing) if isinstance(thing, Exception | str) else repr(thing)
    return text if len(text) <= 200 else f"{text[:197]}..."
