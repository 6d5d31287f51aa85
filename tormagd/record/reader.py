"""Reading a recording: its overview, some seconds of it, or message by message.

`mcap` parses the file. A file costs no more memory and time than its size explains: a record, or a chunk unpacked, has
at most MAX_RECORD_BYTES, and all chunks together MAX_RATIO times the file's bytes.
"""

import contextlib
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec
from mcap.exceptions import McapError
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
)  # fmt: skip
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import CONTENTSIZE_UNKNOWN, ZstdError, get_frame_parameters

from tormagd.record.overview import Glance, Overview, OverviewBuilder, unpacked
from tormagd.record.writer import CUT, OVERVIEW, TELEMETRY_TOPIC, THINNED, TICKS_TOPIC
from tormagd_client.printable import printable
from tormagd_client.regular_file import require_regular

MAX_FILE_BYTES = 1 << 40
MAX_RECORD_BYTES = 8_000_000
"A black box's largest message has half of this."
MAX_RATIO, FREE_BYTES = 100, 16_000_000
"All chunks unpack to at most MAX_RATIO times the bytes read, plus FREE_BYTES."
MAX_WINDOW_BYTES = 1 << 24
DATA_END_BYTES = 13
BLOCK_BYTES = 1 << 20
MAX_INDEX = 1_000_000
"Chunks of one file: some days."
MAX_SEEN = 400_000
"Messages read at once: at 4 kHz more than a minute."
TOPICS = (TELEMETRY_TOPIC, TICKS_TOPIC)
UNREADABLE = (
    McapError, ZstdError, EOFError, ValueError, OverflowError, MemoryError, RecursionError, struct.error,
    msgspec.MsgspecError,
)  # fmt: skip
"What damage raises: MemoryError if a damaged length asks for more than there is."


class RecordingError(ValueError):
    """A file that is not a readable recording; the text names the file and what is wrong."""


class Seen(NamedTuple):
    """A control tick or a snapshot, with the fields that were wanted; its time is ns since 1970."""

    t_ns: int
    is_tick: bool
    message: Any


@contextlib.contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    try:
        require_regular(path, MAX_FILE_BYTES)
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


@contextlib.contextmanager
def readable(name: str) -> Iterator[None]:
    """Turn any of UNREADABLE into a RecordingError that names the file."""
    try:
        yield
    except RecordingError:
        raise
    except UNREADABLE as error:
        raise RecordingError(f"{name}: not an intact MCAP file ({str(error)[:200]})") from error


class _Bounded:
    """A file for an MCAP reader, which may read `left` more bytes."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.left = file, MAX_RECORD_BYTES

    def read(self, size: int) -> bytes:
        self.left -= size
        if self.left < 0:
            raise ValueError(f"a record of over {MAX_RECORD_BYTES} bytes")
        data = self._file.read(size)
        if len(data) < size:
            raise EOFError("it ends within a record")
        return data


def _records(file: BinaryIO, *, has_magic: bool = False) -> Iterator[McapRecord]:
    """Yield the records to the end, chunks packed."""
    stream = _Bounded(file)
    limits: dict[str, Any] = {"emit_chunks": True, "record_size_limit": MAX_RECORD_BYTES}
    reader = StreamReader(stream, skip_magic=not has_magic, **limits)  # type: ignore[arg-type]
    for record in reader.records:
        yield record
        stream.left = MAX_RECORD_BYTES


def _within(chunk: Chunk) -> list[McapRecord]:
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES or chunk.compression not in ("zstd", ""):
        raise ValueError(f"a chunk of {size} bytes ({chunk.compression[:20]!r}): allowed is zstd, {MAX_RECORD_BYTES}")
    if chunk.compression:
        frame = get_frame_parameters(chunk.data)
        if frame.content_size not in (size, CONTENTSIZE_UNKNOWN) or frame.window_size > MAX_WINDOW_BYTES:
            raise ValueError("a chunk does not unpack to the size that it states")
    return breakup_chunk(chunk, validate_crc=True)


def scan(file: BinaryIO, name: str, found: "Contents") -> bool:
    """Read an MCAP file into `found`; return False for one that was cut short.

    After damage, reading goes on with the next chunk.
    """
    size, is_whole = 0, True
    with readable(name):
        try:
            for at, record, within in _intact(file, found.lose):
                if isinstance(record, Chunk):
                    found.take(record, at)
                    size += record.uncompressed_size
                    if size > MAX_RATIO * file.tell() + FREE_BYTES:
                        raise ValueError(f"it unpacks to over {MAX_RATIO} times its size")
                for each in within:
                    if isinstance(each, Message):
                        found.message(each)
                    else:
                        found.take(each, at)
        except EOFError:
            is_whole = False
        if found.lost and not size:
            raise ValueError(found.lost[0])
        if is_whole and file.read(1):
            raise ValueError("it does not end as MCAP does")
    return is_whole


def _intact(file: BinaryIO, lost: Callable[[str], None]) -> Iterator[tuple[int, McapRecord, list[McapRecord]]]:
    """Yield where each record begins, the record, and what is in a chunk; EOFError where no more can be read.

    After damage the summary says where the next chunk is; without one, reading goes on after a chunk.
    """
    at, records = MAGIC_SIZE, _records(file, has_magic=True)
    chunks: list[int] | None = None
    while True:
        record: McapRecord | None = None
        try:
            record = next(records, None)
            if record is None:
                return
            within = _within(record) if isinstance(record, Chunk) else [record]
        except UNREADABLE as error:
            if record is None and isinstance(error, EOFError):
                raise
            lost(f"byte {at}: {str(error)[:80] or repr(error)}")
            end = file.tell()
            if chunks is None:
                chunks = _indexed(file)
            following = bisect_right(chunks, at)
            if following == len(chunks) and record is None:
                raise EOFError from error
            at = file.seek(chunks[following] if following < len(chunks) else end)
            records = _records(file)
        else:
            yield at, record, within
            at = file.tell()


def _indexed(file: BinaryIO) -> list[int]:
    """List where the chunks begin that the file's summary names; none where it is not there."""
    found = Contents()
    with contextlib.suppress(*UNREADABLE):
        for record in _summary(file):
            if isinstance(record, ChunkIndex):
                found.place(record, record.chunk_start_offset)
    return sorted(place.at for place in found.places)


def _summary(file: BinaryIO) -> Iterator[McapRecord]:
    """Yield the records of a file's summary; none of one that was cut short."""
    footer, _ = _end(file)
    if footer is not None:
        file.seek(footer.summary_start)
        yield from _records(file)


def _at(file: BinaryIO, at: int, kind: type[Any]) -> Any:
    file.seek(at)
    record = next(_records(file))
    if not isinstance(record, kind):
        raise ValueError(f"at byte {at} there is no {kind.__name__}")
    return record


def _end(file: BinaryIO) -> tuple[Footer | None, int]:
    at = max(0, file.seek(0, 2) - FOOTER_SIZE - MAGIC_SIZE)
    file.seek(at)
    footer = _at(file, at, Footer) if file.read().endswith(MCAP0_MAGIC) else None
    return (footer if footer and footer.summary_start else None), at


def damage_in(file: BinaryIO) -> str:
    """Say which CRC of a whole MCAP file is wrong; empty for none, and for a file cut short."""
    try:
        footer, at = _end(file)
        if footer is None:
            return ""
        data_end_at = footer.summary_start - DATA_END_BYTES
        data_crc = _at(file, data_end_at, DataEnd).data_section_crc
        if not data_crc:
            file.seek(0)
            found = Contents()
            scan(file, file.name, found)
            if found.lost:
                return found.lost[0]
        elif data_crc != _crc(file, 0, data_end_at):
            return "the CRC of its data is wrong"
        if footer.summary_crc not in (0, _crc(file, footer.summary_start, at + FOOTER_SIZE - 4)):
            return "the CRC of its summary is wrong"
    except UNREADABLE as error:
        return str(error)[:200] or repr(error)
    return ""


def _crc(file: BinaryIO, first: int, end: int) -> int:
    crc = 0
    file.seek(first)
    for at in range(first, end, BLOCK_BYTES):
        crc = zlib.crc32(file.read(min(end - at, BLOCK_BYTES)), crc)
    return crc


class Place(NamedTuple):
    """Where a chunk begins in the file, and its messages' times, ns since 1970."""

    from_ns: int
    to_ns: int
    at: int


class Contents:
    """Collects topics, metadata, places of chunks, and damage, in the file's order. Messages are passed over."""

    def __init__(self) -> None:
        self.topics: dict[int, str] = {}
        self.metadata: dict[str, str] = {}
        self.places: list[Place] = []
        self.lost: list[str] = []
        self.is_complete = True
        "False if the recorder was killed or the disk was full: earlier messages are there."

    def take(self, record: McapRecord, at: int) -> None:
        if isinstance(record, Channel):
            self.topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            self.metadata.update(record.metadata)
        elif isinstance(record, Chunk):
            self.place(record, at)

    def place(self, chunk: Chunk | ChunkIndex, at: int) -> None:
        if len(self.places) < MAX_INDEX:
            self.places.append(Place(chunk.message_start_time, chunk.message_end_time, at))

    def message(self, sent: Message) -> None:
        pass

    def lose(self, what: str) -> None:
        self.lost.append(what)

    def end(self, name: str, *, is_whole: bool) -> None:
        """Note whether all was read. Raises RecordingError where the file `name` is no recording."""
        if set(self.topics.values()).isdisjoint(TOPICS):
            raise RecordingError(
                f"{name}: no channel {TELEMETRY_TOPIC} or {TICKS_TOPIC} in it; `tormagctl record` makes one"
            )
        self.is_complete = is_whole and CUT not in self.metadata

    def described(self, name: str, kind: Any) -> Any:
        try:
            return msgspec.json.decode(self.metadata[name], type=kind)
        except (KeyError, msgspec.MsgspecError, RecursionError):
            return None


class Recording(Contents):
    """Hands each tick and snapshot to `each`, decoded as `wanted`."""

    def __init__(self, wanted: Any, each: Callable[[Seen], None]) -> None:
        super().__init__()
        self._decode, self._each = msgspec.json.Decoder(wanted).decode, each

    def message(self, sent: Message) -> None:
        topic = self.topics.get(sent.channel_id)
        if topic in TOPICS:
            self._each(Seen(sent.log_time, topic == TICKS_TOPIC, self._decode(sent.data)))


def read_open(file: BinaryIO, name: str, wanted: Any, each: Callable[[Seen], None]) -> Contents:
    """Read an open recording: each tick and snapshot goes to `each`."""
    found = Recording(wanted, each)
    found.end(name, is_whole=scan(file, name, found))
    return found


def read_recording(path: Path, wanted: Any, each: Callable[[Seen], None]) -> Contents:
    """Read the recording in `path`: each tick and snapshot, decoded as `wanted`, goes to `each`."""
    with opened(path) as file:
        return read_open(file, str(path), wanted, each)


class RecordingFile:
    """A recording of any length on the disk."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, printable(path.name)
        with opened(path) as file:
            self.damage = damage_in(file)
        found = None if self.damage else summary_of(path)
        if found is None:
            builder = OverviewBuilder()
            found = read_recording(path, Glance, lambda seen: builder.add(*seen)), builder.made()
        self._contents, self.overview = found
        self.metadata, self.described = self._contents.metadata, self._contents.described
        self.is_complete = self._contents.is_complete
        known = self.metadata
        self.notes = [
            *([f"damaged: {self.damage}"] if self.damage else []),
            *(
                [f"left out: {len(self._contents.lost)} damaged, {self._contents.lost[0]}"]
                if self._contents.lost
                else []
            ),
            *([] if self.is_complete else [f"cut short: {known.get(CUT, 'its recorder did not end it')}"]),
            *([f"thinned: {known[THINNED]}"] if THINNED in known else []),
        ]
        "What its reader has to know, in words."

    def between(self, from_ns: int, to_ns: int, wanted: Any) -> list[Seen]:
        """Return the ticks and snapshots from `from_ns` to `to_ns`, inclusive, in the file's order."""
        found: list[Seen] = []

        def keep(seen: Seen) -> None:
            if from_ns <= seen.t_ns <= to_ns:
                found.append(seen)
                if len(found) > MAX_SEEN:
                    raise ValueError(f"over {MAX_SEEN} messages in {(to_ns - from_ns) * 1e-9:.0f} s")

        reading = Recording(wanted, keep)
        reading.topics = self._contents.topics
        with opened(self.path) as file, readable(str(self.path)):
            for place in self._contents.places:
                if place.from_ns <= to_ns and place.to_ns >= from_ns:
                    for each in _within(_at(file, place.at, Chunk)):
                        if isinstance(each, Message):
                            reading.message(each)
        return found


def summary_of(path: Path) -> tuple[Contents, Overview] | None:
    """Read contents and overview from the end of the file, if they are there."""
    found, told, overview_at = Contents(), [], 0
    with opened(path) as file, readable(str(path)):
        for record in _summary(file):
            if isinstance(record, ChunkIndex):
                found.place(record, record.chunk_start_offset)
            elif isinstance(record, MetadataIndex):
                told.append(record.offset)
            elif isinstance(record, AttachmentIndex) and record.name == OVERVIEW:
                overview_at = record.offset
            else:
                found.take(record, 0)
        if not overview_at:
            return None
        for at in told:
            found.take(_at(file, at, Metadata), at)
        found.end(str(path), is_whole=True)
        return found, unpacked(_at(file, overview_at, Attachment).data)
