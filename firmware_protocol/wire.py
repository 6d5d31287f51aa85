"""Payload bytes of each message and back. Generated from tormag.dbc; to change it, see `generate.py`.

Whatever does not fit is None here, or an error of Python's where it is not even a number. `codec` says what was wrong.
"""

from collections.abc import Callable
from functools import cache
from operator import index
from struct import Struct
from typing import Any, Final

from firmware_protocol.checksum import CRC8_RESIDUE, crc8
from firmware_protocol.enumerations import (
    DeviceFault,
    DeviceMode,
    DriveMode,
    Switches,
)
from firmware_protocol.layouts import (
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

_BYTES: Final = tuple([bytes((byte,)) for byte in range(256)])
_HALVES: Final = 1.5 * 2.0**52
# Between 2**52 and 2**53 floats are the whole numbers, and a sum goes to the nearest, of two as near to the even one.
# So adding and subtracting this is `round`, for all that is under 2**51 either way; what is over stays over.
_WHOLE: Final = 2.0**51

# the member of a step; an enumeration's own look-up takes five times as long; steps were range-checked
_DRIVE_MODE: Final = tuple(DriveMode)
_DEVICE_MODE: Final = tuple(DeviceMode)
_SWITCHES: Final = cache(Switches)
_DEVICE_FAULT: Final = cache(DeviceFault)

_PACK_RETRACT: Final = Struct("<B").pack
_PACK_DRIVE: Final = Struct("<hhBB").pack
_PACK_STATE: Final = Struct("<HHHB").pack
_PACK_SENSE: Final = Struct("<hhhH").pack
_PACK_CLEAR: Final = Struct("<B").pack
_PACK_HOME: Final = Struct("<B").pack
_PACK_STATUS: Final = Struct("<BBHbBBB").pack
_PACK_HELLO: Final = Struct("<IBB").pack
_PACK_IDENTITY: Final = Struct("<IBBH").pack


def pack_retract(message: Retract) -> bytes | None:
    if not 0 <= message.nonce <= 255:
        return None
    return _PACK_RETRACT(
        message.nonce,
    )


def unpack_retract(data: bytes) -> Retract | None:
    if len(data) != 1:
        return None
    return Retract(
        data[0],
    )


def pack_drive(message: Drive) -> bytes | None:
    left_duty = float(message.left_duty / 0.0001) + _HALVES - _HALVES
    right_duty = float(message.right_duty / 0.0001) + _HALVES - _HALVES
    mode: int = message.mode
    if (
        not -10000.0 <= left_duty <= 10000.0
        or not -10000.0 <= right_duty <= 10000.0
        or not 0 <= mode <= 1
        or not 0 <= message.counter <= 255
    ):
        return None
    body = _PACK_DRIVE(
        int(left_duty),
        int(right_duty),
        mode,
        message.counter,
    )
    return body + _BYTES[crc8(body, 0xFE)]


def unpack_drive(data: bytes) -> Drive | None:
    if len(data) != 7 or crc8(data, 0xFE) != CRC8_RESIDUE:
        return None
    left_duty = ((data[0] | data[1] << 8) ^ 0x8000) - 0x8000
    right_duty = ((data[2] | data[3] << 8) ^ 0x8000) - 0x8000
    mode = data[4]
    if not -10000 <= left_duty <= 10000 or not -10000 <= right_duty <= 10000 or mode > 1:
        return None
    return Drive(
        left_duty * 0.0001,
        right_duty * 0.0001,
        _DRIVE_MODE[mode],
        data[5],
    )


def pack_state(message: State) -> bytes | None:
    left_position_mm = float(message.left_position_mm / 0.0017857142857142857)
    if not -_WHOLE < left_position_mm < _WHOLE:
        left_position_mm %= 65536.0
    right_position_mm = float(message.right_position_mm / 0.0017857142857142857)
    if not -_WHOLE < right_position_mm < _WHOLE:
        right_position_mm %= 65536.0
    device_time_s = float(message.device_time_s / 1e-05)
    if not -_WHOLE < device_time_s < _WHOLE:
        device_time_s %= 65536.0
    if not 0 <= message.counter <= 255:
        return None
    body = _PACK_STATE(
        int(left_position_mm + _HALVES - _HALVES) & 0xFFFF,
        int(right_position_mm + _HALVES - _HALVES) & 0xFFFF,
        int(device_time_s + _HALVES - _HALVES) & 0xFFFF,
        message.counter,
    )
    return body + _BYTES[crc8(body, 0xE3)]


def unpack_state(data: bytes) -> State | None:
    if len(data) != 8 or crc8(data, 0xE3) != CRC8_RESIDUE:
        return None
    return State(
        (((data[0] | data[1] << 8) ^ 0x8000) - 0x8000) * 0.0017857142857142857,
        (((data[2] | data[3] << 8) ^ 0x8000) - 0x8000) * 0.0017857142857142857,
        (data[4] | data[5] << 8) * 1e-05,
        data[6],
    )


def pack_sense(message: Sense) -> bytes | None:
    left_current_A = float(message.left_current_A / 0.001) + _HALVES - _HALVES
    right_current_A = float(message.right_current_A / 0.001) + _HALVES - _HALVES
    force_N = float(message.force_N / 0.001) + _HALVES - _HALVES
    handle_position_mm = float(message.handle_position_mm / 0.007669903939428206)
    if not -_WHOLE < handle_position_mm < _WHOLE:
        handle_position_mm %= 65536.0
    if (
        not -32768.0 <= left_current_A <= 32767.0
        or not -32768.0 <= right_current_A <= 32767.0
        or not -32768.0 <= force_N <= 32767.0
    ):
        return None
    return _PACK_SENSE(
        int(left_current_A),
        int(right_current_A),
        int(force_N),
        int(handle_position_mm + _HALVES - _HALVES) & 0xFFFF,
    )


def unpack_sense(data: bytes) -> Sense | None:
    if len(data) != 8:
        return None
    return Sense(
        (((data[0] | data[1] << 8) ^ 0x8000) - 0x8000) * 0.001,
        (((data[2] | data[3] << 8) ^ 0x8000) - 0x8000) * 0.001,
        (((data[4] | data[5] << 8) ^ 0x8000) - 0x8000) * 0.001,
        (data[6] | data[7] << 8) * 0.007669903939428206,
    )


def pack_clear(message: Clear) -> bytes | None:
    if not 0 <= message.nonce <= 255:
        return None
    return _PACK_CLEAR(
        message.nonce,
    )


def unpack_clear(data: bytes) -> Clear | None:
    if len(data) != 1:
        return None
    return Clear(
        data[0],
    )


def pack_home(message: Home) -> bytes | None:
    if not 0 <= message.nonce <= 255:
        return None
    return _PACK_HOME(
        message.nonce,
    )


def unpack_home(data: bytes) -> Home | None:
    if len(data) != 1:
        return None
    return Home(
        data[0],
    )


def pack_status(message: Status) -> bytes | None:
    mode: int = message.mode
    switches: int = message.switches
    faults: int = index(message.faults)
    temperature_C = float(message.temperature_C / 1.0) + _HALVES - _HALVES
    supply_V = float(message.supply_V / 0.1) + _HALVES - _HALVES
    if (
        not 0 <= mode <= 4
        or not 0 <= switches <= 31
        or not 0 <= faults <= 1023
        or not -128.0 <= temperature_C <= 127.0
        or not 0.0 <= supply_V <= 255.0
        or not 0 <= message.drive_counter <= 255
        or not 0 <= message.command_nonce <= 255
    ):
        return None
    return _PACK_STATUS(
        mode,
        switches,
        faults,
        int(temperature_C),
        int(supply_V),
        message.drive_counter,
        message.command_nonce,
    )


def unpack_status(data: bytes) -> Status | None:
    if len(data) != 8:
        return None
    mode = data[0]
    switches = data[1]
    faults = data[2] | data[3] << 8
    if mode > 4 or switches > 31 or faults > 1023:
        return None
    return Status(
        _DEVICE_MODE[mode],
        _SWITCHES(switches),
        _DEVICE_FAULT(faults),
        ((data[4] ^ 0x80) - 0x80) * 1.0,
        data[5] * 0.1,
        data[6],
        data[7],
    )


def pack_hello(message: Hello) -> bytes | None:
    schema_hash: int = index(message.schema_hash)
    if not 0 <= schema_hash <= 4294967295 or not 0 <= message.protocol_version <= 255 or not 0 <= message.nonce <= 255:
        return None
    return _PACK_HELLO(
        schema_hash,
        message.protocol_version,
        message.nonce,
    )


def unpack_hello(data: bytes) -> Hello | None:
    if len(data) != 6:
        return None
    return Hello(
        data[0] | data[1] << 8 | data[2] << 16 | data[3] << 24,
        data[4],
        data[5],
    )


def pack_identity(message: Identity) -> bytes | None:
    schema_hash: int = index(message.schema_hash)
    serial_number: int = index(message.serial_number)
    if (
        not 0 <= schema_hash <= 4294967295
        or not 0 <= message.firmware_major <= 255
        or not 0 <= message.firmware_minor <= 255
        or not 0 <= serial_number <= 65535
    ):
        return None
    return _PACK_IDENTITY(
        schema_hash,
        message.firmware_major,
        message.firmware_minor,
        serial_number,
    )


def unpack_identity(data: bytes) -> Identity | None:
    if len(data) != 8:
        return None
    return Identity(
        data[0] | data[1] << 8 | data[2] << 16 | data[3] << 24,
        data[4],
        data[5],
        data[6] | data[7] << 8,
    )


_PACKERS: Final[dict[type[object], Callable[[Any], bytes | None]]] = {
    Retract: pack_retract,
    Drive: pack_drive,
    State: pack_state,
    Sense: pack_sense,
    Clear: pack_clear,
    Home: pack_home,
    Status: pack_status,
    Hello: pack_hello,
    Identity: pack_identity,
}
_UNPACKERS: Final[dict[int, Callable[[bytes], Message | None]]] = {
    1: unpack_retract,
    2: unpack_drive,
    3: unpack_state,
    4: unpack_sense,
    5: unpack_clear,
    6: unpack_home,
    7: unpack_status,
    8: unpack_hello,
    9: unpack_identity,
}


def pack(message: Message) -> bytes | None:
    """The payload of a message; None where a value does not fit."""
    packer = _PACKERS.get(type(message))
    return None if packer is None else packer(message)


def unpack(function: int, data: bytes) -> Message | None:
    """The message in a payload; None for bytes that are none."""
    unpacker = _UNPACKERS.get(function)
    return None if unpacker is None else unpacker(data)
