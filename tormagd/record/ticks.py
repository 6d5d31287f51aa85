"""The recording endpoint's message: control ticks, one row each, and all that running the core again needs."""

from collections.abc import Sequence
from typing import TypeAlias

import msgspec

from tormagd.record.stream import COLUMNS, TIME_COLUMN
from tormagd_client.messages import VERSION, MessageError
from tormagd_client.printable import require

MAX_BATCH_BYTES = 4_000_000  # 10 ticks with a snapshot of the core are under 0.1 MB
MAX_COLUMNS = 256
MAX_TIME_NS = 2**63
Value: TypeAlias = int | float | bool | str | tuple[str, ...] | None


class TickBatch(msgspec.Struct, frozen=True, kw_only=True):
    """Control ticks as rows. The first column is `t_ns`, CLOCK_REALTIME; None is not known. `core` has the journal's
    entries, or nothing."""

    v: int
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    core: bytes = b""

    def __post_init__(self) -> None:
        require(self.v == VERSION, "v", self.v, f"{VERSION}")
        is_known = 0 < len(self.columns) <= MAX_COLUMNS and self.columns[0] == TIME_COLUMN
        require(is_known, "columns", self.columns[:4], f"1..{MAX_COLUMNS} names, {TIME_COLUMN} first")
        require(len(set(self.columns)) == len(self.columns), "columns", self.columns, "each name once")
        for number, row in enumerate(self.rows):
            require(len(row) == len(self.columns), f"rows[{number}]", len(row), f"{len(self.columns)} values")
            is_time = type(row[0]) is int and 0 <= row[0] < MAX_TIME_NS
            require(is_time, f"rows[{number}].{TIME_COLUMN}", row[0], "0..2^63-1 ns since 1970")


_ENCODER, _DECODER = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(TickBatch)


def encode_ticks(rows: Sequence[object], columns: tuple[str, ...] = COLUMNS, core: bytes = b"") -> bytes:
    """Return the recording endpoint's message."""
    return _ENCODER.encode({"v": VERSION, "columns": columns, "rows": rows, "core": core})


def decode_ticks(data: bytes) -> TickBatch:
    try:
        return _DECODER.decode(data)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError(f"tick batch: {error}") from error
