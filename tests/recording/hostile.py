"""Files that somebody made to hurt whoever reads them: each small, and each meant to cost what it does not hold."""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path

import msgpack
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
)  # fmt: skip
from mcap.writer import MCAP0_MAGIC as MAGIC, Writer

from tormagd.record.writer import OVERVIEW

NESTED = b"[" * 100_000 + b"]" * 100_000


def written(fill: Callable[[Writer], None]) -> bytes:
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    fill(writer)
    writer.finish()
    return file.getvalue()


def messages(*data: bytes, topic: str = "/ticks", t_ns: int = 1, encoding: str = "json", **metadata) -> bytes:
    def fill(writer: Writer) -> None:
        for name, known in metadata.items():
            writer.add_metadata({"header": "black_box", "about": "tormagd"}[name], known)
        channel = writer.register_channel(topic=topic, message_encoding=encoding, schema_id=0)
        for each in data:
            writer.add_message(channel, log_time=t_ns, data=each, publish_time=t_ns)

    return written(fill)


def record(*things) -> bytes:
    builder = RecordBuilder()
    for thing in things:
        thing.write(builder)
    return bytes(builder.end())


def chunk(data: bytes, size: int) -> bytes:
    return MAGIC + record(Channel(1, "/ticks", "json", {}, 0), Chunk("zstd", data, 1, 1, 0, size))


def ended(body: bytes, *summary, at: int | None = None) -> bytes:
    data = MAGIC + body
    return data + record(*summary, Footer(len(data) if at is None else at, 0, 0)) + MAGIC


MANY = 220_000_000
CHANNEL = record(Channel(1, "/ticks", "json", {}, 0))
FILES: dict[str, Callable[[], bytes]] = {
    "nothing": bytes,
    "words": lambda: b"not a recording at all",
    "a beginning alone": lambda: MAGIC,
    "a message of brackets": lambda: messages(NESTED),
    "a small message of brackets": lambda: messages(b'{"a":' * 120 + b"1" + b"}" * 120),
    "a schema of brackets": lambda: written(
        lambda w: (w.register_channel("/ticks", "json", w.register_schema("x", "jsonschema", NESTED)), None)[1]
    ),
    "metadata of brackets": lambda: messages(b"{}", about={"scene": NESTED.decode(), "portrait": NESTED.decode()}),
    "a chunk that unpacks to 220 MB": lambda: chunk(zstandard.compress(bytes(MANY)), MANY),
    "a chunk that unpacks to more than it says": lambda: chunk(zstandard.compress(bytes(MANY)), 1_000),
    "a thousand damaged chunks of 7.9 MB": lambda: (
        MAGIC + CHANNEL + record(Chunk("zstd", zstandard.compress(bytes(7_900_000)), 1, 1, 7, 7_900_000)) * 1_000
    ),
    "a chunk with a huge window": lambda: chunk(
        zstandard.ZstdCompressor(compression_params=zstandard.ZstdCompressionParameters(window_log=27)).compress(
            bytes(MANY)
        ),
        15_000_000,
    ),
    "a chunk that says less than nothing": lambda: chunk(b"", 2**63),
    "ever new columns": lambda: messages(*(b'{"c%d":1}' % number for number in range(40_000))),
    "a million columns at once": lambda: messages(json.dumps(dict.fromkeys(map(str, range(400_000)), 1)).encode()),
    "a list of a million": lambda: messages(b'{"limits":[' + b",".join([b'"A"'] * 1_000_000) + b"]}"),
    "a word of 7 MB": lambda: messages(b'{"operating_state":"' + b"A" * 7_000_000 + b'"}'),
    "a number beyond all": lambda: messages(b'{"setpoint_cf":1' + b"0" * 400 + b"}"),
    "a time beyond all": lambda: messages(b"{}", t_ns=2**64 - 1),
    "a record of 2^63 bytes": lambda: MAGIC + struct.pack("<BQ", Opcode.CHUNK, 2**63) + b"x",
    "records of no kind": lambda: MAGIC + b"\0" * 20_000_000,
    "70,000 channels": lambda: MAGIC + record(*(Channel(n % 65_536, f"/{n}", "json", {}, 0) for n in range(70_000))),
    "70,000 schemas in a chunk": lambda: chunk(
        zstandard.compress(s := record(*(Schema(n % 65_000, b"{}", "jsonschema", "x") for n in range(70_000)))), len(s)
    ),
    "metadata of 20 MB": lambda: (
        MAGIC
        + struct.pack("<BQI7sI", Opcode.METADATA, 22_400_015, 7, b"tormagd", 22_400_000)
        + b"".join(map(b"\7\0\0\0%07d\1\0\0\0x".__mod__, range(1_400_000)))
    ),
    "an index that points into itself": lambda: ended(
        CHANNEL,
        Channel(1, "/ticks", "json", {}, 0),
        AttachmentIndex(8, 9, 0, 0, 1, OVERVIEW, "x"),
        ChunkIndex(9, 8, "", 1, 9, 0, {}, 0, 9),
    ),
    "an index that names one chunk a thousand times": lambda: ended(
        CHANNEL
        + record(Chunk("zstd", zstandard.compress(s := record(Schema(1, bytes(7_000_000), "", ""))), 1, 1, 0, len(s))),
        *[ChunkIndex(9, 8 + len(CHANNEL), "", 1, 9, 0, {}, 0, 9)] * 1_000,
    ),
    "an index that names the same metadata fifty times": lambda: ended(
        record(told := Metadata("tormagd", {"scene": "x" * 7_000_000})),
        *[MetadataIndex(8, len(record(told)), "tormagd")] * 50,
    ),
    "a summary of 30 MB": lambda: ended(
        CHANNEL, *[ChunkIndex(9, 8, "", 1, 9, 0, {n: 2**40 + n for n in range(65_000)}, 0, 9)] * 46
    ),
    "magic alone": lambda: MAGIC + MAGIC,
    "a footer without a summary": lambda: ended(CHANNEL, at=0),
    "a summary beyond all": lambda: ended(CHANNEL, at=2**63 - 1),
    "an overview of rubbish": lambda: ended(
        record(Attachment(0, 0, OVERVIEW, "x", b"\xdd\xff\xff\xff\xff" * 1_000)),
        AttachmentIndex(8, 9, 0, 0, 1, OVERVIEW, "x"),
    ),
    "a summary that is the file": lambda: ended(CHANNEL * 3, at=8),
    "a message without a chunk, too short": lambda: MAGIC + CHANNEL + struct.pack("<BQ", Opcode.MESSAGE, 3) + b"abc",
    "a chunk within a chunk": lambda: chunk(zstandard.compress(s := record(Chunk("", b"x" * 99, 1, 1, 0, 99))), len(s)),
    "another compression": lambda: MAGIC + record(Chunk("lz4", b"x", 1, 1, 0, 9)),
}
BOXES: dict[str, Callable[[], bytes]] = {
    "entries of brackets": lambda: messages(
        b"\x91" * 100_000 + b"\xc0", topic="/core", encoding="msgpack", header={"format": ""}
    ),
    "an array that says 2^32": lambda: messages(
        b"\xdd\xff\xff\xff\xff", topic="/core", encoding="msgpack", header={"format": ""}
    ),
    "a hundred million entries": lambda: messages(
        *[b"\xdd" + struct.pack(">I", 6_000_000) + b"\xc0" * 6_000_000] * 12,
        topic="/core",
        encoding="msgpack",
        header={"format": ""},
    ),
    "columns of brackets": lambda: messages(
        msgpack.packb(["step"]), topic="/core", encoding="msgpack", header={"format": "", "columns": "[" * 200_000}
    ),
    "columns that are a number": lambda: messages(
        msgpack.packb(["step"]), topic="/core", encoding="msgpack", header={"format": "", "columns": "5"}
    ),
    "no header, and a long recording": lambda: messages(*[b"{}"] * 10_000),
}


def write(folder: Path) -> list[tuple[str, Path]]:
    made = []
    for kind, files in (("recording", FILES), ("black box", BOXES)):
        for number, (name, make) in enumerate(files.items()):
            path = folder / f"{kind.replace(' ', '_')}_{number}.mcap"
            path.write_bytes(make())
            made.append((f"{kind}: {name}", path))
    return made
