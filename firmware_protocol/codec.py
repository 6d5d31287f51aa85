"""Typed messages to payload bytes and back.

The byte layouts come from `layouts.py`, which is generated from tormag.dbc; this module is the arithmetic around them:
rounding to the nearest step, range checks and the CRC-8 of the protected messages. It knows no transport: `framing`
carries the payloads over a serial line, and on CAN they are the data bytes.
"""

import struct
from collections.abc import Callable, Iterable
from enum import Enum
from functools import cache
from operator import index
from typing import Any, Final, NamedTuple, TypeAlias

from firmware_protocol.layouts import (
    LAYOUTS,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    Switches,
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

CRC8_POLYNOMIAL: Final = 0x1D  # SAE J1850: Hamming distance 3 over the 64 bits it guards here
CRC8_INITIAL: Final = 0xFF
CRC8_FINAL_XOR: Final = 0xFF


class EncodeError(ValueError):
    """A message or frame cannot be put on the wire. The text names the signal, its value and what is allowed."""


class DecodeError(ValueError):
    """Bytes from the wire are not a message. The text names what was expected and what was received."""


def _crc8_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = register << 1 ^ (CRC8_POLYNOMIAL if register & 0x80 else 0)
            register &= 0xFF
        table.append(register)
    return tuple(table)


_CRC8_TABLE: Final = _crc8_table()


def crc8(data: bytes) -> int:
    """CRC-8/SAE-J1850 of `data`."""
    register = CRC8_INITIAL
    for byte in data:
        register = _CRC8_TABLE[register ^ byte]
    return register ^ CRC8_FINAL_XOR


_Field: TypeAlias = tuple[float | None, int, int, bool, Callable[[int], Any] | None]
"""A signal with everything computed that one pass over a message needs: scale (None for whole numbers), lowest and
highest step, whether it wraps, and, for an enumeration, what gives the member of a step. Unnamed, because a named tuple
takes three times as long to unpack, for every signal of every message.
"""


class _Codec(NamedTuple):
    layout: Layout
    function_byte: bytes
    pack: Callable[..., bytes]
    unpack: Callable[[bytes | bytearray], tuple[int, ...]]
    length: int
    protected: bool
    fields: tuple[_Field, ...]
    make: Callable[[Iterable[Any]], Message]


def _field(signal: Signal) -> _Field:
    scale = float(signal.scale) if signal.type is float else None
    # An enumeration's own look-up takes five times as long. The cache is bounded: steps are range-checked before.
    member = cache(signal.type) if issubclass(signal.type, Enum) else None
    return scale, signal.lowest, signal.highest, signal.wraps, member


def _codec(layout: Layout) -> _Codec:
    whole = struct.Struct(layout.format)
    body = struct.Struct(layout.format[:-1]) if layout.protected else whole
    return _Codec(
        layout=layout,
        function_byte=bytes([layout.function]),
        pack=body.pack,
        unpack=whole.unpack,
        length=whole.size,
        protected=layout.protected,
        fields=tuple(_field(signal) for signal in layout.signals),
        make=layout.message._make,
    )


_BY_TYPE: Final = {layout.message: _codec(layout) for layout in LAYOUTS}
_BY_FUNCTION: Final = {layout.function: _BY_TYPE[layout.message] for layout in LAYOUTS}

FUNCTION: Final[dict[type[Message], int]] = {layout.message: layout.function for layout in LAYOUTS}
"""The function code of each message: the serial frame's first byte, and the upper part of the CAN identifier."""


def can_identifier(function: int, node: int = 1) -> int:
    """The 11-bit CAN identifier of a function (1..127) of a node (0..15). Raises EncodeError outside them."""
    if not (1 <= function <= 0x7F and 0 <= node <= 0xF):
        raise EncodeError(f"CAN function {function}, node {node}: allowed are functions 1 to 127, nodes 0 to 15")
    return function << 4 | node


def period(message: type[Message], signal: str) -> float:
    """What a wrapping signal is known modulo, in its unit (mm, s). Raises KeyError for a signal that does not wrap."""
    return {s.name: s.period for s in _BY_TYPE[message].layout.signals if s.wraps}[signal]


def encode(message: Message) -> bytes:
    """The payload of a message; physical values go to the nearest step, wrapping signals modulo their period.

    Raises EncodeError for a value that is not finite, not in range or, where a whole number is due, not whole.
    """
    codec = _BY_TYPE.get(type(message))
    if codec is None:
        raise EncodeError(f"{message!r} is not a message of this protocol")
    _, function_byte, pack, _, _, protected, fields, _ = codec
    values: tuple[Any, ...] = message
    steps: list[int] = []
    try:
        for place, (scale, lowest, highest, wraps, _) in enumerate(fields):
            step = index(values[place]) if scale is None else round(values[place] / scale)
            if not lowest <= step <= highest:
                if not wraps:
                    raise _refusal(message, codec, len(steps))
                step = (step - lowest) % (highest - lowest + 1) + lowest
            steps.append(step)
    except EncodeError:
        raise
    except (TypeError, ValueError, OverflowError) as error:  # not a number, NaN, infinite
        raise _refusal(message, codec, len(steps)) from error
    body = pack(*steps)
    return body + bytes((crc8(function_byte + body),)) if protected else body


def _refusal(message: Message, codec: _Codec, place: int) -> EncodeError:
    signal = codec.layout.signals[place]
    kind = "finite values" if signal.wraps else "values" if signal.type is float else "whole numbers"
    span = "" if signal.wraps else f" from {signal.minimum:.10g} to {signal.maximum:.10g}"
    return EncodeError(f"{type(message).__name__}.{signal.name} = {message[place]!r}: allowed are {kind}{span}")


def decode(function: int, payload: bytes | bytearray) -> Message:
    """The message in a payload.

    Raises DecodeError for an unknown function, a wrong length, a wrong CRC-8, an undefined enumeration value or flag,
    or a value outside its range; nothing else, whatever the bytes.
    """
    codec = _BY_FUNCTION.get(function)
    if codec is None:
        raise DecodeError(f"function {function}: known are {', '.join(map(str, _BY_FUNCTION))}")
    _, function_byte, _, unpack, length, protected, fields, make = codec
    if len(payload) != length:
        raise DecodeError(f"{_name(codec)}: {length} bytes expected, {len(payload)} received")
    steps = unpack(payload)
    if protected:
        expected = crc8(function_byte + payload[:-1])
        if steps[-1] != expected:
            raise DecodeError(
                f"{_name(codec)}: CRC {expected:#04x} expected, {steps[-1]:#04x} received ({payload.hex()})"
            )
    values: list[float] = []
    for place, (scale, lowest, highest, _, member) in enumerate(fields):
        step = steps[place]
        if not lowest <= step <= highest:
            signal = codec.layout.signals[place]
            raise DecodeError(
                f"{_name(codec)}.{signal.name}: {signal.minimum:.10g} to {signal.maximum:.10g} expected, "
                f"{step * signal.scale:.10g} received"
            )
        values.append(step * scale if scale is not None else step if member is None else member(step))
    return make(values)


def _name(codec: _Codec) -> str:
    return str(codec.layout.message.__name__)
