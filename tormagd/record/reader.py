"""Reading a recording: its overview, some seconds of it, or message by message.

A closed file says at its end where its chunks are; in any other they are looked for. Each is read by itself, so damage
costs no other. `mcap` parses the file. A file costs no more memory and time than its
size explains: a record, or a chunk unpacked, has at most MAX_RECORD_BYTES, and all chunks together MAX_RATIO times the
file's bytes.
"""

import contextlib
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
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
from tormagd.record.stream import MISSING
from tormagd.record.writer import (
    CORE_TOPIC,
    CUT,
    NUMBER_COLUMN,
    OVERVIEW,
    TELEMETRY_TOPIC,
    THINNED,
    TICKS_TOPIC,
    Derived,
    Shown as Shown,
    is_tick,
)
from tormagd_client.printable import printable
from tormagd_client.regular_file import require_regular

MAX_FILE_BYTES = 1 << 40
MAX_RECORD_BYTES = 8_000_000
"A black box's largest message has half of this."
MAX_RATIO, FREE_BYTES = 100, 16_000_000
MAX_WINDOW_BYTES = 1 << 24
DATA_END_BYTES = 13
BLOCK_BYTES = 1 << 20
MAX_INDEX = 1_000_000
"Chunks of one file: some days."
MAX_SEEN = 400_000
"Messages read at once: at 4 kHz more than a minute."
END_NS = 2**64 - 1
MAX_CORE_BYTES, MAX_ENTRIES = 50_000_000, 1_000_000
"Bounds on what is read of one file, a minute of 1 kHz; what comes after is passed over."
TOPICS = (TELEMETRY_TOPIC, TICKS_TOPIC)
UNREADABLE = (
    McapError, ZstdError, EOFError, OSError, ValueError, OverflowError, MemoryError, RecursionError, struct.error,
    msgspec.MsgspecError,
)  # fmt: skip
"What damage raises: MemoryError and OSError if a length or place is more than there is."


class RecordingError(ValueError):
    """A file that is not a readable recording; the text names the file and what is wrong."""


@contextlib.contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    try:
        require_regular(path, MAX_FILE_BYTES)
        with path.open("rb") as file, readable(str(path)):
            yield file
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


@contextlib.contextmanager
def readable(name: str) -> Iterator[None]:
    """Turn any of UNREADABLE into a RecordingError that names the file."""
    try:
        yield
    except UNREADABLE as error:
        raise RecordingError(
            str(error)
            if isinstance(error, RecordingError)
            else f"{name}: not an intact MCAP file of tormagd ({str(error)[:200]})"
        ) from error


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
    reader = StreamReader(
        stream,  # type: ignore[arg-type]
        skip_magic=not has_magic,
        emit_chunks=True,
        record_size_limit=MAX_RECORD_BYTES,
    )
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


def _at(file: BinaryIO, at: int, kind: type[Any]) -> Any:
    file.seek(at)
    record = next(_records(file))
    if not isinstance(record, kind):
        raise ValueError(f"at byte {at} there is no {kind.__name__}")
    return record


def _end(file: BinaryIO) -> tuple[int, int]:
    """Return where summary, 0 for none, and footer begin."""
    at = max(0, file.seek(0, 2) - FOOTER_SIZE - MAGIC_SIZE)
    file.seek(at)
    return _at(file, at, Footer).summary_start if file.read().endswith(MCAP0_MAGIC) else 0, at


def damage_in(file: BinaryIO) -> str:
    """Say which CRC of a closed MCAP file is wrong, or that it is none; empty otherwise."""
    try:
        file.seek(0)
        if file.read(MAGIC_SIZE) != MCAP0_MAGIC:
            return "it does not begin as an MCAP file"
        summary_at, at = _end(file)
        if not summary_at:
            return ""
        data_end_at = summary_at - DATA_END_BYTES
        if _at(file, data_end_at, DataEnd).data_section_crc not in (0, _crc(file, 0, data_end_at)):
            return "the CRC of its data is wrong"
        if _at(file, at, Footer).summary_crc not in (0, _crc(file, summary_at, at + FOOTER_SIZE - 4)):
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
    """What is in an MCAP file: topics, metadata, where its chunks are, and which of those read are damaged."""

    def __init__(self, file: BinaryIO) -> None:
        self.topics: dict[int, str] = {}
        self.metadata: dict[str, str] = {}
        self.places: list[Place] = []
        self.lost: dict[int, str] = {}
        "What is wrong, by where the chunk begins."
        self.damage = ""
        self._overview_at = 0
        self._is_closed = self._read_summary(file)

    @property
    def is_complete(self) -> bool:
        """False if the recorder was killed or the disk was full: earlier messages are there."""
        return self._is_closed and CUT not in self.metadata

    @property
    def notes(self) -> list[str]:
        """What its reader has to know."""
        lost, known = list(self.lost.values()), self.metadata
        return [
            *([f"damaged: {self.damage}"] if self.damage else []),
            *([f"left out: {len(lost)} damaged, {lost[0]}"] if lost else []),
            *([] if self.is_complete else [f"cut short: {known.get(CUT, 'its recorder did not end it, or goes on')}"]),
            *([f"thinned: {known[THINNED]}"] if THINNED in known else []),
        ]

    def _read_summary(self, file: BinaryIO) -> bool:
        """Read what stands at the end, and return whether all of that is there."""
        told: list[int] = []
        with contextlib.suppress(*UNREADABLE):
            at, _ = _end(file)
            file.seek(at)
            for record in _records(file) if at else ():
                self._take(record, 0)
                if isinstance(record, MetadataIndex):
                    told.append(record.offset)
                elif isinstance(record, AttachmentIndex) and record.name == OVERVIEW:
                    self._overview_at = record.offset
            for each in told:
                self._take(_at(file, each, Metadata), each)
            return at > 0
        self.places = []
        return False

    def _look_for_chunks(self, file: BinaryIO) -> None:
        """Look for chunks from the beginning, as far as records follow each other."""
        at = file.seek(0) + MAGIC_SIZE
        try:
            for record in _records(file, has_magic=True):
                if isinstance(record, DataEnd):
                    break
                self._take(record, at)
                at = file.tell()
        except UNREADABLE:
            if not self.places:
                raise

    def _take(self, record: McapRecord, at: int) -> None:
        if isinstance(record, Channel):
            self.topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            self.metadata.update(record.metadata)
        elif isinstance(record, Chunk | ChunkIndex) and len(self.places) < MAX_INDEX:
            at = record.chunk_start_offset if isinstance(record, ChunkIndex) else at
            self.places.append(Place(record.message_start_time, record.message_end_time, at))

    def messages(self, file: BinaryIO, from_ns: int = 0, to_ns: int = END_NS) -> Iterator[Shown]:
        """Yield the messages, undecoded, of the chunks that have some of this time, and are not damaged."""
        if not self.places:
            self._look_for_chunks(file)
        size = 0
        for place in self.places:
            if place.from_ns > to_ns or place.to_ns < from_ns:
                continue
            if size > MAX_RATIO * file.tell() + FREE_BYTES:
                raise ValueError(f"it unpacks to over {MAX_RATIO} times its size")
            try:
                chunk = _at(file, place.at, Chunk)
                size += max(min(chunk.uncompressed_size, MAX_RECORD_BYTES), len(chunk.data))
                records = _within(chunk)
            except UNREADABLE as error:
                self.lost[place.at] = f"byte {place.at}: {str(error)[:80] or repr(error)}"
                continue
            for record in records:
                self._take(record, place.at)
                if isinstance(record, Message):
                    yield Shown(self.topics.get(record.channel_id, ""), record.log_time, record.sequence, record.data)

    def read(self, file: BinaryIO, wanted: Any, from_ns: int = 0, to_ns: int = END_NS) -> Iterator[Shown]:
        """Yield the ticks and snapshots from `from_ns` to `to_ns`, inclusive, decoded as `wanted`."""
        decode = msgspec.json.Decoder(wanted).decode
        for topic, t_ns, sequence, data in self.messages(file, from_ns, to_ns):
            if topic in TOPICS and from_ns <= t_ns <= to_ns:
                yield Shown(topic, t_ns, sequence, decode(data))
        if len(self.lost) == len(self.places) > 0:
            raise ValueError(next(iter(self.lost.values())))
        self._require_topics()

    def _require_topics(self) -> None:
        if set(self.topics.values()).isdisjoint(TOPICS):
            raise ValueError(f"no channel {TELEMETRY_TOPIC} or {TICKS_TOPIC} in it; `tormagctl record` makes one")

    def read_overview(self, file: BinaryIO) -> Overview | None:
        """Read the overview of a closed file without damage, if there is one."""
        self.damage = damage_in(file)
        if self.damage or not self._is_closed or not self._overview_at:
            return None
        self._require_topics()
        return unpacked(_at(file, self._overview_at, Attachment).data)

    def described(self, name: str, kind: Any) -> Any:
        try:
            return msgspec.json.decode(self.metadata[name], type=kind)
        except (KeyError, msgspec.MsgspecError, RecursionError):
            return None


def read_open(file: BinaryIO, name: str, wanted: Any, each: Callable[[Shown], None]) -> Contents:
    """Read an open recording: each tick and snapshot goes to `each`."""
    with readable(name):
        found = Contents(file)
        for seen in found.read(file, wanted):
            each(seen)
    return found


def read_recording(path: Path, wanted: Any, each: Callable[[Shown], None]) -> Contents:
    """Read the recording in `path`: each tick and snapshot, decoded as `wanted`, goes to `each`."""
    with opened(path) as file:
        return read_open(file, str(path), wanted, each)


class RecordingFile(Contents):
    """A recording of any length on the disk."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, printable(path.name)
        with opened(path) as file:
            super().__init__(file)
            overview = self.read_overview(file)
            if overview is None:
                builder = OverviewBuilder()
                for seen in self.read(file, Glance):
                    builder.add(seen.t_ns, seen.is_tick, seen.message)
                overview = builder.made()
        self.overview = overview

    def between(self, from_ns: int, to_ns: int, wanted: Any) -> list[Shown]:
        """Return the ticks and snapshots from `from_ns` to `to_ns`, inclusive, in the file's order."""
        with opened(self.path) as file:
            found = list(islice(self.read(file, wanted, from_ns, to_ns), MAX_SEEN + 1))
            if len(found) > MAX_SEEN:
                raise ValueError(f"over {MAX_SEEN} messages in {(to_ns - from_ns) * 1e-9:.0f} s")
        return found


class BlackBoxFile(Contents):
    """The entries of all parts of `/core` in order, as plain data, for a replay.

    A file that was cut short, or is longer than what is read, has those up to there, and is not complete. A message of
    another topic is compared with what `/core` gives.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.entries = path, list[Any]()
        self.odd, self._is_over = "", False
        "The first message of another topic that is not what `/core` gives, or why an entry of `/core` gives none."
        self._expected: deque[Shown] = deque()
        self._derived, self._size = Derived(), 0
        self._tick: int | None = None
        with opened(path) as file:
            super().__init__(file)
            self._read_core(file)
            self.damage = damage_in(file)
        damage = next(iter(self.lost.values()), self.damage)
        if not self.entries:
            none = f"no black box of tormagd: it has nothing in {CORE_TOPIC}, or not what a replay needs"
            raise RecordingError(f"{path}: {f'damaged: {damage}' if damage else none}")
        if self._expected and self.is_complete and not self.lost:
            self._compare(self._expected[0], None)
        self._note(damage)

    @property
    def is_complete(self) -> bool:
        return super().is_complete and not self._is_over

    def _note(self, odd: str) -> None:
        self.odd = self.odd or odd

    def _read_core(self, file: BinaryIO) -> None:
        """Keep the entries of `/core`, and compare what is derived of them, as far as no chunk is lost."""
        for sent in self.messages(file):
            if "format" not in self.metadata or self._is_over:
                return  # before all of a long recording has been read
            if sent.topic == CORE_TOPIC:
                self._part(msgspec.json.decode(self.metadata.get("columns", "[]"), type=tuple[str, ...]), sent.message)
            elif not self.lost:
                self._compare(sent, self._expected.popleft() if self._expected else None)

    def _compare(self, sent: Shown, expected: Shown | None) -> None:
        if sent != expected:
            other = expected or sent
            self._note(f"message {other.sequence} in {other.topic} is not what {CORE_TOPIC} has")

    def _part(self, columns: tuple[str, ...], data: bytes) -> None:
        entries, self._size = msgspec.msgpack.decode(data, type=list[Any]), self._size + len(data)
        self._is_over = self._size > MAX_CORE_BYTES or len(self.entries) + len(entries) > MAX_ENTRIES
        if self._is_over:
            return
        try:
            self._join([each[columns.index(NUMBER_COLUMN)] for each in entries if is_tick(each)])
            for shown in () if self.lost else self._derived.of(columns, entries):
                self._expected.append(shown._replace(message=msgspec.json.encode(shown.message)))
        except (ValueError, TypeError, AttributeError, OverflowError, LookupError) as error:
            self._note(f"{CORE_TOPIC}: {str(error)[:100]}")
        self.entries.extend(entries)

    def _join(self, numbers: list[int]) -> None:
        """Note that entries are missing before these, which were lost on the way or are another daemon's."""
        if numbers and self._tick is not None and not self._tick <= numbers[0] <= self._tick + 1:
            self.entries.append([MISSING])
        self._tick = numbers[-1] if numbers else self._tick


def overview_of(path: Path) -> tuple[Overview | None, Contents]:
    """Read the overview at the end of the file, if there is one."""
    with opened(path) as file:
        known = Contents(file)
        return known.read_overview(file), known
