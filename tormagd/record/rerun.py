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
from firmware_protocol.codec import DeviceFault, DeviceMode, Identity, Message, Sense, State, Status, Switches
from firmware_protocol.framing import Frame, FramingStatistics
from tormagd import __version__
from tormagd.config import Config, Device, checked
from tormagd.control.assembly.build import Core, build_core, platform_name, sources_hash
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor import Disputed
from tormagd.control.core import PLAN_ERRORS
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.element.inverse.solution import Answer
from tormagd.ground.plain_values import first_difference, kinds, packed, plain, restore, restored
from tormagd.hardware import connection
from tormagd.hardware.backend import BackendError, Sent, Stream
from tormagd.hardware.link import LinkState
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.hardware.measurement import DeviceRequest, Measurement
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
        hint = "; another tormagd wrote it: replay it with that one" if other else ""
        raise ReplayError(f"{path}: {error}{hint}") from error


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


KNOWN_OF_LINK = kinds(
    *(LinkState, DeviceRequest, Identity, State, Sense, Status, DeviceMode, Switches, DeviceFault),
    *(LinkQuality, Frame, FramingStatistics),
)


class Found(msgspec.Struct, frozen=True):
    """The first difference: its field, both values, and the frame that it belongs to. `tick` counts from 1, `time_s`
    from the file's first tick."""

    field: str
    recorded: Any
    replayed: Any
    frame: int | None = None
    tick: int = 0
    time_s: float = 0.0


def differing(where: str, recorded: Any, replayed: Any, frame: int | None = None) -> Found | None:
    """Return the first difference between two plain values, its field prefixed with `where`."""
    found = first_difference(recorded, replayed)
    return None if found is None else Found(f"{where}.{found[0]}".strip("."), *found[1:], frame)


class Conversation:
    def __init__(self, frame: int) -> None:
        self._connection: connection.Connection | None = None
        self.stream: Stream = FrameStream()
        self._unread: Sequence[Any] = ()
        self._written: list[Sent] = []
        self.frame = frame
        self.frames = 0

    def begin(self, memory: Any) -> None:
        self._connection = None
        if memory is not None:
            told = memory["stream"]
            is_serial = FrameStream.__name__ in told
            self.stream = FrameStream() if is_serial else CanStream(told[CanStream.__name__]["node"])
            self._connection = own = connection.Connection(Device(), lambda: self, lambda: None)
            own.open(0.0)
            own.remember(memory, KNOWN_OF_LINK)

    def compare_memory(self, recorded: Any) -> Found | None:
        """Return where the connection's memory differs from the `recorded` one."""
        own = self._connection
        return None if own is None else differing("state.connection", recorded, own.memory(), self.frame)

    def compare(self, recorded: Measurement | None) -> Found | None:
        """Return where the newest measurement differs from the recorded step's."""
        own = self._connection
        return None if own is None else differing("measurement", plain(recorded), plain(own.measurement), self.frame)

    def read(self, entry: Any) -> None:
        if self._connection is not None:
            _, now_s, raw = entry
            self._unread = pieces = raw if isinstance(raw, list) else [raw]
            self._connection.receive(now_s)
            self.frames += len(pieces)

    def wrote(self, entry: Any, output: Duty) -> Found | None:
        """Send a step's `output` again, and return the first frame that differs from the WROTE entry's."""
        if self._connection is None:
            return None
        _, now_s, recorded, unsent = entry
        self._written, self.stream.statistics.unsent = [], unsent
        self._connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        for number, (told, own) in enumerate(zip_longest(recorded, self._written), self.frame - len(recorded) + 1):
            if packed(told) != packed(own):
                return Found("written", _shown(told), _shown(own), number)
        self.frames += len(recorded)
        return None

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
    start = _start(entries, records, first_s + from_s)
    try:
        running = _Running(core, sum(len(frames_in(entry)) for entry in entries[:start]))
    except (ValueError, TypeError) as error:
        raise ReplayError(f"before the start: no frames: {_short(error)}") from error
    number = bisect_right(places, start)
    from_s, agreed, to_s = records[places[number]].monotonic_s - first_s, 0, 0.0
    difference: Found | None = None
    for place in range(start, places[-1] + 1):
        # a step's inputs are in the record of its period, which comes after the period's other entries
        record = records[places[number]]
        time_s = record.monotonic_s - first_s
        try:
            differs = running.compare(record) if place in records else running.take(entries[place], record)
        except UNTAKEN as error:
            raise ReplayError(
                f"tick {number + 1}: the core does not take what stands there: {_short(error)}"
            ) from error
        if differs is not None:
            told = {"recorded": _short(differs.recorded), "replayed": _short(differs.replayed)}
            difference = msgspec.structs.replace(differs, tick=number + 1, time_s=round(time_s, 6), **told)
            break
        if place in records:
            number += 1
            if running.is_known:
                agreed, to_s = agreed + 1, time_s
    return Rerun(agreed, from_s, to_s, running.snapshots, running.gaps, running.conversation.frames, difference)


def _start(entries: list[Any], records: dict[int, Any], until_s: float) -> int:
    """Return the index of the newest snapshot that a tick follows by `until_s`, else of the first."""
    places = list(records)
    snapshots = [place for place, entry in enumerate(entries[: places[-1]]) if name_of(entry) == stream.STATE]
    if not snapshots:
        raise ReplayError("there is no snapshot in it that is followed by a tick: under a second was kept")
    early = [each for each in snapshots if records[places[bisect_right(places, each)]].monotonic_s <= until_s]
    return early[-1] if early else snapshots[0]


class _Running:
    def __init__(self, core: Core, frame: int) -> None:
        self.conversation, self._core = Conversation(frame), stream.core_hash(core.config, core.scene, core.model)
        self._of_frames: Found | None = None
        self._stepper, self._planner = core.stepper(), core.planner()
        self._used = self._planner.planned
        self._failure: Exception | None = None
        self._output: Duty | None = None
        self._measurement: Measurement | None = None
        self.is_known = False
        self.snapshots = self.gaps = 0

    def take(self, entry: Any, record: Any) -> Found | None:
        """Take one entry that is no tick, and return the first difference."""
        name = name_of(entry)
        self.conversation.frame += len(frames_in(entry))
        if name == stream.STATE:
            return self._begin(entry)
        if name == stream.MISSING:
            self.gaps += self.is_known
            self.is_known = False
            self.conversation.begin(None)
        elif name == connection.READ:
            self.conversation.read(entry)
        elif name == connection.CONNECTED:
            self.conversation.begin(entry[1])
        elif self.is_known and name != stream.TOLD:
            return self._run(name, entry, record)
        return None

    def _run(self, name: str, entry: Any, record: Any) -> Found | None:
        """Do what one entry tells: step, plan, learning, command or fault."""
        match name:
            case stream.STEP:
                self._measurement = stream.measurement_of(record)
                self._of_frames = self.conversation.compare(self._measurement)
                self._used = self._planner.planned
                self._output = self._stepper.step(record.monotonic_s, self._measurement, self._used)
            case connection.WROTE:
                if self._output is None:
                    raise ValueError("something written without a step")
                self._of_frames = self._of_frames or self.conversation.wrote(entry, self._output)
            case stream.PLAN:
                now_s, timed = planned_for(entry)
                try:
                    self._planner.plan(now_s, timed, self._stepper.measured, self._stepper.is_followed)
                except PLAN_ERRORS as error:
                    self._failure = error
            case stream.FORESEE:
                self._planner.governor.foresee()
            case stream.AFRESH:
                self._failure = None
                self._planner.afresh(msgspec.convert(entry[1], float))
            case stream.TEACH | stream.ANSWER:
                match restored(entry[1], stream.KNOWN):
                    case Learned() as learned:
                        self._planner.believe.teach(learned)
                    case Answer() as answer:
                        self._planner.aim.answer = answer
                    case other:
                        raise ValueError(f"{other!r}: allowed is what is learned of a device, or what a search found")
            case stream.CONFIRM:
                self._planner.believe.confirm(msgspec.convert(entry[1], Disputed))
            case stream.COMMAND:
                command, now_s, was_refused, given = msgspec.convert(entry[1:], tuple[str, float, bool, dict[str, Any]])
                try:
                    self._stepper.command(command, now_s, restored(given, stream.KNOWN))
                except RefusedError as error:
                    return None if was_refused else Found(command, "taken", f"refused: {error.message}")
                if was_refused:
                    return Found(command, "refused", "taken")
            case stream.LATCH:
                self._stepper.latch(Fault(entry[1]))
            case stream.LOSE_LINK:
                self._stepper.lose_link()
            case _:
                raise ValueError(f"{name[:40]!r}: no entry of a black box")
        return None

    def compare(self, record: Any) -> Found | None:
        """Return the first column that differs from the recorded tick, or else what its frames show."""
        if not self.is_known:
            return None
        if self._output is None:
            raise ValueError("a tick without a step")
        timing = record.lateness_us, record.exec_us, record.tick
        if self._failure is not None:
            return Found("plan", "made", f"failed: {self._failure}")
        given = stream.Moment(self._stepper, self._output, self._used, self._measurement, *timing).row()
        left, right = msgspec.structs.astuple(record)[NOT_THE_CORES:], msgspec.structs.astuple(given)[NOT_THE_CORES:]
        if packed(left) == packed(right):
            return self._of_frames
        rows = zip(stream.COLUMNS[NOT_THE_CORES:], left, right, strict=True)
        return next(Found(*row) for row in rows if packed(row[1]) != packed(row[2]))

    def _begin(self, entry: Any) -> Found | None:
        """Compare the states with a snapshot's, if they are known, and then take them."""
        _, step, plan, memory, core = entry
        if core != self._core:
            return Found("core", core, self._core)
        differs = None
        if self.is_known:
            self.snapshots += 1
            for what, recorded, own in (("step", step, self._stepper), ("plan", plan, self._planner)):
                differs = differs or differing(f"state.{what}", recorded, plain(own))
            differs = differs or self.conversation.compare_memory(memory)
        self.conversation.begin(memory)
        restore(self._stepper, step, stream.KNOWN)
        restore(self._planner, plan, stream.KNOWN)
        self._failure, self.is_known = None, True
        return differs


def name_of(entry: Any) -> str:
    """Return the word at the head of an entry; empty for a tick."""
    is_named = isinstance(entry, list) and bool(entry) and isinstance(entry[0], str)
    return entry[0] if is_named else ""


def _short(thing: object) -> str:
    text = str(thing) if isinstance(thing, Exception | str) else repr(thing)
    return text if len(text) <= 200 else f"{text[:197]}..."
