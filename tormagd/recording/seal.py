"""Seals: records in a file that hold a digest of every byte before them, so that a later change shows.

A sealed file says near its beginning that it is sealed, and whether with a key. Each seal is a private record of 33
bytes: 1 in the last seal and 0 in others, then the BLAKE2b digest of all before. The last seal ends the summary; only
the footer follows, which the rest of the file determines. Whoever has the key can tell a file that was sealed anew.
"""

import hashlib
import struct
import zlib
from enum import StrEnum
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Footer, Metadata
from mcap.writer import Writer

from tormagd.bounded_file import read_bounded
from tormagd.recording.stream import END, HEAD, MAGIC, MAX_CHUNK_BYTES, SEAL, Record, records

SEALED = "tormagd.seal"
"The metadata record of a sealed file; `by` is PLAIN or KEYED, `follows` the last digest of the segment before."
PLAIN, KEYED = "blake2b", "keyed blake2b"
MIN_KEY, MAX_KEY = 16, 64
KEY_HINT = "[recordings] key in the configuration names the key's file"
DIGEST_BYTES = 32
_FOOTER_BYTES = HEAD.size + 20
_BODY = struct.Struct(f"<B{DIGEST_BYTES}s")


def read_key(file: str) -> bytes:
    """Read the sealing key from the file named `file`, without surrounding white space; empty for an empty name."""
    if not file:
        return b""
    key = read_bounded(Path(file), 2 * MAX_KEY).strip()
    if not MIN_KEY <= len(key) <= MAX_KEY:
        raise ValueError(f"{file}: a key of {len(key)} bytes: allowed are {MIN_KEY}..{MAX_KEY}")
    return key


def hasher(key: bytes) -> "hashlib.blake2b":
    """Return a new BLAKE2b hash of DIGEST_BYTES with this key; an empty key means none."""
    return hashlib.blake2b(key=key, digest_size=DIGEST_BYTES)


class SealingFile:
    """A binary file that an MCAP writer writes to, and that digests every byte for its seals, with `key` unless
    empty."""

    def __init__(self, file: BinaryIO, key: bytes) -> None:
        self._file, self._hash = file, hasher(key)
        self._held: bytearray | None = None
        self.digest = ""
        "Digest of the newest seal, hexadecimal; empty before the first."

    def write(self, data: bytes) -> None:
        """Write `data` behind what was written, and digest it; while `finish` holds the file's end back, keep it."""
        if self._held is None:
            self._file.write(data)
            self._hash.update(data)
        else:
            self._held += data

    def tell(self) -> int:
        """Return the number of bytes written so far."""
        return self._file.tell() + len(self._held or b"")

    def flush(self) -> None:
        """Hand all buffered bytes to the operating system."""
        self._file.flush()

    def seal(self, *, is_last: bool = False) -> bytes:
        """Write a seal of all bytes before it, keep its digest in `digest`, and return the whole record's bytes."""
        digest = _digest(self._hash, is_last)
        body = _BODY.pack(is_last, digest)
        record = Record(SEAL, 0, body).head + body
        self.write(record)
        self.digest = digest.hex()
        return record

    def finish(self, mcap: Writer) -> None:
        """Finish the file that `mcap` writes here: summary, last seal, then a footer whose CRC covers both."""
        mcap.flush()  # type: ignore[no-untyped-call]
        self._held = bytearray()
        mcap.finish()  # type: ignore[no-untyped-call]
        ended, self._held = bytes(self._held), None
        ended, footer = ended[: -_FOOTER_BYTES - len(MAGIC)], ended[-_FOOTER_BYTES - len(MAGIC) :][: _FOOTER_BYTES - 4]
        self.write(ended)
        data_end = HEAD.size + 4
        covered = ended[data_end:] + self.seal(is_last=True) + footer
        self.write(footer + struct.pack("<I", zlib.crc32(covered)) + MAGIC)
        self.flush()


class State(StrEnum):
    """What a file's seals say of it."""

    WHOLE = "whole"
    UNFINISHED = "unsealed at its end"
    ALTERED = "altered or damaged"
    UNSEALED = "without seals"
    OTHER_KEY = "sealed with a key that is not here"
    NO_KEY = "sealed without the key that is configured"


class Verdict(NamedTuple):
    """What a file's seals say: `why` is for a person, `follows` the previous segment's last digest, `last` its own."""

    state: State
    why: str
    follows: str = ""
    last: str = ""

    @property
    def is_sound(self) -> bool:
        return self.state not in (State.ALTERED, State.OTHER_KEY, State.NO_KEY)

    def text(self) -> str:
        """Return state and reason in one sentence."""
        return f"{self.state}: {self.why}"


def verified(path: Path, key: bytes = b"") -> Verdict:
    """Check the seals of the file in `path`, all of which is read, and return the verdict."""
    with path.open("rb") as file:
        found = _Check(key)
        try:
            for record in records(file):
                found.take(record)
        except (ValueError, McapError, struct.error) as error:
            return found.broken(str(error))
        size = file.seek(0, 2)
        file.seek(max(0, size - len(MAGIC)))
        return found.verdict(size, ends=file.read() == MAGIC)


class _Check:
    """Checks one file's seals, record by record."""

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._hash: hashlib.blake2b | None = None
        self._head = bytearray(MAGIC)
        self._by = self._follows = self._last = ""
        self._seals = self._sealed_to = 0
        self._summary_at = self._offsets_at = self._crc = 0
        self._is_last = self._is_over = False
        self._odd = ""

    def take(self, record: Record) -> None:
        """Check the next record in the file's order, and note what is not as it was sealed."""
        if record.opcode == END:
            self._is_over = True
        elif record.opcode == SEAL:
            self._compare(record)
        elif record.opcode == Opcode.FOOTER:
            self._end(record)
        elif self._is_last:
            self._note("something follows its last seal", record.at)
        self._digest(record)

    def _digest(self, record: Record) -> None:
        """Add a record to the hash, or while there is none, to the bytes that the hash will begin with."""
        if self._hash is not None:
            self._hash.update(record.head)  # apart: a chunk is a megabyte, and joining would copy it
            self._hash.update(record.body)
        else:
            self._head += record.head + record.body
            if record.opcode == Opcode.METADATA and not self._by:
                self._begin(record)
            if record.opcode not in (Opcode.HEADER, Opcode.METADATA):
                self._head.clear()  # there is more than a beginning, and it does not say that it is sealed
        if self._summary_at and record.opcode != Opcode.FOOTER:
            self._crc = zlib.crc32(record.body, zlib.crc32(record.head, self._crc))
        if record.opcode == Opcode.SUMMARY_OFFSET and not self._offsets_at:
            self._offsets_at = record.at
        if record.opcode == Opcode.DATA_END:
            self._summary_at = record.at + HEAD.size + len(record.body)

    def _begin(self, record: Record) -> None:
        """Begin the hash with all bytes so far, where this metadata record says that the file is sealed."""
        known = record.read(Metadata)
        if known.name == SEALED:
            self._by, self._follows = known.metadata.get("by", "?"), known.metadata.get("follows", "")
            if self._by not in (PLAIN, KEYED):
                self._note("it says of its seals what no tormagd says", record.at)
            self._hash = hasher(self._key if self._by == KEYED else b"")
            self._hash.update(self._head)

    def _compare(self, record: Record) -> None:
        """Compare a seal with the digest of the bytes before it, and keep it as the newest."""
        self._seals += 1
        if self._hash is None or len(record.body) != _BODY.size:
            self._note("a seal where none can be", record.at)
            return
        is_last, digest = _BODY.unpack(record.body)
        if self._is_last or digest != _digest(self._hash, is_last == 1) or is_last > 1:
            self._note(f"the bytes {self._sealed_to} to {record.at} are not those that were sealed", record.at)
        self._is_last, self._last = is_last == 1, digest.hex()
        self._sealed_to = record.at + HEAD.size + len(record.body)

    def _end(self, record: Record) -> None:
        """Compare a footer with the summary before it, and note one whose offsets, CRC or size do not fit."""
        footer = Footer.read(ReadDataStream(BytesIO(record.body)))
        own = zlib.crc32((record.head + record.body)[: _FOOTER_BYTES - 4], self._crc)
        told = (footer.summary_start, footer.summary_offset_start, footer.summary_crc)
        if told != (self._summary_at, self._offsets_at, own) or len(record.body) != _FOOTER_BYTES - HEAD.size:
            self._note("its footer does not fit what it ends", record.at)

    def _note(self, what: str, at: int) -> None:
        self._odd = self._odd or f"{what} (byte {at})"

    def broken(self, why: str) -> Verdict:
        return Verdict(State.ALTERED, self._odd or why, self._follows, self._last)

    def verdict(self, size: int, *, ends: bool) -> Verdict:
        """Return the verdict on a file of `size` bytes; `ends` says whether its last bytes are MCAP's closing magic."""
        if not self._by and not self._seals and (self._is_over or not self._head):
            why = "nothing says whether it was changed: an older tormagd, or another program, wrote it"
            return Verdict(State.NO_KEY if self._key else State.UNSEALED, why)
        if self._by == KEYED and not self._key:
            return Verdict(State.OTHER_KEY, f"it was not checked; {KEY_HINT}", self._follows)
        unsealed = size - self._sealed_to
        if not self._odd and not self._is_over and (ends or unsealed > 2 * MAX_CHUNK_BYTES):
            self._note("a record reaches beyond the end", self._sealed_to)
        if not self._odd and self._is_over and not self._is_last:
            self._note("its last seal is missing", size)
        if self._odd:
            return Verdict(State.ALTERED, self._odd, self._follows, self._last)
        if self._key and self._by == PLAIN:
            return Verdict(State.NO_KEY, "anybody could have sealed it anew", self._follows, self._last)
        if not self._is_over:
            why = f"its first {self._sealed_to} bytes are as they were written; its recorder did not end it"
            return Verdict(State.UNFINISHED, why, self._follows, self._last)
        return Verdict(State.WHOLE, f"all {size} bytes are as they were written", self._follows, self._last)


def _digest(known: "hashlib.blake2b", is_last: bool) -> bytes:
    """Return the digest of all bytes so far, and of whether the seal is the last."""
    here = known.copy()
    here.update(b"\1" if is_last else b"\0")
    return here.digest()
