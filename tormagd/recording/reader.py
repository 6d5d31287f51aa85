"""Reading a recording: its overview, some seconds of it, or message by message."""

import contextlib
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, ChunkIndex, Footer, Metadata, MetadataIndex
from zstandard import ZstdError

from tormagd.recording.overview import Glance, Overview, OverviewBuilder, unpacked
from tormagd.recording.seal import KEYED, SEALED, State, verified
from tormagd.recording.stream import END, HEAD, MAGIC, Record, Sent, Unpacker, contents, following, record_at
from tormagd.recording.writer import ABOUT, CUT, OVERVIEW, TELEMETRY_TOPIC, THINNED, TICKS_TOPIC
from tormagd_client.regular_file import require_regular

MAX_FILE_BYTES = 1 << 40
MAX_INDEX = 1_000_000
"Bound on the chunks of one file: some days of them."
MAX_SEEN = 400_000
"Bound on the messages read at once: at 4 kHz more than a minute."
TAIL_BYTES = HEAD.size + 20 + len(MAGIC)
TOPICS = (TELEMETRY_TOPIC, TICKS_TOPIC)
UNREADABLE = (
    McapError, ZstdError, ValueError, OverflowError, MemoryError, RecursionError, struct.error, msgspec.MsgspecError,
)  # fmt: skip
"""What damage raises; MemoryError where a damaged length asks for more than there is."""


class RecordingError(ValueError):
    """A file that is not a readable recording: the text names the file and what is wrong with it."""


class Seen(NamedTuple):
    """A control tick or a snapshot: its time in ns since 1970, which of the two, and the fields that were wanted."""

    t_ns: int
    is_tick: bool
    message: Any


@contextlib.contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open the file in `path` for reading, as a context."""
    try:
        require_regular(path, MAX_FILE_BYTES)
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


@contextlib.contextmanager
def readable(name: str) -> Iterator[None]:
    """Turn any of UNREADABLE raised within this context into a RecordingError that calls the file `name`."""
    try:
        yield
    except RecordingError:
        raise
    except UNREADABLE as error:
        raise RecordingError(f"{name}: not an intact MCAP file ({str(error)[:200]})") from error


def scan(file: BinaryIO, name: str, take: Callable[[Record], None], message: Callable[[Sent], None]) -> bool:
    """Read an MCAP file from its beginning: each message goes to `message`, any other record, also a chunk, to `take`."""
    last = -1
    with readable(name):
        for record in contents(file, message):
            last = record.opcode
            take(record)
        if last < 0:
            raise ValueError("there is nothing in it")
    return last == END


class Place(NamedTuple):
    """Where a chunk is: its messages' times in ns since 1970, and the byte at which it begins."""

    from_ns: int
    to_ns: int
    at: int


class Contents:
    """Collects what a file's records tell: topics, metadata, and places of chunks, in the file's order."""

    def __init__(self) -> None:
        self._topics: dict[int, str] = {}
        self.metadata: dict[str, str] = {}
        self.places: list[Place] = []
        self.is_keyed = False
        "Whether it says that it is sealed with a key."
        self.is_complete = True
        "False where the recorder was killed or the disk was full: messages up to then are there."

    def take(self, record: Record) -> None:
        """Note what a record that is no message tells: a channel's topic, tormagd's metadata, or a chunk's place."""
        if record.opcode == Opcode.CHANNEL:
            channel = record.read(Channel)
            self._topics[channel.id] = channel.topic
        elif record.opcode == Opcode.METADATA:
            known = record.read(Metadata)
            if known.name == ABOUT:
                self.metadata.update(known.metadata)
            self.is_keyed = self.is_keyed or (known.name == SEALED and known.metadata.get("by") == KEYED)
        elif record.opcode == Opcode.CHUNK and len(self.places) < MAX_INDEX:
            chunk = record.read(Chunk)
            self.places.append(Place(chunk.message_start_time, chunk.message_end_time, record.at))

    def reading(self, wanted: Any, each: Callable[[Seen], None]) -> Callable[[Sent], None]:
        """Return a function of one Sent, which hands each tick and snapshot to `each`, decoded as the type `wanted`."""
        decoder = msgspec.json.Decoder(wanted)

        def message(sent: Sent) -> None:
            topic = self._topics.get(sent.channel)
            if topic in TOPICS:
                each(Seen(sent.t_ns, topic == TICKS_TOPIC, decoder.decode(sent.data)))

        return message

    def require(self, name: str) -> None:
        """Raise RecordingError, naming the file `name`, where the file has neither telemetry nor ticks."""
        if set(self._topics.values()).isdisjoint(TOPICS):
            raise RecordingError(
                f"{name}: no channel {TELEMETRY_TOPIC} or {TICKS_TOPIC} in it; `tormagctl record` makes one"
            )

    def described(self, name: str, kind: Any) -> Any:
        """Return the metadata value `name`, which is JSON, decoded as the type `kind` by msgspec."""
        try:
            return msgspec.json.decode(self.metadata[name], type=kind)
        except (KeyError, msgspec.MsgspecError, RecursionError):
            return None


def read_open(file: BinaryIO, name: str, wanted: Any, each: Callable[[Seen], None]) -> Contents:
    """Read the recording in an open `file` at byte 0, which errors call `name`: each tick and snapshot goes to `each`."""
    found = Contents()
    is_whole = scan(file, name, found.take, found.reading(wanted, each))
    found.require(name)
    found.is_complete = is_whole and CUT not in found.metadata
    return found


def read_recording(path: Path, wanted: Any, each: Callable[[Seen], None]) -> Contents:
    """Read the recording in `path`: each tick and snapshot, decoded as the type `wanted`, goes to `each`."""
    with opened(path) as file:
        return read_open(file, str(path), wanted, each)


class RecordingFile:
    """A recording on the disk, of any length: its `overview`, `metadata`, `is_complete`, and any seconds of it."""

    def __init__(self, path: Path, key: bytes = b"") -> None:
        self.path = path
        with opened(path):
            self.seal = verified(path, key)
        found = summary_of(path) if self.seal.state is State.WHOLE else None
        if found is None:
            builder = OverviewBuilder()
            found = read_recording(path, Glance, lambda seen: builder.add(*seen)), builder.made()
        self._contents, self.overview = found
        self.metadata, self.described = self._contents.metadata, self._contents.described
        self.is_complete = self._contents.is_complete
        known = self.metadata
        self.notes = [
            *([] if self.seal.is_sound else [self.seal.text()]),
            *([] if self.is_complete else [f"cut short: {known.get(CUT, 'its recorder did not end it')}"]),
            *([f"thinned: {known[THINNED]}"] if THINNED in known else []),
        ]
        "What whoever looks at it has to know, in words."

    def between(self, from_ns: int, to_ns: int, wanted: Any) -> list[Seen]:
        """Return the ticks and snapshots from `from_ns` to `to_ns`, both included, in the file's order, decoded as
        `wanted`."""
        found: list[Seen] = []

        def keep(seen: Seen) -> None:
            if from_ns <= seen.t_ns <= to_ns:
                found.append(seen)
                if len(found) > MAX_SEEN:
                    raise ValueError(f"over {MAX_SEEN} messages in {(to_ns - from_ns) * 1e-9:.0f} s")

        message, unpacker = self._contents.reading(wanted, keep), Unpacker()
        with opened(self.path) as file, readable(str(self.path)):
            for place in self._contents.places:
                if place.from_ns <= to_ns and place.to_ns >= from_ns:
                    for _ in unpacker.records(_at(file, place.at, Opcode.CHUNK), message):
                        pass
        return found


def summary_of(path: Path) -> tuple[Contents, Overview] | None:
    """Read contents and overview from the end of the file in `path`, without its messages."""
    with opened(path) as file, readable(str(path)):
        found = _from_summary(file)
        if found is not None:
            found[0].require(str(path))
        return found


def _from_summary(file: BinaryIO) -> tuple[Contents, Overview] | None:
    """Read contents and overview from the end of a finished file; None for a cut file, or one without an overview."""
    at = file.seek(0, 2) - TAIL_BYTES
    file.seek(max(0, at))
    if at < 0 or not file.read().endswith(MAGIC):
        return None
    file.seek(at)
    footer = record_at(file, at)
    start = footer.read(Footer).summary_start if footer is not None and footer.opcode == Opcode.FOOTER else 0
    found = Contents()
    overview_at, told = None, []
    file.seek(start)
    for record in following(file, start) if start else ():
        if record.opcode == Opcode.CHUNK_INDEX and len(found.places) < MAX_INDEX:
            index = record.read(ChunkIndex)
            found.places.append(Place(index.message_start_time, index.message_end_time, index.chunk_start_offset))
        elif record.opcode == Opcode.METADATA_INDEX:
            told.append(record.read(MetadataIndex).offset)
        elif record.opcode == Opcode.ATTACHMENT_INDEX:
            attached = record.read(AttachmentIndex)
            overview_at = attached.offset if attached.name == OVERVIEW else overview_at
        else:
            found.take(record)
    if overview_at is None:
        return None
    for at in told:
        found.take(_at(file, at, Opcode.METADATA))
    found.is_complete = CUT not in found.metadata
    return found, unpacked(_at(file, overview_at, Opcode.ATTACHMENT).read(Attachment).data)


def _at(file: BinaryIO, at: int, opcode: Opcode) -> Record:
    """Read the record at byte `at`, and leave `file` behind it."""
    file.seek(at)
    record = record_at(file, at)
    if record is None or record.opcode != opcode:
        raise ValueError(f"its index points to byte {at}, where something else is")
    return record
