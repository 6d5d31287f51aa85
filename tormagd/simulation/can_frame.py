"""A classical CAN frame with an 11-bit identifier: its bits on the bus, and its bytes on the simulator's socket."""

import struct
from typing import NamedTuple

MAX_IDENTIFIER = 0x7FF
MAX_DATA = 8
ERROR_FLAG = 0x2000_0000
"""In the identifier of an error frame, which is a report of the controller (linux/can.h)."""
SOCKET_FRAME = struct.Struct("=IB3x8s")
"""Linux's `struct can_frame`."""

CRC_BITS = 15
CRC_MASK = 0x7FFF
CRC_GENERATOR = 0xC599
STUFFED_AFTER = 5
"""After so many equal bits a sender stuffs one of the other kind, which begins the next run (ISO 11898-1, 10.5)."""
UNSTUFFED_BITS = 13
"""CRC delimiter, acknowledgement and its delimiter, end of frame (7), and the pause before the next frame (3)."""


class CanFrame(NamedTuple):
    """Identifier and 0 to 8 bytes of data. With ERROR_FLAG in the identifier: a controller's report of an error."""

    identifier: int
    data: bytes


def frame_bits(frame: CanFrame) -> int:
    """Return how many bit times the frame takes, with its stuff bits and the pause of 3 behind it (ISO 11898-1)."""
    # start of frame, identifier, then RTR, IDE and r0, which are 0 in a classical data frame, and the length
    head = (frame.identifier << 7 | len(frame.data)).to_bytes(3, "big")
    crc = 0
    for byte in head + frame.data:
        crc = _CRC_TABLE[crc >> 7 ^ byte] ^ crc << 8 & CRC_MASK
    count = 19 + 8 * len(frame.data) + CRC_BITS
    bits = int.from_bytes(head + frame.data, "big") << CRC_BITS | crc
    # six bits in front make them whole bytes; into these, which alternate, nothing is stuffed
    stuffed, run = 0, 0
    for byte in (0b010101 << count | bits).to_bytes((6 + count) // 8, "big"):
        more, run = _RUNS[run][byte]
        stuffed += more
    return count + stuffed + UNSTUFFED_BITS


def to_socket(frame: CanFrame) -> bytes:
    """Return the frame as one packet of the simulator's socket."""
    return SOCKET_FRAME.pack(frame.identifier, len(frame.data), frame.data)


def from_socket(packet: bytes) -> CanFrame | None:
    """Return the frame in a packet of the simulator's socket, None where the packet holds no valid one."""
    if len(packet) != SOCKET_FRAME.size:
        return None
    identifier, length, data = SOCKET_FRAME.unpack(packet)
    if length > MAX_DATA or identifier & ~ERROR_FLAG > MAX_IDENTIFIER:
        return None
    return CanFrame(identifier, data[:length])


def _crc_of(byte: int) -> int:
    crc = byte << CRC_BITS - 8
    for _ in range(8):
        crc = crc << 1 ^ (CRC_GENERATOR if crc >> CRC_BITS - 1 else 0)
    return crc


_CRC_TABLE = [_crc_of(byte) for byte in range(256)]


def _after(run: int, byte: int) -> tuple[int, int]:
    """Return the stuff bits in a byte that follows a run of equal bits, and the run that it leaves."""
    stuffed = 0
    for place in range(7, -1, -1):
        one = -1 if byte >> place & 1 else 1
        run = run + one if run * one > 0 else one
        if abs(run) == STUFFED_AFTER:
            stuffed, run = stuffed + 1, -one
    return stuffed, run


_RUNS = [[_after(run, byte) for byte in range(256)] for run in (0, 1, 2, 3, 4, -4, -3, -2, -1)]
"""`_after` by run and byte; a negative run counts from the list's end."""
