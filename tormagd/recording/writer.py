"""Writing a recording: MCAP with JSON messages and JSON schemas, compressed with zstd.

Two channels: `/telemetry`, the daemon's snapshots as published, and `/ticks`, one message for every control tick. Such
files open in Foxglove and PlotJuggler as they are.
"""

import contextlib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
from mcap.writer import CompressionType, Writer

from tormagd import __version__
from tormagd.messages import Telemetry
from tormagd.recording.ticks import TickBatch, Value

TELEMETRY_TOPIC = "/telemetry"
TICKS_TOPIC = "/ticks"
CHUNK_BYTES = 256 * 1024  # what a power cut can cost: about half a second of ticks
GAP_NS = 10_000_000
"A step between two ticks that counts as a gap. Under one lost batch (20 ms), above a few merged ticks."


class RecordingWriter:
    """One MCAP file, open for writing until `close`; also a context manager.

    `telemetry_count`, `tick_count`, `telemetry_lost` (missing `seq`), `gaps` (steps between ticks above GAP_NS, or back
    in time) and `longest_gap_ms` count what was written. Raises FileExistsError rather than overwrite a recording, and
    OSError where the file cannot be made or, from `telemetry`, `ticks` and `close`, written.
    """

    def __init__(self, path: Path, metadata: dict[str, str] | None = None) -> None:
        self._file = path.open("xb")
        self._mcap = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._mcap.start(profile="", library=f"tormagd {__version__}")
        self._mcap.add_metadata("tormagd", {"version": __version__, **(metadata or {})})
        self._telemetry_channel = self._channel(TELEMETRY_TOPIC, "tormagd.Telemetry", telemetry_schema())
        self._tick_channels: dict[tuple[str, ...], int] = {}
        self._last_seq: int | None = None
        self._last_tick_ns: int | None = None
        self.telemetry_count = 0
        self.telemetry_lost = 0
        self.tick_count = 0
        self.gaps = 0
        self.longest_gap_ms = 0.0

    def telemetry(self, message: Telemetry) -> None:
        """Write one snapshot. A `seq` that starts over (a restarted daemon) is not a loss."""
        if self._last_seq is not None and message.seq > self._last_seq + 1:
            self.telemetry_lost += message.seq - self._last_seq - 1
        self._last_seq = message.seq
        # msgspec writes NaN and infinities as null, which is what "not known" is in a telemetry message
        self._add(self._telemetry_channel, message.t_ns, msgspec.json.encode(message), self.telemetry_count)
        self.telemetry_count += 1

    def ticks(self, batch: TickBatch) -> None:
        """Write each row as one message. Other columns than before get a channel of their own under the same topic."""
        if not batch.rows:
            return
        channel = self._tick_channels.get(batch.columns)
        if channel is None:
            channel = self._channel(TICKS_TOPIC, "tormagd.Tick", tick_schema(batch))
            self._tick_channels[batch.columns] = channel
        for row in batch.rows:
            t_ns = row[0]
            assert isinstance(t_ns, int)  # TickBatch has checked it
            if self._last_tick_ns is not None and not 0 <= t_ns - self._last_tick_ns <= GAP_NS:
                self.gaps += 1
                self.longest_gap_ms = max(self.longest_gap_ms, abs(t_ns - self._last_tick_ns) / 1e6)
            self._last_tick_ns = t_ns
            data = msgspec.json.encode(dict(zip(batch.columns, row, strict=True)))
            self._add(channel, t_ns, data, self.tick_count)
            self.tick_count += 1

    def close(self) -> None:
        """Write the index and close the file. Without it the file still reads, up to its last whole chunk.

        Raises OSError where the index or the last chunk could not be written; the file is closed then too.
        """
        if not self._file.closed:
            try:
                self._mcap.finish()  # type: ignore[no-untyped-call]
            finally:
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            # behind a chunk that was cut, an index would make the whole file unreadable
            with contextlib.suppress(OSError):
                self._file.close()
        else:
            self.close()

    def _channel(self, topic: str, name: str, schema: dict[str, Any]) -> int:
        schema_id = self._mcap.register_schema(name=name, encoding="jsonschema", data=msgspec.json.encode(schema))
        channel: int = self._mcap.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)
        return channel

    def _add(self, channel: int, t_ns: int, data: bytes, sequence: int) -> None:
        self._mcap.add_message(channel, log_time=t_ns, data=data, publish_time=t_ns, sequence=sequence % 2**32)


def telemetry_schema() -> dict[str, Any]:
    """The JSON schema of a telemetry message, without `$ref`, `anyOf` and tuples: viewers read only the plain forms."""
    (schema,), definitions = msgspec.json.schema_components([Telemetry], ref_template="{name}")
    return {"title": "tormagd.Telemetry", **_plain(schema, definitions)}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return _plain(definitions[schema["$ref"]], definitions)
    if "anyOf" in schema:
        return _plain(next(option for option in schema["anyOf"] if option != {"type": "null"}), definitions)
    if schema.get("type") == "array":
        items = schema.get("prefixItems", [schema.get("items")])[0]
        return {"type": "array", "items": _plain(items, definitions)}
    if schema.get("type") == "object":
        properties = {name: _plain(inner, definitions) for name, inner in schema["properties"].items()}
        return {"type": "object", "properties": properties}
    return {"type": schema["type"]}


def tick_schema(batch: TickBatch) -> dict[str, Any]:
    """The JSON schema of one row, from the types in the first one. A null there is taken for a number."""
    properties = {name: _json_type(value) for name, value in zip(batch.columns, batch.rows[0], strict=True)}
    return {"title": "tormagd.Tick", "type": "object", "properties": properties}


def _json_type(value: Value) -> dict[str, Any]:
    match value:
        case bool():
            return {"type": "boolean"}
        case str():
            return {"type": "string"}
        case tuple():
            return {"type": "array", "items": {"type": "string"}}
        case _:
            return {"type": "number"}
