"""Reading a recording: all of it at a glance, some seconds of it in columns, or the whole in columns."""

import contextlib
import math
import struct
from array import array
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypedDict

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
)
from numpy.typing import NDArray
from zstandard import ZstdError

from tormagd.recording.overview import Glance, Overview, OverviewBuilder, unpacked
from tormagd.recording.stream import END, HEAD, MAGIC, Record, Sent, Unpacker, contents, following, record_at
from tormagd.recording.writer import ABOUT, CUT, OVERVIEW, TELEMETRY_TOPIC, TICKS_TOPIC
from tormagd_client.regular_file import require_regular

MAX_FILE_BYTES = 1 << 40
MAX_NESTING = 3
MAX_COLUMNS = 512
MAX_WORDS, MAX_CHARACTERS = 256, 4_096
"In one value: of a list, and of a text."
MAX_VALUES, MAX_SOME_VALUES = 16_000_000, 64_000_000
"Of all columns together: of all fields, and of those alone that somebody wants."
MAX_INDEX = 1_000_000
"Chunks, some days of them."
TAIL_BYTES = HEAD.size + 20 + len(MAGIC)
UNREADABLE = (
    McapError, ZstdError, ValueError, OverflowError, MemoryError, RecursionError, struct.error, msgspec.MsgspecError,
)  # fmt: skip
"""What damage raises; MemoryError where a damaged length asks for more than there is."""


class RecordingError(ValueError):
    """A file that is not a readable recording: the text names the file and what is wrong with it."""


@dataclass(frozen=True, slots=True)
class Columns:
    """The messages of one topic, one row each, in the order they were written.

    `numbers[name]` is float64 of shape (rows,), with NaN where a value was not known; true and false are 1 and 0.
    `words[name]` holds a tuple of strings for each row. An object's or a list's members get names of their own:
    `tick.exec_us`, `duty.0`. What the file's schemas name has a column, known or not.
    """

    t_ns: NDArray[np.int64]
    numbers: dict[str, NDArray[np.float64]]
    words: dict[str, list[tuple[str, ...]]]


@dataclass(frozen=True, slots=True)
class Recording:
    """One file, or some seconds of it. `is_complete` is false where the recorder was killed or the disk was full: what
    was written before that is there."""

    telemetry: Columns
    ticks: Columns
    metadata: dict[str, str] = field(default_factory=dict)
    is_complete: bool = True

    def described(self, name: str, kind: Any) -> Any:
        """What its metadata say of `name`, a value of this type; None where they do not, or say something else."""
        return described(self.metadata, name, kind)


def described(metadata: dict[str, str], name: str, kind: Any) -> Any:
    """What metadata say of `name`, a value of this type; None where they do not, or say something else."""
    try:
        return msgspec.json.decode(metadata[name], type=kind)
    except (KeyError, msgspec.MsgspecError, RecursionError):
        return None


@contextlib.contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """The file in `path`. Raises RecordingError where it is not readable."""
    try:
        require_regular(path, MAX_FILE_BYTES)
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


@contextlib.contextmanager
def readable(name: str) -> Iterator[None]:
    """Damage that is met within is a RecordingError, in which the file is called `name`."""
    try:
        yield
    except RecordingError:
        raise
    except UNREADABLE as error:
        raise RecordingError(f"{name}: not an intact MCAP file ({str(error)[:200]})") from error


def scan(file: BinaryIO, name: str, take: Callable[[Record], None], message: Callable[[Sent], None]) -> bool:
    """Hands each of the file's messages to `message`, any other record to `take`, which may raise UNREADABLE; False
    where it ends in the middle of one. Raises RecordingError, in which the file is called `name`: not MCAP, or
    damaged."""
    last = -1
    with readable(name):
        for record in contents(file, message):
            last = record.opcode
            take(record)
        if last < 0:
            raise ValueError("there is nothing in it")
    return last == END


class Topics:
    """The channels of a file, as its records tell them."""

    def __init__(self) -> None:
        self._schemas: dict[int, bytes] = {}
        self.known: dict[int, str] = {}
        self.expected: dict[str, list[object]] = {TELEMETRY_TOPIC: [], TICKS_TOPIC: []}
        "By topic, the schemas of its messages."

    def take(self, record: Record) -> None:
        """A schema or a channel; any other record is passed over. Raises UNREADABLE."""
        if record.opcode == Opcode.SCHEMA:
            schema = record.read(Schema)
            self._schemas[schema.id] = schema.data
        elif record.opcode == Opcode.CHANNEL:
            channel = record.read(Channel)
            if channel.topic in self.expected and channel.id not in self.known and channel.schema_id in self._schemas:
                self.expected[channel.topic].append(msgspec.json.decode(self._schemas[channel.schema_id]))
            self.known[channel.id] = channel.topic

    def require(self, name: str) -> None:
        """Raises RecordingError where the file has neither topic."""
        if set(self.known.values()).isdisjoint(self.expected):
            raise RecordingError(
                f"{name}: no channel {TELEMETRY_TOPIC} or {TICKS_TOPIC} in it; `tormagctl record` makes one"
            )


class Place(NamedTuple):
    """A chunk: its messages' times, ns since 1970, and where it begins in the file."""

    from_ns: int
    to_ns: int
    at: int


class RecordingFile:
    """A recording on the disk, of any length: all of it at a glance, and any seconds of it in columns.

    Raises RecordingError: not readable, not MCAP, damaged, or not written by tormagd. Of a file whose recorder was
    killed, or of an older one, the overview is made from all of its messages; without `is_scanned` it is refused.
    """

    def __init__(self, path: Path, *, is_scanned: bool = True) -> None:
        self.path = path
        self.metadata: dict[str, str] = {}
        self._topics = Topics()
        self._places: list[Place] = []
        self._builder = OverviewBuilder()
        self.is_complete = True
        with opened(path) as file:
            with readable(str(path)):
                found = self._from_summary(file)
            if found is None:
                if not is_scanned:
                    raise RecordingError(f"{path}: it has no overview: its recorder did not end it, or is older")
                file.seek(0)
                self._places.clear()
                self.is_complete = scan(file, str(path), self._take, self._glance)
                found = self._builder.made()
        self.overview: Overview = found
        self._topics.require(str(path))
        self.is_complete &= CUT not in self.metadata

    def described(self, name: str, kind: Any) -> Any:
        """As `Recording.described`."""
        return described(self.metadata, name, kind)

    def between(self, from_ns: int, to_ns: int, only: Collection[str] | None = None) -> Recording:
        """What was recorded in this time, in columns; its metadata are the file's. Raises RecordingError."""
        builders = _Builders(self._topics, only)

        def message(sent: Sent) -> None:
            if from_ns <= sent.t_ns <= to_ns:
                builders.add(sent)

        unpacker = Unpacker()
        with opened(self.path) as file, readable(str(self.path)):
            for place in self._places:
                if place.from_ns <= to_ns and place.to_ns >= from_ns:
                    file.seek(place.at)
                    chunk = record_at(file, place.at)
                    if chunk is None or chunk.opcode != Opcode.CHUNK:
                        raise ValueError(f"no chunk at byte {place.at}, where its index has one")
                    for _ in unpacker.records(chunk, message):
                        pass
        return builders.recording(self.metadata, self.is_complete)

    def _from_summary(self, file: BinaryIO) -> Overview | None:
        """What stands at the end of a finished file; None where there is nothing."""
        at = file.seek(0, 2) - TAIL_BYTES
        file.seek(max(0, at))
        if at < 0 or not file.read().endswith(MAGIC):
            return None
        file.seek(at)
        footer = record_at(file, at)
        if footer is None or footer.opcode != Opcode.FOOTER:
            return None
        start = footer.read(Footer).summary_start
        overview: Overview | None = None
        told: list[int] = []
        file.seek(start)
        for record in following(file, start) if start else ():
            if record.opcode == Opcode.CHUNK_INDEX and len(self._places) < MAX_INDEX:
                index = record.read(ChunkIndex)
                self._places.append(Place(index.message_start_time, index.message_end_time, index.chunk_start_offset))
            elif record.opcode == Opcode.METADATA_INDEX:
                told.append(record.read(MetadataIndex).offset)
            elif record.opcode == Opcode.ATTACHMENT_INDEX:
                attached = record.read(AttachmentIndex)
                if attached.name == OVERVIEW:
                    back = file.tell()
                    overview = unpacked(_at(file, attached.offset, Opcode.ATTACHMENT).read(Attachment).data)
                    file.seek(back)
            else:
                self._topics.take(record)
        if overview is not None:
            for at in told:
                self._describe(_at(file, at, Opcode.METADATA))
        return overview

    def _take(self, record: Record) -> None:
        if record.opcode == Opcode.METADATA:
            self._describe(record)
        elif record.opcode == Opcode.CHUNK and len(self._places) < MAX_INDEX:
            chunk = record.read(Chunk)
            self._places.append(Place(chunk.message_start_time, chunk.message_end_time, record.at))
        else:
            self._topics.take(record)

    def _describe(self, record: Record) -> None:
        known = record.read(Metadata)
        if known.name == ABOUT:
            self.metadata.update(known.metadata)

    def _glance(self, sent: Sent) -> None:
        topic = self._topics.known.get(sent.channel)
        if topic in self._topics.expected:
            self._builder.add(sent.t_ns, _GLANCE.decode(sent.data), is_tick=topic == TICKS_TOPIC)


_GLANCE = msgspec.json.Decoder(Glance)


def _at(file: BinaryIO, at: int, opcode: Opcode) -> Record:
    file.seek(at)
    record = record_at(file, at)
    if record is None or record.opcode != opcode:
        raise ValueError(f"its index points to byte {at}, where something else is")
    return record


def read_recording(path: Path) -> Recording:
    """The recording in `path`, all in memory. Raises RecordingError: not readable, not MCAP, damaged, too large for
    that, or not written by tormagd."""
    with opened(path) as file:
        return read_open_recording(file, str(path))


def read_open_recording(file: BinaryIO, name: str, only: Collection[str] | None = None) -> Recording:
    """The recording in `file`, wherever that is, which errors call `name`; where `only` some fields of its messages are
    wanted, no others are kept. Raises RecordingError as `read_recording`; and OSError.
    """
    topics, metadata = Topics(), dict[str, str]()
    builders = _Builders(topics, only)

    def take(record: Record) -> None:
        if record.opcode == Opcode.METADATA:
            known = record.read(Metadata)
            if known.name == ABOUT:
                metadata.update(known.metadata)
        else:
            topics.take(record)

    is_whole = scan(file, name, take, builders.add)
    topics.require(name)
    with readable(name):
        return builders.recording(metadata, is_whole and CUT not in metadata)


def some_of(names: Collection[str]) -> Any:
    """The type of a message of which these fields alone are wanted."""
    return TypedDict("Wanted", dict.fromkeys(names, Any), total=False)  # type: ignore[operator]


class _Builders:
    """The rows of both topics on their way to columns."""

    def __init__(self, topics: Topics, only: Collection[str] | None) -> None:
        self._topics = topics
        most = MAX_VALUES if only is None else MAX_SOME_VALUES
        # what nobody wants is passed over by the decoder, which takes most of the time
        self._decoder = msgspec.json.Decoder(Any if only is None else some_of(only))
        self._builders = {topic: _Builder(only, most) for topic in topics.expected}

    def add(self, sent: Sent) -> None:
        """One message. Raises UNREADABLE."""
        builder = self._builders.get(self._topics.known.get(sent.channel, ""))
        if builder is not None:
            builder.add(sent.t_ns, self._decoder.decode(sent.data))

    def recording(self, metadata: dict[str, str], is_complete: bool) -> Recording:
        """All of them. Raises UNREADABLE."""
        for topic, builder in self._builders.items():
            for schema in self._topics.expected[topic]:
                builder.expect(schema)
        telemetry, ticks = (self._builders[topic].columns() for topic in (TELEMETRY_TOPIC, TICKS_TOPIC))
        return Recording(telemetry, ticks, metadata, is_complete)


class _Builder:
    """Rows of one topic on their way to columns; a column that first shows in a later row is filled up before it."""

    def __init__(self, only: Collection[str] | None, most_values: int) -> None:
        self._only, self._most_values = only, most_values
        self._t_ns = array("q")
        self._numbers: dict[str, array[float]] = {}
        self._words: dict[str, list[tuple[str, ...]]] = {}
        self._same: dict[tuple[str, ...], tuple[str, ...]] = {}

    def add(self, t_ns: int, message: object) -> None:
        if not isinstance(message, dict):
            raise ValueError(f"message of {t_ns} ns is {type(message).__name__}: allowed is an object")
        row = len(self._t_ns)
        self._t_ns.append(t_ns)
        for name, value in _flat("", message, MAX_NESTING):
            if isinstance(value, tuple):
                words = self._words.get(name)
                if words is None:
                    words = self._words[name] = self._filled([], row, ())
                elif len(words) < row:
                    words.extend([()] * (row - len(words)))
                words.append(self._same.setdefault(value, value))
            else:
                numbers = self._numbers.get(name)
                if numbers is None:
                    numbers = self._numbers[name] = self._filled(array("d"), row, math.nan)
                elif len(numbers) < row:
                    numbers.extend([math.nan] * (row - len(numbers)))
                numbers.append(value)
        self._require(row)

    def expect(self, schema: object) -> None:
        """The columns that the schema names are there, whether anything is ever known of them or not."""
        for name, kind in _columns("", schema, MAX_NESTING):
            if self._only is None or name.partition(".")[0] in self._only:
                if kind in ("number", "integer", "boolean"):
                    self._numbers.setdefault(name, array("d"))
                elif kind in ("string", "array"):
                    self._words.setdefault(name, [])
                self._require(len(self._t_ns))

    def columns(self) -> Columns:
        rows = len(self._t_ns)
        for numbers in self._numbers.values():
            numbers.extend([math.nan] * (rows - len(numbers)))
        for words in self._words.values():
            words.extend([()] * (rows - len(words)))
        return Columns(
            np.array(self._t_ns, dtype=np.int64),
            # a column that was null until its first word (a text not known yet) is a column of words
            {n: np.array(v, dtype=np.float64) for n, v in self._numbers.items() if n not in self._words},
            self._words,
        )

    def _filled(self, column: Any, rows: int, value: object) -> Any:
        self._require(rows)
        column.extend([value] * rows)
        return column

    def _require(self, rows: int) -> None:
        """Raises ValueError where there are too many columns, or values in them."""
        columns = len(self._numbers) + len(self._words)
        if columns > MAX_COLUMNS or columns * rows > self._most_values:
            raise ValueError(
                f"{columns} columns of {rows} rows: allowed are {MAX_COLUMNS} columns, and {self._most_values} values "
                "in memory at once"
            )


def _columns(prefix: str, schema: object, depth: int) -> Iterator[tuple[str, object]]:
    """The columns in a plain JSON schema, each with its dotted name and type; of lists, those of words."""
    properties = schema.get("properties") if isinstance(schema, dict) else None
    for name, inner in (properties if isinstance(properties, dict) else {}).items():
        if not isinstance(inner, dict):
            continue
        if inner.get("type") == "object" and depth > 0:
            yield from _columns(f"{prefix}{name}.", inner, depth - 1)
        elif inner.get("type") != "array" or inner.get("items") == {"type": "string"}:
            yield f"{prefix}{name}", inner.get("type")


def _flat(prefix: str, value: Any, depth: int) -> Iterator[tuple[str, float | tuple[str, ...]]]:
    """The numbers and words in `value`, each with its dotted name. A list without numbers is a row's words."""
    match value:
        case str() if len(value) <= MAX_CHARACTERS:
            yield prefix, (value,)
        case None:
            yield prefix, math.nan
        case bool() | int() | float():
            yield prefix, float(value)
        case list() if len(value) <= MAX_WORDS and all(
            isinstance(item, str) and len(item) <= MAX_CHARACTERS for item in value
        ):
            yield prefix, tuple(value)
        case dict() | list() if depth > 0:
            for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
                yield from _flat(f"{prefix}.{name}" if prefix else str(name), inner, depth - 1)
        case _:
            raise ValueError(f"{prefix} = {str(value)[:80]}: allowed are numbers, strings and short lists of them")
