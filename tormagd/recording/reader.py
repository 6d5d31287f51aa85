"""Reading a recording back into columns."""

import contextlib
import math
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from zstandard import ZstdError

from tormagd.recording.writer import ABOUT, CUT, TELEMETRY_TOPIC, TICKS_TOPIC
from tormagd_client.regular_file import require_regular

MAX_FILE_BYTES = 1 << 40
MAX_RECORD_BYTES = 64_000_000
MAX_NESTING = 3
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
    """One file. `is_complete` is false where the recorder was killed or the disk was full: what was written before that
    is there."""

    telemetry: Columns
    ticks: Columns
    metadata: dict[str, str] = field(default_factory=dict)
    is_complete: bool = True

    def described(self, name: str, kind: Any) -> Any:
        """What its metadata say of `name`, a value of this type; None where they do not, or say something else."""
        try:
            return msgspec.json.decode(self.metadata[name], type=kind)
        except (KeyError, msgspec.MsgspecError):
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


def scan(file: BinaryIO, name: str, take: Callable[[Any], None]) -> bool:
    """Hands each of the file's records to `take`, which may raise UNREADABLE; False where it ends in the middle of one.
    Raises RecordingError, in which the file is called `name`: not MCAP, or damaged."""
    record: Any = None
    try:
        try:
            for record in StreamReader(file, record_size_limit=MAX_RECORD_BYTES, validate_crcs=True).records:
                take(record)
        except UNREADABLE:
            # a record that runs into the end of the file was being written when its writer died
            if file.read(1) or record is None:
                raise
            return False
    except UNREADABLE as error:
        raise RecordingError(f"{name}: not an intact MCAP file ({str(error)[:200]})") from error
    return True


def read_recording(path: Path) -> Recording:
    """The recording in `path`. Raises RecordingError: not readable, not MCAP, damaged, or not written by tormagd."""
    with opened(path) as file:
        return read_open_recording(file, str(path))


def read_open_recording(file: BinaryIO, name: str, only: Collection[str] | None = None) -> Recording:
    """The recording in `file`, wherever that is, which errors call `name`; where `only` some fields of its messages are
    wanted, no others are kept. Raises RecordingError: not MCAP, damaged, or not written by tormagd; and OSError.
    """
    builders = {TELEMETRY_TOPIC: _Builder(only), TICKS_TOPIC: _Builder(only)}
    metadata: dict[str, str] = {}
    topics: dict[int, str] = {}
    schemas: dict[int, bytes] = {}

    def take(record: Any) -> None:
        if isinstance(record, Schema):
            schemas[record.id] = record.data
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
            if record.topic in builders and record.schema_id in schemas:
                builders[record.topic].expect(msgspec.json.decode(schemas[record.schema_id]))
        elif isinstance(record, Metadata) and record.name == ABOUT:
            metadata.update(record.metadata)
        elif isinstance(record, Message) and topics.get(record.channel_id) in builders:
            builders[topics[record.channel_id]].add(record.log_time, msgspec.json.decode(record.data))

    is_whole = scan(file, name, take)
    if not set(topics.values()) & set(builders):
        raise RecordingError(
            f"{name}: no channel {TELEMETRY_TOPIC} or {TICKS_TOPIC} in it; `tormagctl record` makes one"
        )
    telemetry, ticks = builders[TELEMETRY_TOPIC].columns(), builders[TICKS_TOPIC].columns()
    return Recording(telemetry, ticks, metadata, is_whole and CUT not in metadata)


class _Builder:
    """Rows of one topic on their way to columns; a column that first shows in a later row is filled up before it."""

    def __init__(self, only: Collection[str] | None) -> None:
        self._only = only
        self._t_ns: list[int] = []
        self._numbers: dict[str, list[float]] = {}
        self._words: dict[str, list[tuple[str, ...]]] = {}

    def add(self, t_ns: int, message: object) -> None:
        if not isinstance(message, dict):
            raise ValueError(f"message of {t_ns} ns is {type(message).__name__}: allowed is an object")
        if self._only is not None:
            message = {name: message[name] for name in self._only if name in message}
        row = len(self._t_ns)
        self._t_ns.append(t_ns)
        for name, value in _flat("", message, MAX_NESTING):
            if isinstance(value, tuple):
                words = self._words.setdefault(name, [])
                words.extend([()] * (row - len(words)))
                words.append(value)
            else:
                numbers = self._numbers.setdefault(name, [])
                numbers.extend([math.nan] * (row - len(numbers)))
                numbers.append(value)

    def expect(self, schema: object) -> None:
        """The columns that the schema names are there, whether anything is ever known of them or not."""
        for name, kind in _columns("", schema, MAX_NESTING):
            if self._only is None or name.partition(".")[0] in self._only:
                if kind in ("number", "integer", "boolean"):
                    self._numbers.setdefault(name, [])
                elif kind in ("string", "array"):
                    self._words.setdefault(name, [])

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
        case str():
            yield prefix, (value,)
        case None:
            yield prefix, math.nan
        case bool() | int() | float():
            yield prefix, float(value)
        case list() if all(isinstance(item, str) for item in value):
            yield prefix, tuple(value)
        case dict() | list() if depth > 0:
            for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
                yield from _flat(f"{prefix}.{name}" if prefix else str(name), inner, depth - 1)
        case _:
            raise ValueError(f"{prefix} = {str(value)[:80]}: allowed are numbers, strings and short lists of them")
