"""A classical CAN frame with an 11-bit identifier, and its bytes on the simulator's socket."""

import math
import struct
from typing import NamedTuple

MAX_IDENTIFIER = 0x7FF
MAX_DATA = 8
ERROR_FLAG = 0x2000_0000
"""Marks an error frame, a report of the controller (linux/can.h)."""
SOCKET_FRAME = struct.Struct("=IB?2x8sd")
"""Linux's `struct can_frame`, with a flag in a spare byte, and a time after it."""


class CanFrame(NamedTuple):
    """Identifier and 0 to 8 bytes of data, or with ERROR_FLAG a controller's report of an error."""

    identifier: int
    data: bytes


class SocketFrame(NamedTuple):
    """A frame on the simulator's socket."""

    frame: CanFrame
    is_own: bool
    """The receiving host has sent the frame itself."""
    time_s: float
    """When the frame's last bit passed, s since 1970; 0 from a host."""


def to_socket(frame: CanFrame, is_own: bool = False, time_s: float = 0.0) -> bytes:
    return SOCKET_FRAME.pack(frame.identifier, len(frame.data), is_own, frame.data, time_s)


def from_socket(packet: bytes) -> SocketFrame | None:
    """Return the frame in a packet, or None if it is not valid."""
    if len(packet) != SOCKET_FRAME.size:
        return None
    identifier, length, is_own, data, time_s = SOCKET_FRAME.unpack(packet)
    if length > MAX_DATA or identifier & ~ERROR_FLAG > MAX_IDENTIFIER or not math.isfinite(time_s):
        return None
    return SocketFrame(CanFrame(identifier, data[:length]), is_own, time_s)
