"""Writing a recording: MCAP with JSON messages and JSON schemas, compressed with zstd.

Channel `/telemetry` has the daemon's snapshots as published, `/ticks` one message for every control tick. The files
open in Foxglove and PlotJuggler as they are. A value that is not known is left out of its message: viewers read only
plain schemas, in which a number cannot be null. An overview stands at the end, and seals in between (`seal.py`).
"""

import contextlib
import errno
import fcntl
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Self

import msgspec
from mcap.writer import CompressionType, Writer

from tormagd import __version__
from tormagd.recording.overview import OverviewBuilder
from tormagd.recording.seal import KEYED, PLAIN, SEALED, SealingFile
from tormagd.recording.thinning import AROUND_S, Thinning
from tormagd.recording.ticks import TickBatch, Value
from tormagd_client.messages import Mark, Telemetry, TickRecord

ABOUT = "tormagd"
"Name of the metadata records that say what is recorded."
CUT = "cut_by"
"Key in the metadata: why the recording ended early."
THINNED = "thinned"
"Key in the metadata: which ticks are there, where not all are."
OVERVIEW = "overview 2"
"Name of the attachment that holds the overview; 2 since it counts handle and limits in how well a force is followed."
TELEMETRY_TOPIC = "/telemetry"
TICKS_TOPIC = "/ticks"
NUMBER_COLUMN = "tick"
"Column of the control tick's number; a missing number is a lost tick."
CHUNK_BYTES = 1024 * 1024
CHUNK_NS = 500_000_000
"Time that one chunk spans, lost where the recorder is killed."
LEAST_FREE_BYTES = 16_000_000
"A recording ends before the disk is full: the last chunk needs room, and the index, which grows with the file."
INDEX_SHARE = 64
"The index is at most 1/INDEX_SHARE of the file."
GAP_NS = 10_000_000
"A step between two ticks that counts as a gap. Under one lost batch (20 ms), above a few merged ticks."

Room = Callable[[Path, int], str]
"Makes room for bytes on a file's disk; returns why there is none, empty where there is."


def disk_room(path: Path, needed_bytes: int) -> str:
    """Say why the disk of `path` has no room for so many bytes more, and a reserve; empty where it has."""
    free, least = shutil.disk_usage(path.parent).free, LEAST_FREE_BYTES + needed_bytes
    if free >= least:
        return ""
    return f"No space left on device: {free / 1e6:.1f} MB are free, needed are {least / 1e6:.1f}"


class RecordingWriter:
    """Writes an MCAP recording, or with `rotate` several one after the other, until `close`; also a context manager.

    `key` seals the file, `room` makes room on its disk, and of `every` ticks one is written where nothing happens.
    Public counters tell what came: `telemetry_lost` counts missing `seq`, `ticks_lost` missing tick numbers, and `gaps`
    steps between ticks above GAP_NS or back in time.

    Raises FileExistsError rather than overwrite a recording, and OSError where the file cannot be made or written.
    Without room the file is ended in order first. Where the disk fails without warning, the file reads up to its last
    whole chunk.
    """

    def __init__(
        self,
        path: Path,
        metadata: dict[str, str] | None = None,
        key: bytes = b"",
        room: Room = disk_room,
        every: int = 1,
    ) -> None:
        self._key, self._room, self._thinning = key, room, Thinning(every)
        self._about = {"version": __version__, **(metadata or {})}
        if every > 1:
            self._about[THINNED] = f"one tick of {every}; all within {AROUND_S:g} s of a fault or a mark"
        self._last_seq: int | None = None
        self._last_tick: int | None = None
        self._last_tick_ns: int | None = None
        self._batch_ns = 0
        self.mark: Mark | None = None
        "The newest mark in a snapshot; None before the first."
        self.telemetry_count = 0
        self.telemetry_lost = 0
        self.tick_count = 0
        self.ticks_lost = 0
        self.gaps = 0
        self.longest_gap_ms = 0.0
        self._begin(path, "")

    def _begin(self, path: Path, follows: str) -> None:
        """Open a new file, lock it against pruning, and write its head; `follows` is the digest that ends the segment
        before.

        Raises FileExistsError, OSError.
        """
        self.path = path
        self._file = path.open("xb")
        with contextlib.suppress(OSError):  # some file systems know no locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # so that nobody takes it away while it is written
        self._sealing = SealingFile(self._file, self._key)
        self._overview = OverviewBuilder()
        self._mcap = Writer(self._sealing, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._mcap.start(profile="", library=f"tormagd {__version__}")
        self._mcap.add_metadata(SEALED, {"by": KEYED if self._key else PLAIN, "follows": follows})
        self._mcap.add_metadata(ABOUT, self._about)
        self._sealing.flush()
        self._telemetry_channel = registered(self._mcap, TELEMETRY_TOPIC, plain_schema(Telemetry))
        self._tick_channels: dict[tuple[tuple[str, str], ...], int] = {}
        self._columns: tuple[str, ...] = ()
        self._kinds: dict[str, str] = {}
        "JSON types of the columns, by name; a column that has always been null is absent."
        self._tick_channel = 0
        self._chunk_ns: int | None = None
        self.begin_ns: int | None = None
        "When the first message of this file was, ns since 1970."

    @property
    def size(self) -> int:
        """Return the file's present size, bytes."""
        return self._sealing.tell()

    @property
    def lasted_s(self) -> float:
        """Return the time from the file's first message to its present chunk, s; 0 before the first message."""
        return 0.0 if self.begin_ns is None or self._chunk_ns is None else (self._chunk_ns - self.begin_ns) * 1e-9

    def rotate(self, path: Path) -> None:
        """End the file in order and go on in a new one, chained by its last seal. Ticks that wait go into the new one.

        Raises FileExistsError, OSError.
        """
        self._end()
        self._begin(path, self._sealing.digest)

    def give_up(self, reason: str) -> NoReturn:
        """End the file in order, with `reason` in its metadata, and raise OSError with ENOSPC and that reason."""
        self.describe({CUT: reason})
        self._end()
        raise OSError(errno.ENOSPC, reason)

    def describe(self, metadata: dict[str, str]) -> None:
        """Write metadata, now and into every later file of `rotate`. The later value of a name counts."""
        self._about |= metadata
        self._mcap.add_metadata(ABOUT, metadata)

    def telemetry(self, message: Telemetry) -> None:
        """Write one snapshot, and count missing `seq`; a `seq` that starts over (a restarted daemon) is not a loss.

        A new mark keeps all ticks around it. Raises OSError.
        """
        if self._last_seq is not None and message.seq > self._last_seq + 1:
            self.telemetry_lost += message.seq - self._last_seq - 1
        self._last_seq = message.seq
        if message.mark is not None and message.mark != self.mark:
            self.mark = message.mark
            self._thinning.happened(message.t_ns)
        known = _known(msgspec.to_builtins(message))
        self._add(self._telemetry_channel, message.t_ns, msgspec.json.encode(known), self.telemetry_count)
        self._overview.add(message.t_ns, False, known | {"mark": message.mark})
        self.telemetry_count += 1

    def ticks(self, batch: TickBatch) -> None:
        """Write each row as one message, thinned, and count gaps and missing numbers; numbers may start over.

        Other columns than before, or values of another type, get a channel of their own under the same topic. Raises
        OSError.
        """
        if not batch.rows:
            return
        if batch.columns != self._columns:
            self._columns, self._tick_channel = batch.columns, 0
            self._kinds = {name: TICK_KINDS[name] for name in batch.columns if name in TICK_KINDS}
        number_at = batch.columns.index(NUMBER_COLUMN) if NUMBER_COLUMN in batch.columns else None
        before_ns = self._last_tick_ns
        for row in batch.rows:
            t_ns = row[0]
            assert isinstance(t_ns, int)  # TickBatch has checked it
            if self._last_tick_ns is not None and not 0 <= t_ns - self._last_tick_ns <= GAP_NS:
                self._note_gap(abs(t_ns - self._last_tick_ns))
            self._last_tick_ns = t_ns
            if number_at is not None and isinstance(number := row[number_at], int):
                if self._last_tick is not None and number > self._last_tick + 1:
                    self.ticks_lost += number - self._last_tick - 1
                self._last_tick = number
            message = known_values(batch.columns, row)
            self._write(self._thinning.take((t_ns, message)))
            self._overview.add(t_ns, True, message)
            self.tick_count += 1
        if before_ns is not None and self._last_tick_ns is not None:
            self._batch_ns = self._last_tick_ns - before_ns

    def note_silence(self, silence_ns: int) -> bool:
        """Count `silence_ns` without a batch as a gap, and return True; False up to two batch intervals plus GAP_NS."""
        if silence_ns <= 2 * self._batch_ns + GAP_NS:
            return False
        self._note_gap(silence_ns)
        return True

    def close(self) -> None:
        """Write waiting ticks, overview, index and last seal, and close the file; nothing on a closed one.

        Without this call the file reads up to its last whole chunk. Raises OSError where something could not be
        written.
        """
        if not self._file.closed:
            self._write(self._thinning.rest(self._thinning.every))
            self._end()

    def _end(self) -> None:
        """Write overview, index and last seal, and close the file, whatever fails."""
        with self._file:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._mcap.add_attachment(0, 0, OVERVIEW, "application/msgpack", self._overview.made().packed())
            self._sealing.finish(self._mcap)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            with contextlib.suppress(OSError):  # behind a chunk that was cut, an index would make the file unreadable
                self._file.close()
        else:
            self.close()

    def _note_gap(self, gap_ns: int) -> None:
        self.gaps += 1
        self.longest_gap_ms = max(self.longest_gap_ms, gap_ns / 1e6)

    def _write(self, ticks: Sequence[tuple[int, dict[str, Value]]]) -> None:
        for t_ns, message in ticks:
            self._add(self._channel_of(message), t_ns, msgspec.json.encode(message), self.tick_count)

    def _channel_of(self, message: dict[str, Value]) -> int:
        """Return the tick channel whose schema `message` obeys; registers one where a column's type is new."""
        kinds = self._kinds
        if not self._tick_channel or any(kinds.get(name) != _KINDS[type(value)] for name, value in message.items()):
            kinds |= {name: _KINDS[type(value)] for name, value in message.items()}
            key = tuple(kinds.items())
            if key not in self._tick_channels:
                self._tick_channels[key] = registered(self._mcap, TICKS_TOPIC, tick_schema(kinds))
            self._tick_channel = self._tick_channels[key]
        return self._tick_channel

    def _add(self, channel: int, t_ns: int, data: bytes, sequence: int) -> None:
        """Write a message. At a new chunk, first flush, seal the chunk before, and end the file where there is no
        room."""
        if self._chunk_ns is None or abs(t_ns - self._chunk_ns) > CHUNK_NS:
            self.begin_ns = self.begin_ns or t_ns
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._require_room()
            if self._chunk_ns is not None:
                self._sealing.seal()
                self._sealing.flush()
            self._chunk_ns = t_ns
        self._mcap.add_message(channel, log_time=t_ns, data=data, publish_time=t_ns, sequence=sequence % 2**32)

    def _require_room(self) -> None:
        """End the file and raise OSError where `room` names a reason."""
        reason = self._room(self.path, self.size // INDEX_SHARE)
        if reason:
            self.give_up(reason)


def registered(mcap: Writer, topic: str, schema: dict[str, Any]) -> int:
    """Register `schema` and a channel of JSON messages in the file that `mcap` writes; return the channel's id."""
    schema_id = mcap.register_schema(name=schema["title"], encoding="jsonschema", data=msgspec.json.encode(schema))
    return mcap.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)


def plain_schema(message: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON schema of a message type without `$ref`, `anyOf` and tuples, which viewers do not read.

    A value that may be null has the schema of its other type; a tuple is an array of its first type.
    """
    (schema,), definitions = msgspec.json.schema_components([message], ref_template="{name}")
    return {"title": f"tormagd.{message.__name__}", **_plain(schema, definitions)}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return a schema without references and alternatives: the first option that is not null, a tuple's first type."""
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


def tick_schema(kinds: dict[str, str]) -> dict[str, Any]:
    """Return the JSON schema of a tick message with columns of these JSON types, by name; an array holds strings."""
    properties = {
        name: {"type": "array", "items": {"type": "string"}} if kind == "array" else {"type": kind}
        for name, kind in kinds.items()
    }
    return {"title": "tormagd.Tick", "type": "object", "properties": properties}


def known_values(columns: Sequence[str], row: Sequence[Value]) -> dict[str, Value]:
    """Return a tick's row as a message: by column, without values that are None, NaN or infinite.

    Raises ValueError where row and columns differ in length.
    """
    # as _known, without a call for each of some sixty values, a thousand times a second
    return {
        name: value
        for name, value in zip(columns, row, strict=True)
        if value is not None and (value.__class__ is not float or math.isfinite(value))
    }


def _tick_kinds() -> dict[str, str]:
    """Return the JSON types of the columns that this version's daemon publishes; integers count as numbers."""
    (schema,), definitions = msgspec.json.schema_components([TickRecord], ref_template="{name}")
    items = definitions[schema["$ref"]]["prefixItems"]
    kinds = {
        name: _plain(item, definitions)["type"] for name, item in zip(TickRecord.__struct_fields__, items, strict=True)
    }
    return {name: "number" if kind == "integer" else kind for name, kind in kinds.items()}


_KINDS = {bool: "boolean", str: "string", tuple: "array", int: "number", float: "number"}
TICK_KINDS = _tick_kinds()
"By name, the JSON type of each column that this version's daemon publishes."


def _known(value: Any) -> Any:
    """Return `value` without its unknown parts; None for NaN, infinity, or a list with one of them or None in it."""
    if isinstance(value, dict):
        return {name: known for name, inner in value.items() if (known := _known(inner)) is not None}
    if isinstance(value, list | tuple):
        return None if None in map(_known, value) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
