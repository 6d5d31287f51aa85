"""The black box's file, and every recording that may be run again: the entries of `/core`, exact to the bit.

Each message of `/core` is one part that the daemon handed over. The metadata say which core it was. `tormagctl replay`
runs such a file, and compares what people see, `/ticks` and `/frames`, with what `/core` gives.
"""

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
from mcap.records import Message

from tormagd.ground.files import in_place_of
from tormagd.record.journal import MISSING, TOLD
from tormagd.record.reader import Contents, RecordingError, damage_in, opened, scan
from tormagd.record.writer import (
    CORE_TOPIC,
    FRAMES_TOPIC,
    NUMBER_COLUMN,
    TICKS_TOPIC,
    Derived,
    RecordingWriter,
    is_tick,
)
from tormagd_client.messages import Telemetry

MAX_BYTES, MAX_ENTRIES = 50_000_000, 1_000_000
"Bounds on what is read of one file, a minute of 1 kHz; what comes after is passed over."
NO_BLACK_BOX = f"no black box of tormagd: it has nothing in {CORE_TOPIC}, or not what a replay needs"


class BlackBoxFile(msgspec.Struct, frozen=True):
    """One black box as read: its header, and the entries of all parts in their order, as plain data."""

    header: dict[str, str]
    entries: list[Any]
    is_complete: bool = True
    "False for a file that was cut short, or is longer than what is read: entries up to there are there."
    odd: str = ""
    """The first message of `/ticks` or `/frames` that `/core` does not give, or why an entry of `/core` gives none."""


def write_black_box(path: Path, header: dict[str, str], parts: Iterable[bytes]) -> None:
    """Write a new black box of these entries, whole or not at all."""
    if path.exists():
        raise FileExistsError(17, "exists", str(path))
    columns = msgspec.json.decode(header["columns"], type=tuple[str, ...])
    with in_place_of(path) as beside, RecordingWriter(beside, header) as writer:
        for part in parts:
            entries = msgspec.msgpack.decode(part, type=list[Any])
            writer.entries(columns, entries, part)
            for told in (each for each in entries if isinstance(each, list) and each[:1] == [TOLD]):
                writer.telemetry(msgspec.convert(told[1], Telemetry))


def read_black_box(path: Path) -> BlackBoxFile:
    """Read the black box in `path`; one that was cut short is returned as far as it reads, with `is_complete` False."""
    found = _Reading(str(path))
    with opened(path) as file:
        is_complete = scan(file, str(path), found) and not found.is_over
        damage = damage_in(file)
    if not found.entries:
        raise RecordingError(f"{path}: {NO_BLACK_BOX}")
    for topic, expected in found.expected.items() if is_complete else ():
        if expected and not found.odd:
            found.odd = f"message {expected[0][0]} is missing in {topic}, and {CORE_TOPIC} has it"
    return BlackBoxFile(found.metadata, found.entries, is_complete, found.odd or damage)


class _Reading(Contents):
    """A black box while it is read: each message of `/ticks` and `/frames` is compared with what `/core` gives."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._name = name
        self.entries: list[Any] = []
        self.expected: dict[str, deque[tuple[int, int, bytes]]] = {TICKS_TOPIC: deque(), FRAMES_TOPIC: deque()}
        self.odd, self.is_over = "", False
        self._derived = Derived()
        self._size = 0
        self._tick: int | None = None

    def message(self, sent: Message) -> None:
        """Keep the entries in a message of `/core`, or compare one that is derived with them, or pass it over."""
        if "format" not in self.metadata:
            raise RecordingError(f"{self._name}: {NO_BLACK_BOX}")  # before all of a long recording has been read
        topic = self.topics.get(sent.channel_id, "")
        if topic == CORE_TOPIC and not self.is_over:
            self._part(sent.data)
        elif topic in self.expected and not (self.odd or self.is_over):
            expected = self.expected[topic]
            if not expected or (sent.sequence, sent.log_time, sent.data) != expected.popleft():
                self.odd = f"message {sent.sequence} in {topic} is not what {CORE_TOPIC} has"

    def lose(self, what: str) -> None:
        """Note that entries are missing; what is derived from them is compared no more."""
        super().lose(what)
        self.entries.append([MISSING])
        self.expected.clear()

    def _part(self, data: bytes) -> None:
        entries, self._size = msgspec.msgpack.decode(data, type=list[Any]), self._size + len(data)
        self.is_over = self._size > MAX_BYTES or len(self.entries) + len(entries) > MAX_ENTRIES
        if self.is_over:
            return
        columns = msgspec.json.decode(self.metadata.get("columns", "[]"), type=tuple[str, ...])
        self._join(columns, entries)
        self.entries.extend(entries)
        try:
            for topic, t_ns, number, shown in self._derived.of(columns, entries) if self.expected else ():
                self.expected[topic].append((number, t_ns, msgspec.json.encode(shown)))
        except (ValueError, TypeError, AttributeError, OverflowError, LookupError) as error:
            self.odd = self.odd or f"{CORE_TOPIC}: {str(error)[:100]}"

    def _join(self, columns: tuple[str, ...], entries: list[Any]) -> None:
        """Note that entries are missing before these, which were lost on the way or are another daemon's."""
        ticks = [dict(zip(columns, each, strict=False)) for each in entries if is_tick(each)]
        numbers = [number for each in ticks if isinstance(number := each.get(NUMBER_COLUMN), int)]
        if numbers and self._tick is not None and not self._tick <= numbers[0] <= self._tick + 1:
            self.entries.append([MISSING])
        self._tick = numbers[-1] if numbers else self._tick
