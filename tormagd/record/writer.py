"""Writing a recording: MCAP with JSON messages and JSON schemas, compressed with zstd.

Channel `/telemetry` has the daemon's snapshots as published, `/ticks` one message for every control tick. Foxglove and
PlotJuggler open the files. Unknown values are left out: viewers read only plain schemas, in which a number cannot be
null. An overview stands at the end.
"""

import contextlib
import errno
import fcntl
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from itertools import repeat
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NoReturn, Self

import msgspec
from mcap.writer import Writer

from tormagd import __version__
from tormagd.record.folder import RecordingFolder
from tormagd.record.overview import OverviewBuilder
from tormagd.record.thinning import AROUND_S, Thinning
from tormagd.record.ticks import Axis, TickBatch, Value
from tormagd_client.messages import Mark, Telemetry, TickRecord

ABOUT = "tormagd"
CUT = "cut_by"
"Metadata key: why the recording ended early."
THINNED = "thinned"
"Metadata key: which ticks are there, if not all."
OVERVIEW = "overview 2"
"Version 2 counts handle and limits in how well a force is followed."
TELEMETRY_TOPIC = "/telemetry"
TICKS_TOPIC = "/ticks"
NUMBER_COLUMN = "tick"
"A missing number is a lost tick."
CHUNK_NS = 500_000_000
"Lost if the recorder is killed."
MIN_FREE_BYTES = 16_000_000
"A recording ends before the disk is full: the last chunk and the index need room."
INDEX_SHARE = 64


def disk_room(path: Path, needed_bytes: int) -> str:
    """Say why a disk has no room for `needed_bytes`; empty if it has."""
    free, least = shutil.disk_usage(path.parent).free, MIN_FREE_BYTES + needed_bytes
    if free >= least:
        return ""
    return f"No space left on device: {free / 1e6:.1f} MB are free, needed are {least / 1e6:.1f}"


class RecordingWriter:
    """Writes an MCAP recording, or in a folder several one after the other, until `close`."""

    def __init__(
        self,
        place: Path | RecordingFolder,
        metadata: Mapping[str, str] | None = None,
        every: int = 1,
    ) -> None:
        self._thinning = Thinning(every)
        self._folder = place if isinstance(place, RecordingFolder) else None
        self._about = {"version": __version__, **(metadata or {})}
        if every > 1:
            self._about[THINNED] = f"one tick of {every}; all within {AROUND_S:g} s of a fault or a mark"
        self._last_seq: int | None = None
        self._last_tick: int | None = None
        self._mark: Mark | None = None
        self.telemetry_count = self.telemetry_lost = 0
        self.tick_count = self.ticks_lost = 0
        self._begin(place.new() if isinstance(place, RecordingFolder) else place)

    def _begin(self, path: Path) -> None:
        """Begin a new file, locked against pruning."""
        self.path = path
        self._file = path.open("xb")
        with contextlib.suppress(OSError):  # some file systems know no locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._overview, self._axis = OverviewBuilder(), Axis()
        self._mcap = begun(self._file, self._about)
        self._file.flush()
        self._telemetry_channel = registered(self._mcap, TELEMETRY_TOPIC, plain_schema(Telemetry))
        self._tick_channels: dict[bool, int] = {}
        self._begin_ns = self._chunk_ns = 0

    def _rotate(self, folder: RecordingFolder) -> None:
        """End the file and begin a new one if size or length are over the budget."""
        if not folder.is_due(self._file.tell(), (self._chunk_ns - self._begin_ns) * 1e-9):
            return
        try:
            path = folder.new()
        except OSError as error:
            self._give_up(str(error.strerror))
        self._end()
        self._begin(path)

    def _give_up(self, reason: str) -> NoReturn:
        self.describe({CUT: reason})
        self._end()
        raise OSError(errno.ENOSPC, reason)

    def describe(self, metadata: dict[str, str]) -> None:
        """Write metadata, now and into every later file in the folder."""
        self._about |= metadata
        self._mcap.add_metadata(ABOUT, metadata)

    def telemetry(self, message: Telemetry) -> None:
        if self._last_seq is not None and message.seq > self._last_seq + 1:
            self.telemetry_lost += message.seq - self._last_seq - 1
        self._last_seq = message.seq
        mark, before, self._mark = message.mark, self._mark, message.mark or self._mark
        at_ns = self._axis.of_snapshot(message.t_ns)
        if mark is not None and mark != before:
            self._thinning.happened(at_ns)
        known = only_known(msgspec.to_builtins(message))
        self._add(self._telemetry_channel, at_ns, msgspec.json.encode(known), self.telemetry_count)
        self._overview.add(at_ns, False, known | {"mark": mark})
        self.telemetry_count += 1
        # every snapshot has the newest mark, even one from before
        if (
            mark is not None
            and mark != before
            and mark.t_ns - self._axis.ahead_ns >= self._begin_ns
            and self._folder is not None
        ):
            self.path = self._folder.mark_around(self.path)

    def ticks(self, batch: TickBatch) -> None:
        """Write each row as one message, thinned, and count missing ticks."""
        number_at = batch.columns.index(NUMBER_COLUMN) if NUMBER_COLUMN in batch.columns else None
        monotonic_at = batch.columns.index("monotonic_s") if "monotonic_s" in batch.columns else 0
        for row in batch.rows:
            assert isinstance(row[0], int)
            t_ns = self._axis.of_tick(row[0], row[monotonic_at])
            if number_at is not None and isinstance(number := row[number_at], int):
                if self._last_tick is not None and number > self._last_tick + 1:
                    self.ticks_lost += number - self._last_tick - 1
                self._last_tick = number
            message = known_values(batch.columns, row)
            self._write(self._thinning.take((t_ns, message)))
            self._overview.add(t_ns, True, message)
            self.tick_count += 1
        if self._folder is not None:
            self._rotate(self._folder)

    def close(self) -> None:
        if not self._file.closed:
            self._write(self._thinning.rest(self._thinning.every))
            self._end()

    def _end(self) -> None:
        with self._file:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._mcap.add_attachment(0, 0, OVERVIEW, "application/msgpack", self._overview.made().packed())
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            with contextlib.suppress(OSError):  # after a chunk that was cut, an index would make the file unreadable
                self._file.close()
        else:
            self.close()

    def _write(self, ticks: Sequence[tuple[int, dict[str, Value]]]) -> None:
        for t_ns, message in ticks:
            self._add(self._channel_of(message), t_ns, msgspec.json.encode(message), self.tick_count)

    def _channel_of(self, message: dict[str, Value]) -> int:
        fits = all(TICK_KINDS.get(name) == _KINDS[type(value)] for name, value in message.items())
        if fits not in self._tick_channels:
            self._tick_channels[fits] = registered(self._mcap, TICKS_TOPIC, TICK_SCHEMA if fits else OTHER_SCHEMA)
        return self._tick_channels[fits]

    def _add(self, channel: int, t_ns: int, data: bytes, sequence: int) -> None:
        if abs(t_ns - self._chunk_ns) > CHUNK_NS or not self._chunk_ns:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            index_bytes = self._file.tell() // INDEX_SHARE
            reason = disk_room(self.path, index_bytes) if self._folder is None else self._folder.room(index_bytes)
            if reason:
                self._give_up(reason)
            self._file.flush()
            self._begin_ns, self._chunk_ns = self._begin_ns or t_ns, t_ns
        self._mcap.add_message(channel, log_time=t_ns, data=data, publish_time=t_ns, sequence=sequence % 2**32)


def begun(file: BinaryIO, about: dict[str, str]) -> Writer:
    mcap = Writer(file, enable_data_crcs=True)
    mcap.start(profile="", library=f"tormagd {__version__}")
    mcap.add_metadata(ABOUT, about)
    return mcap


def registered(mcap: Writer, topic: str, schema: dict[str, Any]) -> int:
    schema_id = mcap.register_schema(name=schema["title"], encoding="jsonschema", data=msgspec.json.encode(schema))
    return mcap.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)


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


def _tick_schema() -> dict[str, Any]:
    (schema,), definitions = msgspec.json.schema_components([TickRecord], ref_template="{name}")
    items = map(_plain, definitions[schema["$ref"]]["prefixItems"], repeat(definitions))
    columns = dict(zip(TickRecord.__struct_fields__, items, strict=True))
    whole = {name: {"type": "number"} for name, kind in columns.items() if kind["type"] == "integer"}
    return {"title": "tormagd.Tick", "type": "object", "properties": columns | whole}


_KINDS = {bool: "boolean", str: "string", tuple: "array", int: "number", float: "number"}
TICK_SCHEMA = _tick_schema()
TICK_KINDS = {name: kind["type"] for name, kind in TICK_SCHEMA["properties"].items()}
OTHER_SCHEMA = {"title": "tormagd.OtherTick", "type": "object"}


def only_known(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: known for name, inner in value.items() if (known := only_known(inner)) is not None}
    if isinstance(value, list | tuple):
        return None if None in map(only_known, value) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
