"""A classical CAN frame with an 11-bit identifier: its bits on the bus, and its bytes on the simulator's socket."""

import struct
from functools import cache
from typing import NamedTuple

MAX_IDENTIFIER = 0x7FF
MAX_DATA = 8
ERROR_FLAG = 0x2000_0000
"""In the identifier of an error frame, which is no frame but a report of the controller's: linux/can.h."""
SOCKET_FRAME = struct.Struct("=IB3x8s")
"""Linux's `struct can_frame`."""

CRC_POLYNOMIAL = 0x4599
CRC_MASK = 0x7FFF
CRC_BITS = 15
LONGEST_RUN = 5
"""Equal bits in a row after which a sender stuffs one of the other kind: ISO 11898-1, 10.5."""
UNSTUFFED_BITS = 13
"""CRC delimiter, acknowledgement and its delimiter, end of frame (7), and the pause before the next frame (3)."""


class CanFrame(NamedTuple):
    """Identifier and 0 to 8 bytes of data. With ERROR_FLAG in the identifier, a controller's report."""

    identifier: int
    data: bytes


class _Progress(NamedTuple):
    """How far a frame has been put on the bus: its CRC so far, the run of equal bits at its end, the bits so far."""

    crc: int
    last: int
    run: int
    bits: int


_START = _Progress(crc=0, last=1, run=0, bits=0)


def frame_bits(frame: CanFrame) -> int:
    """How many bit times the frame takes, with its stuff bits and the pause behind it."""
    crc, last, run, bits = _header(frame.identifier, len(frame.data))
    for byte in frame.data:
        crc = _crc_table()[crc >> 7 ^ byte] ^ crc << 8 & CRC_MASK
        last, run, count = _stuffing_table(8)[last, run, byte]
        bits += count
    last, run, count = _stuffing_table(8)[last, run, crc >> CRC_BITS - 8]
    bits += count
    _, _, count = _stuffing_table(CRC_BITS - 8)[last, run, crc & 0x7F]
    return bits + count + UNSTUFFED_BITS


def to_socket(frame: CanFrame) -> bytes:
    """The frame as one packet of the simulator's socket."""
    return SOCKET_FRAME.pack(frame.identifier, len(frame.data), frame.data)


def from_socket(packet: bytes) -> CanFrame | None:
    """The frame in a packet of the simulator's socket; None if there is none in it."""
    if len(packet) != SOCKET_FRAME.size:
        return None
    identifier, length, data = SOCKET_FRAME.unpack(packet)
    if length > MAX_DATA or identifier & ~ERROR_FLAG > MAX_IDENTIFIER:
        return None
    return CanFrame(identifier, data[:length])


def _stuffed(last: int, run: int, bit: int) -> tuple[int, int, int]:
    """One bit more: the last bit on the bus, the run that it ends, and the bits that were sent."""
    run = run + 1 if bit == last else 1
    return (bit, run, 1) if run < LONGEST_RUN else (1 - bit, 1, 2)


def _crc_step(crc: int, bit: int) -> int:
    feedback = crc >> CRC_BITS - 1 ^ bit
    return (crc << 1 & CRC_MASK) ^ (CRC_POLYNOMIAL if feedback else 0)


@cache
def _header(identifier: int, length: int) -> _Progress:
    # start of frame, identifier, then RTR, IDE and r0, which are 0 in a classical data frame, and the length
    crc, last, run, bits = _START
    value = identifier << 7 | length
    for position in range(18, -1, -1):
        bit = value >> position & 1
        crc = _crc_step(crc, bit)
        last, run, count = _stuffed(last, run, bit)
        bits += count
    return _Progress(crc, last, run, bits)


@cache
def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = 0
        for position in range(7, -1, -1):
            crc = _crc_step(crc, byte >> position & 1)
        table.append(crc)
    return tuple(table)


@cache
def _stuffing_table(width: int) -> dict[tuple[int, int, int], tuple[int, int, int]]:
    """What the last bit and the run before so many bits become, and how many bits are sent."""
    table = {}
    for start in ((bit, run) for bit in (0, 1) for run in range(LONGEST_RUN)):
        for value in range(1 << width):
            last, run = start
            sent = 0
            for position in range(width - 1, -1, -1):
                last, run, count = _stuffed(last, run, value >> position & 1)
                sent += count
            table[*start, value] = last, run, sent
    return table
