"""The black box's file: MCAP with three channels, and all that it takes to run the core again.

`/ticks` is that of a recording, for viewers and `tormagctl plot`, and `/frames` what passed between daemon and device.
`/core` has both with whatever else the core was given, in its order, to the bit: msgpack, a message for each part that
the daemon handed over. The metadata `black_box` are its header. `tormagctl replay` runs it.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from mcap.records import Channel, Message, Metadata
from mcap.writer import CompressionType, Writer

from tormagd import __version__
from tormagd.bounded_file import in_place_of
from tormagd.keeping import READ, WROTE, Part
from tormagd.recording.reader import RecordingError, opened, scan
from tormagd.recording.writer import (
    ABOUT,
    CHUNK_BYTES,
    TICK_KINDS,
    TICKS_TOPIC,
    known_values,
    plain_schema,
    registered,
    tick_schema,
)

CORE_TOPIC, FRAMES_TOPIC = "/core", "/frames"
HEADER = "black_box"
MAX_PARTS = 100_000
MAX_BYTES = 200_000_000
"""Of all parts of a file that is read: a black box is a tenth of it."""


class BlackBoxFile(msgspec.Struct, frozen=True):
    """One file: its header, and the entries of all its parts in their order, as plain data; a tick's record is a list
    whose first value is an integer, any other entry a word or a list that begins with one."""

    header: dict[str, str]
    entries: list[Any]
    is_complete: bool = True
    "False for one that ends in the middle: what came before is there."


class Frame(msgspec.Struct, frozen=True, omit_defaults=True):
    """What passed: on a bus one frame, on a serial port what was read at once, or one frame that was written. The time
    is that of the ticks' `monotonic_s`, `data` are hexadecimal; without an `identifier` it is a serial port's."""

    monotonic_s: float
    direction: str
    "read or wrote."
    data: str
    identifier: int | None = None


def frames_in(entry: Any) -> list[Frame]:
    """The frames of an entry, none for one of another kind. Raises ValueError, TypeError for an odd one."""
    if not isinstance(entry, list) or not entry or entry[0] not in (READ, WROTE):
        return []
    direction, time_s, raw, *_ = entry
    pieces = [(None, each) if isinstance(each, bytes) else each for each in (raw if isinstance(raw, list) else [raw])]
    return [Frame(time_s, direction, data.hex(), identifier) for identifier, data in pieces]


def write_black_box(path: Path, header: dict[str, str], parts: Sequence[Part]) -> int:
    """Writes a new file of some parts, whole or not at all; returns how many ticks are in it. Raises FileExistsError,
    OSError."""
    if path.exists():
        raise FileExistsError(17, "exists", str(path))
    with in_place_of(path) as beside:
        return _write(beside, header, parts)


def _write(path: Path, header: dict[str, str], parts: Sequence[Part]) -> int:
    columns = tuple(json.loads(header["columns"]))
    ticks = frames = 0
    with path.open("wb") as file:
        mcap = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        mcap.start(profile="", library=f"tormagd {__version__}")
        mcap.add_metadata(HEADER, header)
        mcap.add_metadata(ABOUT, {"version": __version__, "kind": HEADER})
        core = mcap.register_channel(topic=CORE_TOPIC, message_encoding="msgpack", schema_id=0)
        kinds = {name: TICK_KINDS[name] for name in columns if name in TICK_KINDS}
        tick_channel = registered(mcap, TICKS_TOPIC, tick_schema(kinds))
        frame_channel = registered(mcap, FRAMES_TOPIC, plain_schema(Frame))
        began = parts[0]
        for number, part in enumerate(parts):
            mcap.add_message(core, log_time=part.t_ns, data=part.entries, publish_time=part.t_ns, sequence=number)
            for entry in msgspec.msgpack.decode(part.entries):
                if is_tick(entry):
                    data = msgspec.json.encode(known_values(columns, entry))
                    mcap.add_message(tick_channel, log_time=entry[0], data=data, publish_time=entry[0], sequence=ticks)
                    ticks += 1
                for frame in frames_in(entry):
                    frames += 1
                    t_ns = began.t_ns + round((frame.monotonic_s - began.time_s) * 1e9)  # so they stay in their order
                    data = msgspec.json.encode(frame)
                    mcap.add_message(frame_channel, log_time=t_ns, data=data, publish_time=t_ns, sequence=frames)
        mcap.finish()  # type: ignore[no-untyped-call]
    return ticks


def is_tick(entry: Any) -> bool:
    """Whether an entry is a tick's record."""
    return isinstance(entry, list) and bool(entry) and type(entry[0]) is int


def read_black_box(path: Path) -> BlackBoxFile:
    """The black box in `path`. Raises RecordingError: not readable, not MCAP, damaged, or no black box."""
    header: dict[str, str] = {}
    entries: list[Any] = []
    cores: set[int] = set()
    size = parts = 0

    def take(record: Any) -> None:
        nonlocal size, parts
        if isinstance(record, Channel) and record.topic == CORE_TOPIC:
            if record.message_encoding != "msgpack":
                raise ValueError(f"{CORE_TOPIC} is {record.message_encoding[:20]!r}: allowed is msgpack")
            cores.add(record.id)
        elif isinstance(record, Metadata) and record.name == HEADER:
            header.update(record.metadata)
        elif isinstance(record, Message) and record.channel_id in cores:
            size, parts = size + len(record.data), parts + 1
            if size > MAX_BYTES or parts > MAX_PARTS:
                raise ValueError(f"over {MAX_BYTES} bytes or {MAX_PARTS} parts")
            entries.extend(msgspec.msgpack.decode(record.data, type=list[Any]))

    with opened(path) as file:
        is_complete = scan(file, str(path), take)
    if not header or not entries:
        raise RecordingError(f"{path}: no black box of tormagd: it has nothing in {CORE_TOPIC} or no header {HEADER!r}")
    return BlackBoxFile(header, entries, is_complete)
