"""The black box's file: an MCAP file with three channels, which holds all that running the core again needs.

`/core` holds the core's inputs and results, exact to the bit and in their order. Each of its messages is one part that
the daemon handed over, in msgpack. `/ticks` and `/frames` are derived from it, in JSON. `/ticks` is as in a recording,
for viewers and `tormagctl plot`. `/frames` is what passed between daemon and device. The metadata record `black_box` is
the file's header. `tormagctl replay` runs such a file.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from mcap.records import Channel, McapRecord, Message, Metadata

from tormagd import __version__
from tormagd.ground.files import in_place_of
from tormagd.record.keeper_messages import MISSING, READ, WROTE, Part
from tormagd.record.reader import RecordingError, damage_in, opened, scan
from tormagd.record.ticks import Axis
from tormagd.record.writer import TICK_SCHEMA, TICKS_TOPIC, begun, known_values, plain_schema, registered

CORE_TOPIC, FRAMES_TOPIC = "/core", "/frames"
MAX_OFF_NS = {TICKS_TOPIC: 0, FRAMES_TOPIC: 1_000}
"How far a derived message's time may be from what `/core` gives: a frame's is rounded twice."
HEADER = "black_box"
MAX_PARTS = 100_000
MAX_BYTES = 50_000_000
"Bound on all parts of one file together; a keeper holds less."
MAX_ENTRIES = 1_000_000
"Bound on the entries of one file: half a minute at 4 kHz has fewer."


class BlackBoxFile(msgspec.Struct, frozen=True):
    """One black box as read: its header, and the entries of all parts in their order, as plain data."""

    header: dict[str, str]
    entries: list[Any]
    is_complete: bool = True
    "False for a file that was cut short: entries up to the cut are there."
    odd: str = ""
    """The first message of `/ticks` or `/frames` that `/core` does not give, or why an entry of `/core` gives none."""


class Frame(msgspec.Struct, frozen=True, omit_defaults=True):
    """Bytes between daemon and device: one CAN frame, one read of a serial port, or one frame written to it."""

    monotonic_s: float
    direction: str
    "By the daemon: read or wrote."
    data: str
    identifier: int | None = None


def frames_in(entry: Any) -> list[Frame]:
    """Return the frames in one entry of a black box, in their order; empty for an entry of another kind."""
    if not isinstance(entry, list) or not entry or entry[0] not in (READ, WROTE):
        return []
    direction, time_s, raw, *_ = entry
    pieces = [(None, each) if isinstance(each, bytes) else each for each in (raw if isinstance(raw, list) else [raw])]
    if not all(isinstance(data, bytes) for _, data in pieces):
        raise TypeError("a frame is bytes")
    return [Frame(time_s, direction, data.hex(), identifier) for identifier, data in pieces]


class Shown(NamedTuple):
    """A message of `/ticks` or `/frames`: topic, time in ns since 1970, number within the topic (ticks from 0, frames
    from 1)."""

    topic: str
    t_ns: int
    sequence: int
    data: bytes


class Derived:
    """Derives the messages of `/ticks` and `/frames` from the parts of `/core`."""

    def __init__(self, columns: str, offset_ns: int = 0) -> None:
        """Begin; `columns` names the values of a tick, a list in JSON, `offset_ns` is from monotonic time to 1970's."""
        self._columns = msgspec.json.decode(columns, type=tuple[str, ...])
        self._ticks = self._frames = 0
        self._offset_ns = offset_ns
        self._axis = Axis()
        self._monotonic_at = self._columns.index("monotonic_s") if "monotonic_s" in self._columns else 0

    def of(self, entries: Sequence[Any]) -> Iterator[Shown]:
        """Yield the messages derived from one part's entries, in their order: one a tick, one a frame."""
        for entry in entries:
            if is_tick(entry):
                data = msgspec.json.encode(known_values(self._columns, entry))
                yield Shown(TICKS_TOPIC, self._axis.of_tick(entry[0], entry[self._monotonic_at]), self._ticks, data)
                self._ticks += 1
            for frame in frames_in(entry):
                self._frames += 1
                t_ns = round(frame.monotonic_s * 1e9) + self._offset_ns
                yield Shown(FRAMES_TOPIC, t_ns, self._frames, msgspec.json.encode(frame))


def write_black_box(path: Path, header: dict[str, str], parts: Sequence[Part]) -> None:
    """Write a new black box of these parts, whole or not at all."""
    if path.exists():
        raise FileExistsError(17, "exists", str(path))
    offset_ns = parts[0].t_ns - round(parts[0].time_s * 1e9)
    derived = Derived(header["columns"], offset_ns)
    with in_place_of(path) as beside, beside.open("wb") as file:
        mcap = begun(file, {"version": __version__, "kind": HEADER})
        mcap.add_metadata(HEADER, header)
        core = mcap.register_channel(topic=CORE_TOPIC, message_encoding="msgpack", schema_id=0)
        schemas = {TICKS_TOPIC: TICK_SCHEMA, FRAMES_TOPIC: plain_schema(Frame)}
        channels = {topic: registered(mcap, topic, schema) for topic, schema in schemas.items()}
        for number, part in enumerate(parts):
            at_ns = round(part.time_s * 1e9) + offset_ns
            mcap.add_message(core, log_time=at_ns, data=part.entries, publish_time=part.t_ns, sequence=number)
            for shown in derived.of(msgspec.msgpack.decode(part.entries)):
                t_ns, channel = shown.t_ns, channels[shown.topic]
                mcap.add_message(channel, t_ns, shown.data, publish_time=t_ns, sequence=shown.sequence)
        mcap.finish()  # type: ignore[no-untyped-call]


def is_tick(entry: Any) -> bool:
    """Return whether an entry of a black box is a tick's record: a list that begins with an integer."""
    return isinstance(entry, list) and bool(entry) and type(entry[0]) is int


def read_black_box(path: Path) -> BlackBoxFile:
    """Read the black box in `path`; one that was cut short is returned as far as it reads, with `is_complete` False."""
    found = _Reading(path)
    with opened(path) as file:
        is_complete = scan(file, str(path), found.take, found.message, found.lose)
        damage = damage_in(file)
    if not found.header or not found.entries:
        raise RecordingError(f"{path}: {NO_BLACK_BOX}")
    if is_complete:
        found.end()
    return BlackBoxFile(found.header, found.entries, is_complete, found.odd or damage)


NO_BLACK_BOX = f"no black box of tormagd: it has nothing in {CORE_TOPIC} or no header {HEADER!r}"


class _Reading:
    """A black box while it is read: each message of `/ticks` and `/frames` is compared with what `/core` gives."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.header: dict[str, str] = {}
        self.entries: list[Any] = []
        self.odd = ""
        self._topics: dict[int, str] = {}
        self._derived: Derived | None = None
        self._expected: dict[str, deque[Shown]] = {TICKS_TOPIC: deque(), FRAMES_TOPIC: deque()}
        self._late_ns = {TICKS_TOPIC: 0}
        self._size = self._parts = 0

    def take(self, record: McapRecord, _at: int) -> None:
        """Take a record that is no message: note a channel's topic, add to the header; others are passed over."""
        if isinstance(record, Channel):
            if record.topic == CORE_TOPIC and record.message_encoding != "msgpack":
                raise ValueError(f"{CORE_TOPIC} is {record.message_encoding[:20]!r}: allowed is msgpack")
            self._topics.setdefault(record.id, record.topic)
        elif isinstance(record, Metadata) and record.name == HEADER:
            self.header.update(record.metadata)

    def message(self, sent: Message) -> None:
        """Keep the entries in a message of `/core`, or compare one of `/ticks` or `/frames` with them, or
        pass it over."""
        if not self.header:
            raise RecordingError(f"{self._path}: {NO_BLACK_BOX}")  # before all of a long recording has been read
        topic = self._topics.get(sent.channel_id, "")
        if topic == CORE_TOPIC:
            self._part(sent)
        elif topic in self._expected and not self.odd:
            self._compare(topic, sent)

    def lose(self, _what: str) -> None:
        """Note that entries are missing; what is derived from them is compared no more."""
        self.entries.append([MISSING])
        self._expected.clear()

    def _part(self, sent: Message) -> None:
        """Add a part's entries to `entries`, and expect the messages derived from them in the file."""
        self._size, self._parts = self._size + len(sent.data), self._parts + 1
        if self._size > MAX_BYTES or self._parts > MAX_PARTS:
            raise ValueError(f"over {MAX_BYTES} bytes or {MAX_PARTS} parts")
        entries = msgspec.msgpack.decode(sent.data, type=list[Any])
        self.entries.extend(entries)
        if len(self.entries) > MAX_ENTRIES:
            raise ValueError(f"over {MAX_ENTRIES} entries")
        if self._derived is None:
            self._derived = Derived(self.header.get("columns", "[]"))
        try:
            for shown in self._derived.of(entries) if self._expected else ():
                self._expected[shown.topic].append(shown)
        except (ValueError, TypeError, AttributeError, OverflowError, LookupError) as error:
            self.odd = self.odd or f"{CORE_TOPIC}: {str(error)[:100]}"

    def _compare(self, topic: str, sent: Message) -> None:
        """Compare the file's next message of `topic` with the next derived one, and note in `odd` where they differ."""
        if self._expected[topic]:
            expected = self._expected[topic].popleft()
            late_ns = sent.log_time - expected.t_ns
            off_ns = abs(late_ns - self._late_ns.setdefault(topic, late_ns))
            if (sent.sequence, sent.data) == (expected.sequence, expected.data) and off_ns <= MAX_OFF_NS[topic]:
                return
        self.odd = f"message {sent.sequence} in {topic} is not what {CORE_TOPIC} has"

    def end(self) -> None:
        """Note in `odd` the first derived message that the whole file does not have."""
        for topic, left in self._expected.items():
            if left and not self.odd:
                self.odd = f"message {left[0].sequence} is missing in {topic}, and {CORE_TOPIC} has it"
