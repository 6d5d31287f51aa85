"""Runs a core again over its recorded inputs: the same bits, or the first tick and field that differ.

The conversation with the device is run again, too: the same `Connection`, fed what was read at the recorded times.
"""

from bisect import bisect_right
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

import msgspec

from firmware_protocol.codec import DeviceFault, DeviceMode, Identity, Message, Sense, State, Status, Switches
from firmware_protocol.framing import Frame, FramingStatistics
from tormagd.config import Device
from tormagd.control.assembly.build import Core
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor import Disputed
from tormagd.control.core import PLAN_ERRORS
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.element.inverse.solution import Answer
from tormagd.ground.plain_values import first_difference, kinds, packed, plain, restore, restored
from tormagd.hardware.backend import BackendError, Sent, Stream
from tormagd.hardware.connection import Connection
from tormagd.hardware.link import LinkState
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.hardware.streams import CanStream, FrameStream, SecondHostError
from tormagd.record import journal
from tormagd.record.black_box import ReplayError
from tormagd.record.journal import KNOWN, core_hash
from tormagd.record.telemetry import COLUMNS, Moment, TickRecord, measurement_of
from tormagd.record.writer import frames_in, is_tick

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
        self._connection: Connection | None = None
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
            connection = Connection(Device(), lambda: self, lambda: None)
            connection.open(0.0)
            connection.remember(memory, KNOWN_OF_LINK)
            self._connection = connection

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
    return now_s, None if fields is None else TimedSetpoint(*fields[:-1], restored(fields[-1], KNOWN))


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
                records[place] = msgspec.convert(entry, TickRecord)
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
    found: list[int] = []
    waiting: int | None = None
    for place, entry in enumerate(entries):
        if name_of(entry) == journal.STATE:
            waiting = place
        elif place in records and waiting is not None:
            if not found or records[place].monotonic_s <= until_s:
                found.append(waiting)
            waiting = None
    if not found:
        raise ReplayError("there is no snapshot in it that is followed by a tick: under a second was kept")
    return found[-1]


class _Running:
    def __init__(self, core: Core, frame: int) -> None:
        self.conversation, self._core = Conversation(frame), core_hash(core.config, core.scene, core.model)
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
        if name == journal.TOLD:
            return None
        self.conversation.frame += len(frames_in(entry))
        if name == journal.STATE:
            return self._begin(entry)
        if name == journal.MISSING:
            self.gaps += self.is_known
            self.is_known = False
            self.conversation.begin(None)
        elif name == journal.READ:
            self.conversation.read(entry)
        elif name == journal.CONNECTED:
            self.conversation.begin(entry[1])
        elif self.is_known:
            return self._run(name, entry, record)
        return None

    def _run(self, name: str, entry: Any, record: Any) -> Found | None:
        """Do what one entry tells: step, plan, learning, command or fault."""
        match name:
            case journal.STEP:
                self._measurement = measurement_of(record)
                self._of_frames = self.conversation.compare(self._measurement)
                self._used = self._planner.planned
                self._output = self._stepper.step(record.monotonic_s, self._measurement, self._used)
            case journal.WROTE:
                if self._output is None:
                    raise ValueError("something written without a step")
                self._of_frames = self._of_frames or self.conversation.wrote(entry, self._output)
            case journal.PLAN:
                now_s, timed = planned_for(entry)
                try:
                    self._planner.plan(now_s, timed, self._stepper.measured, self._stepper.is_followed)
                except PLAN_ERRORS as error:
                    self._failure = error
            case journal.FORESEE:
                self._planner.governor.foresee()
            case journal.AFRESH:
                self._failure = None
                self._planner.afresh(msgspec.convert(entry[1], float))
            case journal.TEACH | journal.ANSWER:
                match restored(entry[1], KNOWN):
                    case Learned() as learned:
                        self._planner.believe.teach(learned)
                    case Answer() as answer:
                        self._planner.aim.answer = answer
                    case other:
                        raise ValueError(f"{other!r}: allowed is what is learned of a device, or what a search found")
            case journal.CONFIRM:
                self._planner.believe.confirm(msgspec.convert(entry[1], Disputed))
            case journal.COMMAND:
                command, now_s, was_refused, given = msgspec.convert(entry[1:], tuple[str, float, bool, dict[str, Any]])
                try:
                    self._stepper.command(command, now_s, restored(given, KNOWN))
                except RefusedError as error:
                    return None if was_refused else Found(command, "taken", f"refused: {error.message}")
                if was_refused:
                    return Found(command, "refused", "taken")
            case journal.LATCH:
                self._stepper.latch(Fault(entry[1]))
            case journal.LOSE_LINK:
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
        given = Moment(self._stepper, self._output, self._used, self._measurement, *timing).row()
        left, right = msgspec.structs.astuple(record)[NOT_THE_CORES:], msgspec.structs.astuple(given)[NOT_THE_CORES:]
        if packed(left) == packed(right):
            return self._of_frames
        rows = zip(COLUMNS[NOT_THE_CORES:], left, right, strict=True)
        return next(Found(*row) for row in rows if packed(row[1]) != packed(row[2]))

    def _begin(self, entry: Any) -> Found | None:
        """Compare the states with a snapshot's, if they are known, and then take them."""
        _, step, plan, connection, core = entry
        if core != self._core:
            return Found("core", core, self._core)
        differs = None
        if self.is_known:
            self.snapshots += 1
            for what, recorded, own in (("step", step, self._stepper), ("plan", plan, self._planner)):
                differs = differs or differing(f"state.{what}", recorded, plain(own))
            differs = differs or self.conversation.compare_memory(connection)
        self.conversation.begin(connection)
        restore(self._stepper, step, KNOWN)
        restore(self._planner, plan, KNOWN)
        self._failure, self.is_known = None, True
        return differs


def name_of(entry: Any) -> str:
    """Return an entry's name, a word by itself or at the head of a list; empty for a tick."""
    if isinstance(entry, str):
        return entry
    if isinstance(entry, list) and entry and isinstance(entry[0], str):
        return entry[0]
    return ""


def _short(thing: object) -> str:
    text = str(thing) if isinstance(thing, Exception | str) else repr(thing)
    return text if len(text) <= 200 else f"{text[:197]}..."
