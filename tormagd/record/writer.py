"""Writing a recording or a black box: MCAP, compressed with zstd.

`/core` has the journal's entries as they came, in msgpack, for a replay. `/ticks`, `/frames` and `/telemetry` are
derived of them, in JSON with plain schemas, for Foxglove and PlotJuggler: a number there cannot be null, so what is not
known is left out. An overview stands at the end.
"""

import contextlib
import errno
import fcntl
import math
import os
import shutil
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import msgspec
from mcap.writer import Writer

from tormagd import __version__
from tormagd.ground.files import in_place_of, new_file
from tormagd.ground.terminal import write_line
from tormagd.hardware.connection import READ, WROTE
from tormagd.record.folder import NoRoomError, RecordingFolder
from tormagd.record.overview import OverviewBuilder
from tormagd.record.stream import COLUMNS, TOLD, kind_of
from tormagd.record.ticks import TickBatch, Value
from tormagd_client.messages import Mark, Telemetry

ABOUT = "tormagd"
CUT = "cut_by"
"Metadata key: why the recording ended early."
THINNED = "thinned"
"Metadata key: which ticks are there, if not all."
OVERVIEW = "overview 3"
"Version 3 has its curves in two arrays."
TELEMETRY_TOPIC = "/telemetry"
TICKS_TOPIC, FRAMES_TOPIC, CORE_TOPIC = "/ticks", "/frames", "/core"
NUMBER_COLUMN = "tick"
"A missing number is a lost tick."
CHUNK_NS = 500_000_000
"Lost if the recorder is killed."
MIN_FREE_BYTES = 16_000_000
"A recording ends before the disk is full: the last chunk and the index need room."
INDEX_SHARE = 64
AROUND_S = 10.0
AROUND_NS = round(AROUND_S * 1e9)


def require_room(path: Path, needed_bytes: int) -> None:
    """Raise NoRoomError where the disk has no room for `needed_bytes`."""
    free, least = shutil.disk_usage(path.parent).free, MIN_FREE_BYTES + needed_bytes
    if free < least:
        said = f"No space left on device: {free / 1e6:.1f} MB are free, needed are {least / 1e6:.1f}"
        raise NoRoomError(errno.ENOSPC, said)


class Frame(msgspec.Struct, frozen=True, omit_defaults=True):
    """Bytes between daemon and device: one CAN frame, one read of a serial port, or one frame written to it."""

    monotonic_s: float
    direction: str
    "By the daemon: read or wrote."
    data: str
    identifier: int | None = None


def frames_in(entry: Any) -> list[Frame]:
    """Return the frames in one entry of the journal."""
    if not isinstance(entry, list) or not entry or entry[0] not in (READ, WROTE):
        return []
    direction, time_s, raw, *_ = entry
    pieces = [(None, each) if isinstance(each, bytes) else each for each in (raw if isinstance(raw, list) else [raw])]
    if not all(isinstance(data, bytes) for _, data in pieces):
        raise TypeError("a frame is bytes")
    return [Frame(time_s, direction, data.hex(), identifier) for identifier, data in pieces]


def is_tick(entry: Any) -> bool:
    """Return whether an entry is a tick: a list that begins with an integer."""
    return isinstance(entry, list) and bool(entry) and type(entry[0]) is int


class Shown(NamedTuple):
    """A message of a recording: topic, time in ns since 1970, number within the topic and file."""

    topic: str
    t_ns: int
    sequence: int
    message: Any

    @property
    def is_tick(self) -> bool:
        return self.topic == TICKS_TOPIC


class Thinning:
    """Keeps one tick of `every` where nothing happens, and all within AROUND_S of a fault or a mark."""

    def __init__(self, every: int) -> None:
        self.every = every
        self._waiting: deque[Shown] = deque()
        self._count = self._full_to_ns = 0
        self._faults: Any = ()

    def happened(self, t_ns: int) -> None:
        self._full_to_ns = max(self._full_to_ns, t_ns + AROUND_NS)

    def take(self, tick: Shown) -> list[Shown]:
        """Add a tick, and return the ticks to be written now, often none."""
        faults = tick.message.get("faults", ())
        if faults and faults != self._faults:
            self.happened(tick.t_ns)
        self._faults = faults
        self._waiting.append(tick)
        is_full = self.every == 1 or tick.t_ns <= self._full_to_ns
        return self.until(tick.t_ns if is_full else tick.t_ns - AROUND_NS)

    def until(self, t_ns: float = math.inf) -> list[Shown]:
        """Take the waiting ticks up to this time, and return those to be written."""
        given = []
        while self._waiting and self._waiting[0].t_ns <= t_ns:
            tick = self._waiting.popleft()
            self._count += 1
            if tick.t_ns <= self._full_to_ns or not self._count % self.every:
                given.append(tick)
        return given


class Derived:
    """Derives the messages of the other topics from the journal's entries. Their times go on with the monotonic clock,
    whatever steps the wall clock takes."""

    def __init__(self) -> None:
        self._numbers = {TELEMETRY_TOPIC: count(), TICKS_TOPIC: count(), FRAMES_TOPIC: count(1)}
        self._offset_ns: int | None = None
        self._newest_ns = self._monotonic_ns = 0
        self._ahead_ns = 0
        "How far the wall clock has gone ahead."

    def of(self, columns: Sequence[str], entries: Sequence[Any]) -> Iterator[Shown]:
        """Yield a message for each tick, frame and snapshot, which is of the newest tick."""
        monotonic_at = columns.index("monotonic_s") if "monotonic_s" in columns else 0
        for tick in filter(is_tick, entries):  # frames before it have its offset
            self._place(tick[0], tick[monotonic_at])
            break
        for entry in entries:
            if is_tick(entry):
                t_ns = self._place(entry[0], entry[monotonic_at])
                yield self._shown(TICKS_TOPIC, t_ns, known_values(columns, entry))
            elif isinstance(entry, list) and entry[:1] == [TOLD]:
                yield self._shown(TELEMETRY_TOPIC, self._newest_ns or entry[1]["t_ns"], only_known(entry[1]))
            for frame in frames_in(entry):
                t_ns = max(round(frame.monotonic_s * 1e9) + (self._offset_ns or 0), 0)
                yield self._shown(FRAMES_TOPIC, t_ns, frame)

    def _shown(self, topic: str, t_ns: int, message: Any) -> Shown:
        return Shown(topic, t_ns, next(self._numbers[topic]), message)

    def _place(self, t_ns: int, monotonic_s: object) -> int:
        """Return the time of a tick, in ns since 1970."""
        if not isinstance(monotonic_s, float) or not 0.0 <= monotonic_s < 1e9:
            return t_ns
        monotonic_ns = round(monotonic_s * 1e9)
        if self._offset_ns is None or monotonic_ns < self._monotonic_ns:  # the first, or of another machine
            self._offset_ns = max(t_ns - self._ahead_ns, self._newest_ns) - monotonic_ns
        self._monotonic_ns, self._newest_ns = monotonic_ns, monotonic_ns + self._offset_ns
        self._ahead_ns = t_ns - self._newest_ns
        return self._newest_ns


class RecordingWriter:
    """Writes an MCAP recording, or in a folder several one after the other, until `close`."""

    def __init__(
        self,
        place: Path | RecordingFolder,
        metadata: Mapping[str, str] | None = None,
        every: int = 1,
    ) -> None:
        self._thinning, self._schemas = Thinning(every), dict(SCHEMAS)
        self._folder = place if isinstance(place, RecordingFolder) else None
        self._about = {"version": __version__, **(metadata or {})}
        if every > 1:
            self._about[THINNED] = f"one tick of {every}; all within {AROUND_S:g} s of a fault or a mark"
        self._last_tick: int | None = None
        self._mark: Mark | None = None
        self.telemetry_count = self.tick_count = self.ticks_lost = self.restarts = 0
        self._begin(place.new() if isinstance(place, RecordingFolder) else place)

    def _begin(self, path: Path) -> None:
        """Begin a new file, locked against pruning."""
        self.path = path
        with new_file(path):
            self._file = path.open("wb")
            with contextlib.suppress(OSError):  # some file systems know no locks
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._overview, self._derived = OverviewBuilder(), Derived()
            self._mcap = Writer(self._file, enable_data_crcs=True)
            self._mcap.start(profile="", library=f"tormagd {__version__}")
            self._mcap.add_metadata(ABOUT, self._about)
            self._file.flush()
        self._channels: dict[tuple[str, str], int] = {}
        self._channel_of(TELEMETRY_TOPIC)
        self._begin_ns = self._chunk_ns = 0

    def describe(self, metadata: dict[str, str]) -> None:
        """Write metadata, now and into every later file in the folder."""
        self._about |= metadata
        self._mcap.add_metadata(ABOUT, metadata)

    def ticks(self, batch: TickBatch) -> None:
        """Write a batch, and end the file where it is due."""
        entries = [list(row) for row in batch.rows]
        if batch.core:
            entries = msgspec.msgpack.decode(batch.core, type=list[Any])
        self.entries(batch.columns, entries, batch.core)
        lasts_s = (self._chunk_ns - self._begin_ns) * 1e-9
        if self._folder is not None and self._folder.is_due(self._file.tell(), lasts_s):
            try:
                path = self._folder.new()
            except OSError as error:  # what is written is ended in order, whatever the reason
                raise NoRoomError(error.errno, error.strerror) from error
            self._end()
            self._begin(path)

    def entries(self, columns: Sequence[str], entries: Sequence[Any], core: bytes) -> None:
        """Write `core`, which has these entries, and then what is derived of them; thinned, nothing for a replay."""
        self._schemas[TICKS_TOPIC] = TICK_SCHEMA if set(columns) <= set(COLUMNS) else OTHER_SCHEMA
        shown = list(self._derived.of(columns, entries))
        if self._thinning.every > 1:
            shown = [each for each in shown if each.topic != FRAMES_TOPIC]
        elif core:
            self._add(Shown(CORE_TOPIC, shown[-1].t_ns if shown else self._chunk_ns, 0, core))
        adds = {TICKS_TOPIC: self._tick, TELEMETRY_TOPIC: self._snapshot, FRAMES_TOPIC: self._add}
        for each in shown:
            adds[each.topic](each)

    def _snapshot(self, shown: Shown) -> None:
        self._add(shown)
        self.telemetry_count += 1
        mark = msgspec.convert(shown.message.get("mark"), Mark | None)
        if mark not in (None, self._mark):  # every snapshot has the newest, which may be from before this file
            self._thinning.happened(shown.t_ns)
            self._mark = mark
        if self._overview.add(shown.t_ns, False, {"mark": mark}) and self._folder is not None:
            try:
                self.path = self._folder.mark_around(self.path)
            except (OSError, ValueError) as error:  # somebody has renamed it
                write_line(f"the mark keeps no segment: {error}", sys.stderr)

    def _tick(self, shown: Shown) -> None:
        if isinstance(number := shown.message.get(NUMBER_COLUMN), int):
            if self._last_tick is not None:
                self.ticks_lost += max(number - self._last_tick - 1, 0)
                self.restarts += number < self._last_tick
            self._last_tick = number
        for kept in self._thinning.take(shown):
            self._add(kept)
        self._overview.add(shown.t_ns, True, shown.message)
        self.tick_count += 1

    def close(self) -> None:
        if not self._file.closed:
            try:
                for kept in self._thinning.until():
                    self._add(kept)
            except NoRoomError as error:
                self.__exit__(type(error), error, None)
                raise
            self._end()
            if self._folder is None:  # in a folder, `mark` renames it
                self.path.stat()

    def _end(self) -> None:
        with self._file:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            overview = msgspec.msgpack.encode(self._overview.made())
            self._mcap.add_attachment(0, 0, OVERVIEW, "application/msgpack", overview)
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(error, NoRoomError):
            self.describe({CUT: str(error.strerror)})
            self._end()
        elif isinstance(error, OSError):
            with contextlib.suppress(OSError):  # after a chunk that was cut, an index would make the file unreadable
                self._file.close()
        else:
            self.close()

    def _channel_of(self, topic: str) -> int:
        schema, schema_id, encoding = self._schemas[topic], 0, "msgpack"
        known = topic, schema["title"] if schema else ""
        if known not in self._channels:
            if schema:
                schema_id = self._mcap.register_schema(schema["title"], "jsonschema", msgspec.json.encode(schema))
                encoding = "json"
            self._channels[known] = self._mcap.register_channel(topic, encoding, schema_id)
        return self._channels[known]

    def _add(self, shown: Shown) -> None:
        topic, t_ns, sequence, message = shown
        # ticks that waited come after newer snapshots
        if not -2 * AROUND_NS <= t_ns - self._chunk_ns <= CHUNK_NS:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            index_bytes = self._file.tell() // INDEX_SHARE
            if self._folder is None:
                require_room(self.path, index_bytes)
            else:
                self._folder.require_room(index_bytes)
            self._file.flush()
            self._begin_ns, self._chunk_ns = self._begin_ns or t_ns, t_ns
        data = message if topic == CORE_TOPIC else msgspec.json.encode(message)
        self._mcap.add_message(self._channel_of(topic), t_ns, data, t_ns, sequence % 2**32)


def write_black_box(path: Path, header: dict[str, str], parts: Iterable[bytes]) -> None:
    """Write a black box of these entries, whole or not at all."""
    columns = msgspec.json.decode(header["columns"], type=tuple[str, ...])
    with in_place_of(path) as beside, RecordingWriter(beside, header) as writer:
        for part in parts:
            writer.entries(columns, msgspec.msgpack.decode(part, type=list[Any]), part)


def plain_schema(message: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON schema of a message without `$ref`, `anyOf` and tuples, which viewers do not read."""
    (schema,), definitions = msgspec.json.schema_components([message], ref_template="{name}")
    return {"title": f"tormagd.{message.__name__}", **_plain(schema, definitions)}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the first option that is not null, and a tuple's first type."""
    if "$ref" in schema:
        return _plain(definitions[schema["$ref"]], definitions)
    if "anyOf" in schema:
        return _plain(next(option for option in schema["anyOf"] if option != {"type": "null"}), definitions)
    if schema.get("type") == "array":
        items = schema.get("prefixItems", [schema.get("items")])[0]
        return {"type": "array", "items": _plain(items, definitions)}
    if "additionalProperties" in schema:  # named by who publishes
        return {"type": "object", "additionalProperties": _plain(schema["additionalProperties"], definitions)}
    if schema.get("type") == "object":
        properties = {name: _plain(inner, definitions) for name, inner in schema["properties"].items()}
        return {"type": "object", "properties": properties}
    return {"type": schema["type"]}


def known_values(columns: Sequence[str], row: Sequence[Value]) -> dict[str, Value]:
    """Return a tick's row as a message, without values that are None, NaN or infinite."""
    # inlines only_known: some sixty values a thousand times a second
    return {
        name: value
        for name, value in zip(columns, row, strict=True)
        if value is not None and (value.__class__ is not float or math.isfinite(value))
    }


_TYPES = {tuple[str, ...]: {"type": "array", "items": {"type": "string"}}, str | None: {"type": "string"}}
TICK_SCHEMA: dict[str, Any] = {
    "title": "tormagd.Tick",
    "type": "object",
    "properties": {name: _TYPES.get(kind_of(name), {"type": "number"}) for name in COLUMNS},
}
SCHEMAS: dict[str, Any] = {
    TELEMETRY_TOPIC: plain_schema(Telemetry),
    TICKS_TOPIC: TICK_SCHEMA,
    FRAMES_TOPIC: plain_schema(Frame),
    CORE_TOPIC: None,
}
OTHER_SCHEMA = {"title": "tormagd.OtherTick", "type": "object"}


def only_known(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: known for name, inner in value.items() if (known := only_known(inner)) is not None}
    if isinstance(value, list | tuple):
        return None if None in map(only_known, value) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
