"""Payload bytes of each message and back. Generated from tormag.dbc; to change it, see `generate.py`.

Whatever does not fit is None here, or an error of Python's where it is not even a number. `codec` says what was wrong.
"""

from functools import cache
from operator import index
from struct import Struct
from typing import Final

from firmware_protocol.checksum import CRC8_RESIDUE, crc8
from firmware_protocol.enumerations import DeviceFault, DeviceMode, DriveMode, Switches
from firmware_protocol.layouts import Clear, Drive, Hello, Home, Identity, Message, Retract, Sense, State, Status

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
    nonce: int = message.nonce
    if not 0 <= nonce <= 255:
        return None
    return _PACK_RETRACT(nonce)


def unpack_retract(data: bytes) -> Retract | None:
    if len(data) != 1:
        return None
    nonce = data[0]
    return Retract(nonce)


def pack_drive(message: Drive) -> bytes | None:
    left_duty = float(message.left_duty / 0.0001) + _HALVES - _HALVES
    right_duty = float(message.right_duty / 0.0001) + _HALVES - _HALVES
    mode: int = message.mode
    counter: int = message.counter
    if (
        not -10000.0 <= left_duty <= 10000.0
        or not -10000.0 <= right_duty <= 10000.0
        or not 0 <= mode <= 1
        or not 0 <= counter <= 255
    ):
        return None
    body = _PACK_DRIVE(int(left_duty), int(right_duty), mode, counter)
    return body + _BYTES[crc8(body, 0xFE)]


def unpack_drive(data: bytes) -> Drive | None:
    if len(data) != 7:
        return None
    if crc8(data, 0xFE) != CRC8_RESIDUE:
        return None
    left_duty = ((data[0] | data[1] << 8) ^ 0x8000) - 0x8000
    right_duty = ((data[2] | data[3] << 8) ^ 0x8000) - 0x8000
    mode = data[4]
    counter = data[5]
    if not -10000 <= left_duty <= 10000 or not -10000 <= right_duty <= 10000 or mode > 1:
        return None
    return Drive(left_duty * 0.0001, right_duty * 0.0001, _DRIVE_MODE[mode], counter)


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
    counter: int = message.counter
    if not 0 <= counter <= 255:
        return None
    body = _PACK_STATE(
        int(left_position_mm + _HALVES - _HALVES) & 0xFFFF,
        int(right_position_mm + _HALVES - _HALVES) & 0xFFFF,
        int(device_time_s + _HALVES - _HALVES) & 0xFFFF,
        counter,
    )
    return body + _BYTES[crc8(body, 0xE3)]


def unpack_state(data: bytes) -> State | None:
    if len(data) != 8:
        return None
    if crc8(data, 0xE3) != CRC8_RESIDUE:
        return None
    left_position_mm = ((data[0] | data[1] << 8) ^ 0x8000) - 0x8000
    right_position_mm = ((data[2] | data[3] << 8) ^ 0x8000) - 0x8000
    device_time_s = data[4] | data[5] << 8
    counter = data[6]
    return State(
        left_position_mm * 0.0017857142857142857,
        right_position_mm * 0.0017857142857142857,
        device_time_s * 1e-05,
        counter,
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
        int(left_current_A), int(right_current_A), int(force_N), int(handle_position_mm + _HALVES - _HALVES) & 0xFFFF
    )


def unpack_sense(data: bytes) -> Sense | None:
    if len(data) != 8:
        return None
    left_current_A = ((data[0] | data[1] << 8) ^ 0x8000) - 0x8000
    right_current_A = ((data[2] | data[3] << 8) ^ 0x8000) - 0x8000
    force_N = ((data[4] | data[5] << 8) ^ 0x8000) - 0x8000
    handle_position_mm = data[6] | data[7] << 8
    return Sense(
        left_current_A * 0.001, right_current_A * 0.001, force_N * 0.001, handle_position_mm * 0.007669903939428206
    )


def pack_clear(message: Clear) -> bytes | None:
    nonce: int = message.nonce
    if not 0 <= nonce <= 255:
        return None
    return _PACK_CLEAR(nonce)


def unpack_clear(data: bytes) -> Clear | None:
    if len(data) != 1:
        return None
    nonce = data[0]
    return Clear(nonce)


def pack_home(message: Home) -> bytes | None:
    nonce: int = message.nonce
    if not 0 <= nonce <= 255:
        return None
    return _PACK_HOME(nonce)


def unpack_home(data: bytes) -> Home | None:
    if len(data) != 1:
        return None
    nonce = data[0]
    return Home(nonce)


def pack_status(message: Status) -> bytes | None:
    mode: int = message.mode
    switches: int = message.switches
    faults: int = index(message.faults)
    temperature_C = float(message.temperature_C / 1.0) + _HALVES - _HALVES
    supply_V = float(message.supply_V / 0.1) + _HALVES - _HALVES
    drive_counter: int = message.drive_counter
    command_nonce: int = message.command_nonce
    if (
        not 0 <= mode <= 4
        or not 0 <= switches <= 31
        or not 0 <= faults <= 1023
        or not -128.0 <= temperature_C <= 127.0
        or not 0.0 <= supply_V <= 255.0
        or not 0 <= drive_counter <= 255
        or not 0 <= command_nonce <= 255
    ):
        return None
    return _PACK_STATUS(mode, switches, faults, int(temperature_C), int(supply_V), drive_counter, command_nonce)


def unpack_status(data: bytes) -> Status | None:
    if len(data) != 8:
        return None
    mode = data[0]
    switches = data[1]
    faults = data[2] | data[3] << 8
    temperature_C = (data[4] ^ 0x80) - 0x80
    supply_V = data[5]
    drive_counter = data[6]
    command_nonce = data[7]
    if mode > 4 or switches > 31 or faults > 1023:
        return None
    return Status(
        _DEVICE_MODE[mode],
        _SWITCHES(switches),
        _DEVICE_FAULT(faults),
        temperature_C * 1.0,
        supply_V * 0.1,
        drive_counter,
        command_nonce,
    )


def pack_hello(message: Hello) -> bytes | None:
    schema_hash: int = index(message.schema_hash)
    protocol_version: int = message.protocol_version
    nonce: int = message.nonce
    if not 0 <= schema_hash <= 4294967295 or not 0 <= protocol_version <= 255 or not 0 <= nonce <= 255:
        return None
    return _PACK_HELLO(schema_hash, protocol_version, nonce)


def unpack_hello(data: bytes) -> Hello | None:
    if len(data) != 6:
        return None
    schema_hash = data[0] | data[1] << 8 | data[2] << 16 | data[3] << 24
    protocol_version = data[4]
    nonce = data[5]
    return Hello(schema_hash, protocol_version, nonce)


def pack_identity(message: Identity) -> bytes | None:
    schema_hash: int = index(message.schema_hash)
    firmware_major: int = message.firmware_major
    firmware_minor: int = message.firmware_minor
    serial_number: int = index(message.serial_number)
    if (
        not 0 <= schema_hash <= 4294967295
        or not 0 <= firmware_major <= 255
        or not 0 <= firmware_minor <= 255
        or not 0 <= serial_number <= 65535
    ):
        return None
    return _PACK_IDENTITY(schema_hash, firmware_major, firmware_minor, serial_number)


def unpack_identity(data: bytes) -> Identity | None:
    if len(data) != 8:
        return None
    schema_hash = data[0] | data[1] << 8 | data[2] << 16 | data[3] << 24
    firmware_major = data[4]
    firmware_minor = data[5]
    serial_number = data[6] | data[7] << 8
    return Identity(schema_hash, firmware_major, firmware_minor, serial_number)


def pack(message: Message) -> bytes | None:
    """The payload of a message; None where a value does not fit."""
    match message:
        case Retract():
            return pack_retract(message)
        case Drive():
            return pack_drive(message)
        case State():
            return pack_state(message)
        case Sense():
            return pack_sense(message)
        case Clear():
            return pack_clear(message)
        case Home():
            return pack_home(message)
        case Status():
            return pack_status(message)
        case Hello():
            return pack_hello(message)
        case Identity():
            return pack_identity(message)
    return None


def unpack(function: int, data: bytes) -> Message | None:
    """The message in a payload; None for bytes that are none."""
    match function:
        case 1:
            return unpack_retract(data)
        case 2:
            return unpack_drive(data)
        case 3:
            return unpack_state(data)
        case 4:
            return unpack_sense(data)
        case 5:
            return unpack_clear(data)
        case 6:
            return unpack_home(data)
        case 7:
            return unpack_status(data)
        case 8:
            return unpack_hello(data)
        case 9:
            return unpack_identity(data)
    return None
