"""Valid traffic and damage to it, many frames at once: rows of bytes in, rows of bytes out.

Random steps of random messages are packed and sealed here a second time, from the layouts alone, because ten million
frames one by one would take the afternoon. A test holds it equal to `codec.encode` and `framing.encode_frame`.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.codec import (
    FUNCTION,
    Clear,
    Drive,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    crc8,
)
from firmware_protocol.framing import CRC_FINAL_XOR, CRC_INITIAL
from firmware_protocol.layouts import LAYOUTS
from firmware_protocol.schema import Layout, Signal

Bytes = npt.NDArray[np.uint8]
Counts = npt.NDArray[np.int64]

WIDTH = 64
"""Room for a row: three frames and an insertion, or a CAN FD payload."""
EDGES = 0.3
"""Share of signals at zero or at an end of their range: zeros are what COBS is about."""

# from register ^ byte to the next register; the initial 0xFF and the final XOR of crc8 are taken out
_CRC8_STEP = np.array([crc8(bytes((index ^ 0xFF,))) ^ 0xFF for index in range(256)], dtype=np.uint8)
_CRC16_STEP = np.array([crc_hqx(bytes((byte,)), 0) for byte in range(256)], dtype=np.uint16)


class Rows(NamedTuple):
    """Ragged bytes: row i is `data[i, :length[i]]`; data has shape (rows, WIDTH), and zeros behind each row's end."""

    data: Bytes
    length: Counts


class Messages(NamedTuple):
    """Payloads with their functions, shape (rows,)."""

    function: Bytes
    payload: Rows


class Direction(NamedTuple):
    """Who hears what. `anchor` is a message with a 32-bit number in it, by which a clean frame is known again."""

    receiver: str
    messages: tuple[type[Message], ...]
    protected: type[Message]
    ranged: type[Message]
    anchor: type[Message]


TO_DEVICE = Direction("device", (Drive, Retract, Clear, Home, Hello), Drive, Drive, Hello)
TO_HOST = Direction("host", (State, Sense, Status, Identity), State, Status, Identity)


# -- valid traffic -------------------------------------------------------------------------------------------------


def draw(rng: np.random.Generator, kinds: Sequence[type[Message]], rows: int) -> Messages:
    """Valid messages of those kinds, each as often as the others, with random steps."""
    choice = rng.integers(0, len(kinds), rows)
    function = np.zeros(rows, dtype=np.uint8)
    data, length = np.zeros((rows, WIDTH), dtype=np.uint8), np.zeros(rows, dtype=np.int64)
    for index, kind in enumerate(kinds):
        layout = layout_of(kind)
        chosen = np.flatnonzero(choice == index)
        function[chosen] = layout.function
        length[chosen] = struct.calcsize(layout.format)
        for signal, (offset, size) in zip(layout.signals, offsets(layout), strict=False):  # the CRC stays over
            _put(data, chosen, offset, size, _steps(rng, signal, len(chosen)))
    return protect(Messages(function, Rows(data, length)))


def anchors(kind: type[Message], numbers: Counts) -> Messages:
    """Valid messages whose first signal, 32 bits, is the number."""
    layout = layout_of(kind)
    rows = len(numbers)
    data = np.zeros((rows, WIDTH), dtype=np.uint8)
    _put(data, np.arange(rows), 0, 4, numbers)
    length = np.full(rows, struct.calcsize(layout.format), dtype=np.int64)
    return Messages(np.full(rows, layout.function, dtype=np.uint8), Rows(data, length))


def layout_of(kind: type[Message]) -> Layout:
    """The layout of a message."""
    return next(layout for layout in LAYOUTS if layout.message is kind)


def offsets(layout: Layout) -> list[tuple[int, int]]:
    """(offset, bytes) of each number in a payload."""
    sizes = [struct.calcsize("<" + code) for code in layout.format[1:]]
    return [(sum(sizes[:index]), size) for index, size in enumerate(sizes)]


def _steps(rng: np.random.Generator, signal: Signal, rows: int) -> Counts:
    steps = rng.integers(signal.lowest, signal.highest, rows, endpoint=True)
    ends = np.array([signal.lowest, max(signal.lowest, 0), signal.highest])
    return np.where(rng.random(rows) < EDGES, rng.choice(ends, rows), steps)


def _put(data: Bytes, rows: Counts, offset: int, size: int, steps: Counts) -> None:
    for byte in range(size):
        data[rows, offset + byte] = (steps >> (8 * byte)) & 0xFF


def protect(messages: Messages) -> Messages:
    """The same with the right CRC-8 in the protected messages."""
    function, (data, length) = messages
    data = data.copy()
    for layout in LAYOUTS:
        if layout.protected:
            last = struct.calcsize(layout.format) - 1
            rows = np.flatnonzero((function == layout.function) & (length == last + 1))
            register = _CRC8_STEP[function[rows] ^ 0xFF]
            for column in range(last):
                register = _CRC8_STEP[register ^ data[rows, column]]
            data[rows, last] = register ^ 0xFF
    return Messages(function, Rows(data, length))


def bodies(messages: Messages, sequence: Bytes) -> Rows:
    """function | sequence | payload of each row."""
    data = np.zeros_like(messages.payload.data)
    data[:, 0], data[:, 1] = messages.function, sequence
    data[:, 2:] = messages.payload.data[:, :-2]
    return Rows(data, messages.payload.length + 2)


def seal(body: Rows) -> Rows:
    """Each body as a frame with its delimiter: CRC-16, COBS, 00."""
    rows = np.arange(len(body.length))
    register = np.full(len(rows), CRC_INITIAL, dtype=np.uint16)
    for column in range(int(body.length.max(initial=0))):
        updated = (register << 8) ^ _CRC16_STEP[(register >> 8) ^ body.data[:, column]]
        register = np.where(column < body.length, updated, register)
    crc = register ^ CRC_FINAL_XOR
    # a zero in front stands for COBS's first byte, and one behind for the delimiter
    data = np.roll(body.data, 1, axis=1)
    data[rows, body.length + 1], data[rows, body.length + 2] = crc >> 8, crc & 0xFF
    end = body.length + 3
    columns = np.arange(WIDTH)
    zeros = np.where((data == 0) & (columns <= end[:, None]), columns, WIDTH)
    following = np.minimum.accumulate(zeros[:, ::-1], axis=1)[:, ::-1]
    distance = np.roll(following, -1, axis=1) - columns
    encoded = np.where((data == 0) & (columns < end[:, None]), distance, data)
    return Rows(encoded.astype(np.uint8), end + 1)


def flatten(rows: Rows) -> bytes:
    """All rows one behind the other."""
    return rows.data[np.arange(WIDTH) < rows.length[:, None]].tobytes()


def cut_up(rows: Rows) -> list[bytes]:
    """Each row as bytes."""
    flat = flatten(rows)
    ends = np.cumsum(rows.length).tolist()
    return [flat[start:end] for start, end in zip([0, *ends], ends, strict=False)]


# -- damage --------------------------------------------------------------------------------------------------------


def edit(rows: Rows, at: Counts, removed: Counts, inserted: Rows) -> Rows:
    """Each row with `removed` bytes at `at` replaced by those of `inserted`; cut off at WIDTH."""
    columns = np.arange(WIDTH)[None, :]
    behind = (at + inserted.length)[:, None]
    from_row = np.where(columns < behind, columns, columns - inserted.length[:, None] + removed[:, None])
    taken = np.take_along_axis(rows.data, np.clip(from_row, 0, WIDTH - 1), axis=1)
    put = np.take_along_axis(inserted.data, np.clip(columns - at[:, None], 0, WIDTH - 1), axis=1)
    data = np.where((columns >= at[:, None]) & (columns < behind), put, taken)
    length = np.minimum(rows.length - removed + inserted.length, WIDTH)
    return Rows(np.where(columns < length[:, None], data, 0).astype(np.uint8), length)


def noise(rng: np.random.Generator, length: Counts) -> Rows:
    """Random bytes."""
    data = rng.integers(0, 256, (len(length), WIDTH), dtype=np.uint8)
    return Rows(np.where(np.arange(WIDTH) < length[:, None], data, 0).astype(np.uint8), length)


def flip_bits(rng: np.random.Generator, rows: Rows, most: int) -> Rows:
    """1 to `most` different bits of each row flipped."""
    data = rows.data.copy()
    every = np.arange(len(rows.length))
    wanted = rng.integers(1, most, len(every), endpoint=True)
    flipped = np.full((len(every), most), -1, dtype=np.int64)
    for number in range(most):
        bits = rng.integers(0, 8 * rows.length)
        # a bit hit twice would be whole again
        fresh = (number < wanted) & ~(flipped == bits[:, None]).any(axis=1)
        flipped[:, number] = np.where(fresh, bits, -1)
        data[every[fresh], bits[fresh] // 8] ^= (1 << bits[fresh] % 8).astype(np.uint8)
    return Rows(data, rows.length)


def flip_burst(rng: np.random.Generator, rows: Rows, span: int) -> Rows:
    """A burst in each row: its first bit flipped, and any of the next `span` - 1, in the order of a CRC's bits."""
    data = rows.data.copy()
    start = rng.integers(0, 8 * rows.length)
    pattern = rng.integers(0, 2, (len(start), span)).astype(bool)
    pattern[:, 0] = True
    for number in range(span):
        bits = start + number
        hit = np.flatnonzero(pattern[:, number] & (bits < 8 * rows.length))
        data[hit, bits[hit] // 8] ^= (0x80 >> bits[hit] % 8).astype(np.uint8)
    return Rows(data, rows.length)


def _overwritten(rng: np.random.Generator, rows: Rows) -> Rows:
    count = rng.integers(1, rows.length, endpoint=True)
    at = rng.integers(0, rows.length - count, endpoint=True)
    return edit(rows, at, count, noise(rng, count))


def _cut(rng: np.random.Generator, rows: Rows) -> Rows:
    count = rng.integers(1, rows.length, endpoint=True)
    at = rng.integers(0, rows.length - count, endpoint=True)
    return edit(rows, at, count, noise(rng, np.zeros_like(count)))


def _inserted(rng: np.random.Generator, rows: Rows) -> Rows:
    at = rng.integers(0, rows.length, endpoint=True)
    return edit(rows, at, np.zeros_like(at), noise(rng, rng.integers(1, 5, len(at))))


def _zero_more_or_less(rng: np.random.Generator, rows: Rows) -> Rows:
    """Before the delimiter, COBS's 1 taken away where it stands, and put where it does not: the CRC has to find both.

    It does not have to for most frames to the host: they are as long as a frame may be.
    """
    at = rows.length - 2
    present = rows.data[np.arange(len(at)), at] == 1
    one = Rows(np.ones_like(rows.data), np.where(present, 0, 1))
    return edit(rows, np.where(present, at, at + 1), np.where(present, 1, 0), one)


def _delimiters_inserted(rng: np.random.Generator, rows: Rows) -> Rows:
    at = rng.integers(0, rows.length, endpoint=True)
    length = rng.integers(1, 4, len(at))
    return edit(rows, at, np.zeros_like(at), Rows(np.zeros_like(rows.data), length))


def _delimiter_lost(rng: np.random.Generator, rows: Rows) -> Rows:
    return Rows(rows.data, rows.length - 1)


def _spliced(rng: np.random.Generator, rows: Rows) -> Rows:
    """The head of one frame and the tail of another."""
    other = np.roll(np.arange(len(rows.length)), 1)
    at = rng.integers(1, rows.length)
    start = rng.integers(1, rows.length[other])
    columns = np.clip(np.arange(WIDTH) + start[:, None], 0, WIDTH - 1)
    tail = Rows(np.take_along_axis(rows.data[other], columns, axis=1), rows.length[other] - start)
    return edit(rows, at, rows.length - at, tail)


def _repeated(rng: np.random.Generator, rows: Rows) -> Rows:
    once = edit(rows, rows.length, np.zeros_like(rows.length), rows)
    twice = edit(once, once.length, np.zeros_like(rows.length), rows)
    three = rng.random(len(rows.length)) < 0.5
    return Rows(np.where(three[:, None], twice.data, once.data), np.where(three, twice.length, once.length))


def _only_noise(rng: np.random.Generator, rows: Rows) -> Rows:
    return noise(rng, rng.integers(1, 41, len(rows.length)))


WireDamage = Callable[[np.random.Generator, Rows], Rows]
WIRE_DAMAGE: dict[str, WireDamage] = {
    "1 to 3 bits flipped": lambda rng, rows: flip_bits(rng, rows, 3),
    "burst of up to 16 bits": lambda rng, rows: flip_burst(rng, rows, 16),
    "bytes overwritten": _overwritten,
    "bytes cut out": _cut,
    "bytes inserted": _inserted,
    "a zero more or less at the end": _zero_more_or_less,
    "delimiters inserted": _delimiters_inserted,
    "delimiter lost": _delimiter_lost,
    "two frames spliced": _spliced,
    "frame repeated": _repeated,
    "noise": _only_noise,
}
"""What a line does to sealed frames. None of these should give a frame that was not sent."""


def _other_length(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    messages = draw(rng, direction.messages, rows)
    right = messages.payload.length
    length = rng.integers(0, longest, rows)
    length += length >= right  # every length but the right one
    data = np.where(np.arange(WIDTH) < np.minimum(length, right)[:, None], messages.payload.data, 0)
    extra = noise(rng, length).data
    data = np.where((np.arange(WIDTH) >= right[:, None]) & (np.arange(WIDTH) < length[:, None]), extra, data)
    return Messages(messages.function, Rows(data.astype(np.uint8), length))


def _out_of_range(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    messages = draw(rng, (direction.ranged,), rows)
    layout = layout_of(direction.ranged)
    numbers = list(zip(layout.signals, offsets(layout), layout.format[1:], strict=False))
    data = messages.payload.data
    # of the signals whose type holds more than their range does
    ranged = [(s, o, n, c) for s, (o, n), c in numbers if s.highest - s.lowest + 1 < 256**n]
    choice = rng.integers(0, len(ranged), rows)
    for index, (signal, offset, size, code) in enumerate(ranged):
        chosen = np.flatnonzero(choice == index)
        lowest = -(256**size) // 2 if code.islower() else 0
        # every step of the type but those of the range
        span = 256**size - (signal.highest - signal.lowest + 1)
        steps = rng.integers(0, span, len(chosen)) + lowest
        steps += (steps >= signal.lowest) * (signal.highest - signal.lowest + 1)
        _put(data, chosen, offset, size, steps)
    return protect(messages)


def _unknown_function(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    messages = draw(rng, direction.messages, rows)
    unknown = np.array(sorted(set(range(128)) - set(FUNCTION.values())), dtype=np.uint8)  # those that CAN can name too
    return Messages(rng.choice(unknown, rows), messages.payload)


def _few_bits(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    messages = draw(rng, (direction.protected,), rows)
    return Messages(messages.function, flip_bits(rng, messages.payload, 2))


def _short_burst(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    messages = draw(rng, (direction.protected,), rows)
    return Messages(messages.function, flip_burst(rng, messages.payload, 8))


def _fields_of_another(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    """All in range, but the CRC-8 belongs to a Drive or State with another counter and other values."""
    messages = draw(rng, (direction.protected,), rows)
    data, length = draw(rng, (direction.protected,), rows).payload
    every, last = np.arange(rows), messages.payload.length - 1
    data[every, last] = messages.payload.data[every, last]
    counter = messages.payload.data[every, last - 1]
    data[every, last - 1] = counter + rng.integers(1, 256, rows, dtype=np.uint8)
    return Messages(messages.function, Rows(data, length))


def _random_payload(rng: np.random.Generator, direction: Direction, rows: int, longest: int) -> Messages:
    messages = draw(rng, (direction.protected,), rows)
    return Messages(messages.function, noise(rng, messages.payload.length))


def stuck_counters(rng: np.random.Generator, direction: Direction, pairs: int) -> Messages:
    """Good messages two by two: the first with the next counter, the second with the same one and other values."""
    messages = draw(rng, (direction.protected,), 2 * pairs)
    messages.payload.data[np.arange(2 * pairs), messages.payload.length - 2] = np.arange(2 * pairs) // 2 % 256
    return protect(messages)


PayloadDamage = Callable[[np.random.Generator, Direction, int, int], Messages]
PAYLOAD_DAMAGE: dict[str, tuple[PayloadDamage, float]] = {
    "CRC-8: 1 or 2 bits flipped": (_few_bits, 0.0),
    "CRC-8: burst of up to 8 bits": (_short_burst, 0.0),
    "CRC-8: of another message": (_fields_of_another, 2.0**-8),
    "CRC-8: random payload": (_random_payload, 2.0**-8),
    "wrong length": (_other_length, 0.0),
    "out of range or enumeration": (_out_of_range, 0.0),
    "unknown function": (_unknown_function, 0.0),
}
"""What is wrong in a payload that the carrier brought whole, and the odds that the codec takes it for a message.

A damage takes (rng, direction, rows, longest payload).
"""
