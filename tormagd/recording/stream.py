"""The records of an MCAP file within bounds: a file costs no more memory and time than its size explains."""

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from zstandard import ZstdDecompressor

MAGIC = b"\x89MCAP0\r\n"
SEAL = 0xE5
"Opcode of a seal: a private record, which other readers pass over."
END = 0
"Stands for the closing magic: the file ends as it should."
MAX_RECORD_BYTES = 8_000_000
"Bound on one record; a black box's largest message has half of this."
MAX_CHUNK_BYTES = 16_000_000
"Bound on one chunk, unpacked."
MAX_TEXT_BYTES = 1_000_000
"Bound on a schema, a channel or a metadata record."
MAX_TEXTS = 1_000
"Bound on the number of schemas, channels and metadata records in one file."
MAX_RATIO, FREE_BYTES = 100, 16_000_000
"A file unpacks to at most MAX_RATIO times its size, plus FREE_BYTES."
MAX_WINDOW_BYTES = 1 << 24
HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_TEXTS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)
_ALLOWED = frozenset({*map(int, Opcode), SEAL})


class Record(NamedTuple):
    """One MCAP record: its kind, the byte at which it begins in the file, and its bytes without the head of nine."""

    opcode: int
    at: int
    body: bytes

    @property
    def head(self) -> bytes:
        return HEAD.pack(self.opcode, len(self.body))

    def read(self, kind: Any) -> Any:
        """Parse the body as the type `kind` of `mcap.records`."""
        return kind.read(ReadDataStream(BytesIO(self.body)))


class Sent(NamedTuple):
    """One message: channel, sequence number, time in ns since 1970, and payload."""

    channel: int
    sequence: int
    t_ns: int
    data: bytes


def contents(file: BinaryIO, message: Callable[[Sent], None]) -> Iterator[Record]:
    """Read an MCAP file: call `message` with each message, and yield every other record in order, also those in chunks."""
    unpacker = Unpacker()
    for record in records(file):
        if record.opcode == Opcode.CHUNK:
            yield record
            yield from unpacker.records(record, message)
        elif record.opcode == Opcode.MESSAGE:
            message(_sent(record.body, 0, len(record.body)))
        else:
            yield record


def records(file: BinaryIO) -> Iterator[Record]:
    """Yield the records of an MCAP file from its beginning; the last is END, which a file cut short does not have."""
    head = file.read(len(MAGIC))
    if not MAGIC.startswith(head):
        raise ValueError("it does not begin as MCAP does")
    if head == MAGIC:
        yield from following(file, len(MAGIC))


def following(file: BinaryIO, at: int) -> Iterator[Record]:
    """Yield the records from byte `at` on, where `file` already stands, up to the footer; then END."""
    texts = 0
    while (record := record_at(file, at)) is not None:
        texts += record.opcode in _TEXTS
        if texts > MAX_TEXTS:
            raise ValueError(f"over {MAX_TEXTS} schemas, channels and metadata")
        yield record
        at += HEAD.size + len(record.body)
        if record.opcode == Opcode.FOOTER:
            rest = file.read(len(MAGIC) + 1)
            if rest == MAGIC:
                yield Record(END, at, b"")
            elif not MAGIC.startswith(rest):
                raise ValueError("it does not end as MCAP does")
            return


def record_at(file: BinaryIO, at: int) -> Record | None:
    """Read the record at the file's present place, which is byte `at`; None where the file ends there or within it."""
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    if opcode not in _ALLOWED:
        raise ValueError(f"a record of the unknown kind {opcode} at byte {at}")
    most = MAX_TEXT_BYTES if opcode in _TEXTS else MAX_RECORD_BYTES
    if length > most:
        raise ValueError(f"a record of {length} bytes at byte {at}: allowed is {most}")
    body = file.read(length)
    return Record(opcode, at, body) if len(body) == length else None


class Unpacker:
    """Unpacks the chunks of one file, with one bound on all of them together."""

    def __init__(self) -> None:
        self._packed = self._unpacked = self._texts = 0

    def records(self, chunk: Record, message: Callable[[Sent], None]) -> Iterator[Record]:
        """Unpack a chunk, a record as it was read: call `message` with each message, yield the others in order."""
        known: Chunk = chunk.read(Chunk)
        self._packed += len(chunk.body)
        self._unpacked += known.uncompressed_size
        if self._unpacked > MAX_RATIO * self._packed + FREE_BYTES:
            raise ValueError(f"it unpacks to over {MAX_RATIO} times its size")
        data = _unpacked(known)
        at, end = 0, len(data)
        while at < end:
            opcode, length = HEAD.unpack_from(data, at)
            at += HEAD.size
            if length > end - at:
                raise ValueError("a record reaches beyond its chunk")
            if opcode == Opcode.MESSAGE:
                message(_sent(data, at, length))
            elif opcode in _TEXTS:
                self._texts += 1
                if self._texts > MAX_TEXTS or length > MAX_TEXT_BYTES:
                    raise ValueError(f"over {MAX_TEXTS} schemas and channels, or one of over {MAX_TEXT_BYTES} bytes")
                yield Record(opcode, chunk.at, data[at : at + length])
            at += length


def _sent(data: bytes, at: int, length: int) -> Sent:
    channel, sequence, t_ns, _ = _MESSAGE.unpack_from(data, at)
    return Sent(channel, sequence, t_ns, data[at + _MESSAGE.size : at + length])


def _unpacked(chunk: Chunk) -> bytes:
    """Unpack a chunk's data, with zstd or not at all, and return them."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes: allowed is {MAX_CHUNK_BYTES}")
    if chunk.compression == "zstd":
        with ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"compression {chunk.compression[:20]!r}: allowed is zstd")
    if len(data) != size:
        raise ValueError("a chunk does not unpack to the size that it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum is wrong")
    return data
