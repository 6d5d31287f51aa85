"""Closing a recording in order that could not be written to its end: what is whole stays, and gets its index.

A disk that is full has no room for an index. It gets the room of the last chunks: a file that every MCAP reader opens
is worth their few seconds.
"""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

ABOUT = "tormagd"
"The metadata records that say what is recorded."
CUT = "cut_by"
"Among them: why a recording ends before its end."
_FOOTER = struct.Struct("<BQQQ")
_FOOTER_BYTES = 20


class _Whole(NamedTuple):
    """A chunk with its message indexes: where both end, how the index lists it, and its messages by channel."""

    end: int
    entry: ChunkIndex
    messages: Counter[int]


def close_cut(path: Path, schemas: Sequence[Schema], channels: Sequence[Channel], about: dict[str, str]) -> None:
    """Close the recording in `path`, whose end is missing, with `about` why and an index in place of what is not whole.

    Raises OSError where not even that can be written; the file is then as it was, up to its last whole chunk.
    """
    with path.open("rb") as file:
        start, metadata, whole = _read(file)
    # without a buffer: what the disk has refused must not be written later
    with path.open("r+b", buffering=0) as raw:
        while True:
            end = whole[-1].end if whole else start
            kept = [each for each in metadata if each.offset < end]
            left = memoryview(_ending(end, schemas, channels, kept, whole, about))
            try:
                raw.seek(end)
                raw.truncate()
                while left:
                    left = left[raw.write(left) :]
                os.fsync(raw.fileno())
            except OSError:
                raw.truncate(end)
                if not whole:
                    raise
                whole.pop()
            else:
                return


def _read(file: BinaryIO) -> tuple[int, list[MetadataIndex], list[_Whole]]:
    """Where the first chunk begins, where metadata are, and the chunks that are there with all of their indexes."""
    metadata: list[MetadataIndex] = []
    whole: list[_Whole] = []
    newest: Chunk | None = None
    start = before = file.tell()
    try:
        for record in StreamReader(file, emit_chunks=True).records:
            here = file.tell()
            if isinstance(record, Metadata):
                metadata.append(MetadataIndex(before, here - before, record.name))
            elif isinstance(record, Chunk):
                newest = record
                entry = ChunkIndex(
                    chunk_length=here - before,
                    chunk_start_offset=before,
                    compression=record.compression,
                    compressed_size=len(record.data),
                    message_end_time=record.message_end_time,
                    message_index_length=0,
                    message_index_offsets={},
                    message_start_time=record.message_start_time,
                    uncompressed_size=record.uncompressed_size,
                )
                whole.append(_Whole(here, entry, Counter()))
            elif isinstance(record, MessageIndex) and whole:
                last = whole.pop()
                last.entry.message_index_offsets[record.channel_id] = before
                last.entry.message_index_length += here - before
                last.messages[record.channel_id] = len(record.records)
                whole.append(last._replace(end=here))
            elif isinstance(record, DataEnd):
                break
            if not whole:
                start = here
            before = here
    except (McapError, struct.error, UnicodeDecodeError):
        pass  # here it was cut
    # a chunk without all of its message indexes: readers that use them would not find all that is in it
    if newest is not None and whole[-1].messages.total() != sum(
        isinstance(it, Message) for it in breakup_chunk(newest)
    ):
        whole.pop()
    return start, metadata, whole


def _ending(
    start: int,
    schemas: Sequence[Schema],
    channels: Sequence[Channel],
    metadata: Sequence[MetadataIndex],
    whole: Sequence[_Whole],
    about: dict[str, str],
) -> bytes:
    """What stands behind the last chunk, which ends at `start`: why, end of the data, summary, and where to find it."""
    data = RecordBuilder()
    Metadata(ABOUT, about).write(data)
    reason = MetadataIndex(start, data.count, ABOUT)
    DataEnd(0).write(data)
    summary_start = start + data.count
    messages: Counter[int] = sum((each.messages for each in whole), Counter())
    statistics = Statistics(
        attachment_count=0,
        channel_count=len(channels),
        channel_message_counts=dict(messages),
        chunk_count=len(whole),
        message_count=messages.total(),
        message_end_time=max((each.entry.message_end_time for each in whole), default=0),
        message_start_time=min((each.entry.message_start_time for each in whole), default=0),
        metadata_count=len(metadata) + 1,
        schema_count=len(schemas),
    )
    summary: RecordBuilder = RecordBuilder()
    offsets = []
    for opcode, records in (
        (Opcode.SCHEMA, schemas),
        (Opcode.CHANNEL, channels),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, [each.entry for each in whole]),
        (Opcode.METADATA_INDEX, [*metadata, reason]),
    ):
        group_start = summary.count
        for record in records:
            record.write(summary)
        offsets.append(SummaryOffset(opcode, summary_start + group_start, summary.count - group_start))
    offsets_start = summary_start + summary.count
    for offset in offsets:
        offset.write(summary)
    written = _bytes(summary)
    crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, summary_start, offsets_start), zlib.crc32(written))
    footer = RecordBuilder()
    Footer(summary_start, offsets_start, crc).write(footer)
    return _bytes(data) + written + _bytes(footer) + MCAP0_MAGIC


def _bytes(builder: RecordBuilder) -> bytes:
    return bytes(builder.end())  # type: ignore[no-untyped-call]
