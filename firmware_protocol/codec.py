"""Typed messages to payload bytes and back.

`wire.py`, which is generated from tormag.dbc, has the arithmetic: rounding to the nearest step, range checks and the
CRC-8 of the protected messages. This module calls it, and says in words what did not fit. It knows no transport:
`framing` carries the payloads over a serial line, and on CAN they are the data bytes.
"""

import struct
from operator import index
from typing import Any, Final

from firmware_protocol import wire
from firmware_protocol.checksum import crc8
from firmware_protocol.enumerations import DeviceFault, DeviceMode, DriveMode, Switches
from firmware_protocol.layouts import (
    LAYOUTS,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
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
)
from firmware_protocol.schema import Layout, Signal

__all__ = [
    "FUNCTION",
    "PROTOCOL_VERSION",
    "SCHEMA_HASH",
    "Clear",
    "DecodeError",
    "DeviceFault",
    "DeviceMode",
    "Drive",
    "DriveMode",
    "EncodeError",
    "Hello",
    "Home",
    "Identity",
    "Message",
    "Retract",
    "Sense",
    "State",
    "Status",
    "Switches",
    "can_identifier",
    "crc8",
    "decode",
    "encode",
    "period",
]


class EncodeError(ValueError):
    """A message or frame cannot be put on the wire; the text names the signal, its value and what is allowed."""


class DecodeError(ValueError):
    """Bytes from the wire are not a message; the text names what was expected and what was received."""

    def __init__(self, text: str = "", name: str = "", check: str = "") -> None:
        super().__init__(text)
        self.name, self.check = name, check


_BY_TYPE: Final[dict[type[object], Layout]] = {layout.message: layout for layout in LAYOUTS}
_BY_FUNCTION: Final[dict[int, Layout]] = {layout.function: layout for layout in LAYOUTS}

FUNCTION: Final[dict[type[Message], int]] = {layout.message: layout.function for layout in LAYOUTS}
"""The serial frame's first byte, and the upper part of the CAN identifier."""


def can_identifier(function: int, node: int = 1) -> int:
    """Return the 11-bit CAN identifier of a function (1..127) of a node (0..15)."""
    if not (1 <= function <= 0x7F and 0 <= node <= 0xF):
        raise EncodeError(f"CAN function {function}, node {node}: allowed are functions 1 to 127, nodes 0 to 15")
    return function << 4 | node


def period(message: type[Message], signal: str) -> float:
    """Return the period of a wrapping signal, in the signal's unit (mm, s)."""
    return {s.name: s.period for s in _BY_TYPE[message].signals if s.wraps}[signal]


def encode(message: Message) -> bytes:
    """Return a message's payload; values go to the nearest step, wrapping signals modulo their period. Raises
    EncodeError.
    """
    try:
        payload = wire.pack(message)
    except (TypeError, ValueError, OverflowError, struct.error) as error:  # not a number, NaN, infinite
        raise _misfit(message) from error
    if payload is None:
        raise _misfit(message)
    return payload


def decode(function: int, payload: bytes | bytearray) -> Message:
    """Return the message in the payload of a function. Raises DecodeError."""
    data = payload if isinstance(payload, bytes) else bytes(payload)
    message = wire.unpack(function, data)
    if message is None:
        raise _no_message(function, data)
    return message


def _misfit(message: Message) -> EncodeError:
    """Return the error that names the first value that does not fit."""
    layout = _BY_TYPE.get(type(message))
    if layout is None:
        return EncodeError(f"{message!r} is not a message of this protocol")
    for signal in layout.signals:
        value = getattr(message, signal.name)
        if not _fits(signal, value):
            kind = "finite values" if signal.wraps else "values" if signal.type is float else "whole numbers"
            span = "" if signal.wraps else f" from {signal.minimum:.10g} to {signal.maximum:.10g}"
            name = f"{layout.message.__name__}.{signal.name}"
            return EncodeError(f"{name} = {value!r}: allowed are {kind}{span}")
    return EncodeError(f"{message!r} does not fit the wire")


def _fits(signal: Signal, value: Any) -> bool:
    try:
        step = round(value / signal.scale) if signal.type is float else index(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return signal.wraps or signal.lowest <= step <= signal.highest


def _no_message(function: int, payload: bytes) -> DecodeError:
    """Return the error of bytes that are no message."""
    layout = _BY_FUNCTION.get(function)
    if layout is None:
        return DecodeError(f"function {function}: known are {', '.join(map(str, _BY_FUNCTION))}", check="function")
    name, length = layout.message.__name__, struct.calcsize(layout.format)
    if len(payload) != length:
        return DecodeError(f"{name}: {length} bytes expected, {len(payload)} received", name, "length")
    steps = struct.unpack(layout.format, payload)
    if layout.protected:
        expected = crc8(bytes((function,)) + payload[:-1])
        if steps[-1] != expected:
            text = f"{name}: CRC {expected:#04x} expected, {steps[-1]:#04x} received ({payload.hex()})"
            return DecodeError(text, name, "CRC-8")
    for place, signal in enumerate(layout.signals):
        if not signal.lowest <= steps[place] <= signal.highest:
            return DecodeError(
                f"{name}.{signal.name}: {signal.minimum:.10g} to {signal.maximum:.10g} expected, "
                f"{steps[place] * signal.scale:.10g} received",
                name,
                "range",
            )
    return DecodeError(f"{name}: {payload.hex()} is no message", name, "range")
