"""The codec, in Python and in C: against the DBC, the golden vectors, and what the README shows."""

import contextlib
import ctypes
import itertools
import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from firmware_protocol import codec
from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    DecodeError,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    EncodeError,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    Switches,
    can_identifier,
    crc8,
    decode,
    encode,
    period,
)
from firmware_protocol.dbc import DBC
from firmware_protocol.framing import MAX_PAYLOAD, Frame, FrameDecoder, FramingStatistics, encode_frame
from firmware_protocol.golden import bitwise_crc8, bitwise_crc16
from firmware_protocol.layouts import LAYOUTS
from firmware_protocol.schema import Layout

# -- against the DBC ---------------------------------------------------------------------------------------------------


DATABASE: Any = cantools.database.load_file(DBC, strict=True)
DRIVE = Drive(left_duty=0.5, right_duty=-0.25, mode=DriveMode.RUN, counter=7)
STATE = State(left_position_mm=-12.5, right_position_mm=-3.25, device_time_s=0.5, counter=255)
SENSE = Sense(left_current_A=1.5, right_current_A=-0.5, force_N=3.25, handle_position_mm=100.0)
STATUS = Status(DeviceMode.RUN, Switches.HOMED, DeviceFault(0), 25.0, 12.0, 7, 3)
US = Identity(SCHEMA_HASH, 1, 0, 77)
IS_COMPILED = not str(codec.__file__).endswith(".py")


def test_units_of_the_dbc_are_those_that_names_end_with() -> None:
    units = {signal.name: signal.unit for message in DATABASE.messages for signal in message.signals if signal.unit}
    assert units["force_N"] == "N"
    assert [name for name, unit in units.items() if not name.endswith(f"_{unit.replace('deg', '')}")] == []


def test_crc8_is_sae_j1850() -> None:
    assert crc8(b"123456789") == bitwise_crc8(b"123456789") == 0x4B
    assert crc8(b"") == 0
    payload = encode(STATE)
    assert payload[-1] != crc8(bytes([FUNCTION[Drive]]) + payload[:-1]), "it covers the function"


@pytest.mark.parametrize("message", [DRIVE, STATE], ids=["Drive", "State"])
def test_one_and_two_flipped_bits_and_bursts_of_eight_are_refused(message: Message) -> None:
    function, payload = FUNCTION[type(message)], encode(message)
    bits = 8 * len(payload)
    pairs = {1 << a | 1 << b for a in range(bits) for b in range(a + 1)}  # a == b: one bit
    bursts = {pattern << shift for pattern in range(1, 256, 2) for shift in range(bits - 7)}
    for mask in pairs | bursts:
        with pytest.raises(DecodeError, match="CRC"):
            decode(function, (int.from_bytes(payload, "big") ^ mask).to_bytes(len(payload), "big"))


@given(layout=st.sampled_from(LAYOUTS), data=st.data())
def test_any_bytes_of_the_right_length_and_crc_are_a_message_or_a_decode_error(
    layout: Layout, data: st.DataObject
) -> None:
    length = DATABASE.get_message_by_name(layout.message.__name__).length
    payload = data.draw(st.binary(min_size=length, max_size=length))
    if layout.protected:
        payload = payload[:-1] + bytes([crc8(bytes([layout.function]) + payload[:-1])])
    try:
        message = decode(layout.function, payload)
    except DecodeError as error:
        assert layout.message.__name__ in str(error)  # noqa: PT017 either outcome is right, this one with a name
        return
    assert encode(message) == payload


@pytest.mark.parametrize(
    ("function", "payload", "text"),
    [
        *((2, bytes(length), rf"Drive: 7 bytes expected, {length} received") for length in (0, 1, 6, 8, 64)),
        *((function, bytes(8), "known are 1, 2, 3, 4, 5, 6, 7, 8, 9") for function in (0, 10, 255, -1)),
        (FUNCTION[Status], b"\x05" + encode(STATUS)[1:], r"Status\.mode"),
        (FUNCTION[Status], encode(STATUS)[:1] + b"\x20" + encode(STATUS)[2:], r"Status\.switches"),
        (FUNCTION[Status], encode(STATUS)[:3] + b"\x04" + encode(STATUS)[4:], r"Status\.faults"),
    ],
)
def test_what_is_no_message_is_refused_by_name(function: int, payload: bytes, text: str) -> None:
    with pytest.raises(DecodeError, match=text):
        decode(function, payload)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        *(
            (
                message.replaced(**{name: bad}),
                rf"{type(message).__name__}\.{name} = -?(nan|inf): allowed",
            )
            for message in (DRIVE, STATE, SENSE, STATUS)
            for name in message.__match_args__
            if type(getattr(message, name)) is float
            for bad in (math.nan, math.inf, -math.inf)
        ),
        (DRIVE.replaced(left_duty=1.0001), r"Drive\.left_duty = 1\.0001: allowed are values from -1 to 1"),
        (DRIVE.replaced(right_duty=-1.0001), r"Drive\.right_duty = -1\.0001"),
        (DRIVE.replaced(mode=2), r"Drive\.mode = 2: allowed are whole numbers from 0 to 1"),  # type: ignore[arg-type]
        (DRIVE.replaced(counter=256), r"Drive\.counter = 256: allowed are whole numbers from 0 to 255"),
        (DRIVE.replaced(counter=-1), r"Drive\.counter = -1"),
        (SENSE.replaced(force_N=32.768), r"Sense\.force_N = 32\.768: allowed are values from -32\.768 to 32\.767"),
        (STATE.replaced(left_position_mm=1e308), r"State\.left_position_mm = 1e\+308: allowed are finite values"),
        (STATUS.replaced(temperature_C=127.6), r"Status\.temperature_C = 127\.6"),
        (STATUS.replaced(supply_V=-0.1), r"Status\.supply_V = -0\.1: allowed are values from 0 to 25\.5"),
        (STATUS.replaced(switches=32), r"Status\.switches = 32"),  # type: ignore[arg-type]
        (STATUS.replaced(faults=1024), r"Status\.faults = 1024"),  # type: ignore[arg-type]
        (Hello(1 << 32, 1, 1), r"Hello\.schema_hash = 4294967296"),
        (Identity(SCHEMA_HASH, 1, 0, 65536), r"Identity\.serial_number = 65536"),
        (Retract(256), r"Retract\.nonce = 256"),
    ],
)
def test_out_of_range_is_refused_with_name_value_and_range(message: Message, text: str) -> None:
    with pytest.raises(EncodeError, match=text):
        encode(message)


@pytest.mark.parametrize(
    ("message", "changes", "text"),
    [
        (DRIVE, {"counter": 3.0}, r"Drive\.counter = 3\.0: allowed are whole numbers from 0 to 255"),
        (DRIVE, {"left_duty": "0.5"}, r"Drive\.left_duty = '0\.5': allowed are values from -1 to 1"),
        (DRIVE, {"left_duty": None}, r"Drive\.left_duty = None"),
        (STATE, {"device_time_s": 1j}, r"State\.device_time_s = 1j: allowed are finite values"),
        (US, {"schema_hash": 3.0}, r"Identity\.schema_hash = 3\.0: allowed are whole numbers from 0 to 4294967295"),
        (STATUS, {"command_nonce": "1"}, r"Status\.command_nonce = '1'"),
        ((0.0, 0.0, 0, 0), {}, "not a message"),
    ],
)
def test_what_is_no_number_or_no_message_is_refused(message: Any, changes: dict[str, object], text: str) -> None:
    with pytest.raises(TypeError if IS_COMPILED else EncodeError, match="object expected" if IS_COMPILED else text):
        encode(message.replaced(**changes) if changes else message)


@given(st.sampled_from(LAYOUTS), st.data(), st.floats() | st.floats(-40.0, 40.0))
def test_a_step_is_python_s_round_of_the_quotient(layout: Layout, data: st.DataObject, value: float) -> None:
    quantities = [s for s in layout.signals if s.type is float]
    assume(quantities)
    signal = data.draw(st.sampled_from(quantities))
    if data.draw(st.booleans()):
        value = (data.draw(st.integers(2 * signal.lowest - 3, 2 * signal.highest + 3)) / 2.0) * signal.scale
    message = layout.message(*(0.0 if s.type is float else s.type(0) for s in layout.signals)).replaced(
        **{signal.name: value}
    )
    step = round(value / signal.scale) if math.isfinite(value / signal.scale) else None
    if step is not None and signal.wraps:
        step = (step - signal.lowest) % (signal.highest - signal.lowest + 1) + signal.lowest
    if step is None or not signal.lowest <= step <= signal.highest:
        with pytest.raises(EncodeError, match=signal.name):
            encode(message)
        return
    assert struct.unpack(layout.format, encode(message))[layout.signals.index(signal)] == step


def test_wrapping_steps_are_right_where_floats_thin_out() -> None:
    scale = period(State, "device_time_s") / 65536
    powers, less = (15, 16, 31, 50, 51, 52, 53, 60, 900), (-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0, 1.5)
    for sign, power, by in itertools.product((-1.0, 1.0), powers, less):
        value = sign * (2.0**power + by) * scale
        (_, _, step, _, _) = struct.unpack("<hhHBB", encode(STATE.replaced(device_time_s=value)))
        assert step == round(value / scale) % 65536, value


def test_periods() -> None:
    assert (
        period(State, "left_position_mm"),
        period(State, "device_time_s"),
        period(Sense, "handle_position_mm"),
    ) == pytest.approx((65536 * 8 / 4480, 0.65536, 4 * 2 * math.pi * 20))
    with pytest.raises(KeyError):
        period(Sense, "force_N")


def test_numbers_of_numpy_s_are_numbers() -> None:
    assert encode(Drive(np.float64(0.5), np.float32(-0.25), DriveMode.RUN, 7)) == encode(DRIVE)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="int object expected") if IS_COMPILED else contextlib.nullcontext():
        assert encode(DRIVE.replaced(counter=np.uint8(7))) == encode(DRIVE)


# -- the golden vectors in Python and in C, also under sanitizers, and what the README shows ---------------------------


ROOM = Path(__file__).parents[2] / "firmware_protocol"
MESSAGES: dict[str, Any] = json.loads((ROOM / "vectors" / "messages.json").read_text(encoding="utf-8"))
PAGE = (ROOM / "README.md").read_text(encoding="utf-8")
FRAMES: dict[str, Any] = json.loads((ROOM / "vectors" / "frames.json").read_text(encoding="utf-8"))


def test_valid_payloads_in_both_directions() -> None:
    types = {layout.message.__name__: layout.message for layout in LAYOUTS}
    for vector in MESSAGES["valid"]:
        payload = bytes.fromhex(vector["payload"])
        message = types[vector["message"]](**vector["values"])
        assert encode(message) == payload, vector
        assert [decode(vector["function"], kind(payload)) for kind in (bytes, bytearray)] == [message] * 2, vector
        assert can_identifier(FUNCTION[type(message)]) == vector["can_identifier"]


@pytest.mark.parametrize("vector", MESSAGES["invalid"], ids=lambda vector: f"{vector['reason']} {vector['payload']}")
def test_invalid_payloads_are_refused(vector: dict[str, Any]) -> None:
    with pytest.raises(DecodeError):
        decode(vector["function"], bytes.fromhex(vector["payload"]))


def test_valid_frames_in_both_directions() -> None:
    for vector in FRAMES["valid"]:
        frame = Frame(vector["function"], vector["sequence"], bytes.fromhex(vector["payload"]))
        sent = encode_frame(frame.function, frame.sequence, frame.payload)
        assert (sent, FrameDecoder().feed(sent)) == (bytes.fromhex(vector["frame"]), [frame])


@pytest.mark.parametrize("vector", FRAMES["streams"], ids=lambda vector: vector["name"])
def test_streams_give_the_frames_and_counts_written_down(vector: dict[str, Any]) -> None:
    decoder = FrameDecoder()
    assert decoder.feed(bytes.fromhex(vector["bytes"])) == [
        Frame(f["function"], f["sequence"], bytes.fromhex(f["payload"])) for f in vector["frames"]
    ]
    assert decoder.statistics == FramingStatistics(**vector["statistics"])


def test_the_examples_of_the_readme_are_true() -> None:
    examples = re.findall(
        r"```frame\n([0-9a-f ]+)\n```\n\n\| bytes \| meaning \|\n\| --- \| --- \|\n((?:\|.*\n)+)", PAGE
    )
    open_ends = Switches.LEFT_OPEN | Switches.RIGHT_OPEN
    whole = re.findall(r"^\| (?:host|device): (\w+), sequence (\d+),.* \| `([0-9a-f ]+)` \|$", PAGE, re.MULTILINE)
    shown: tuple[tuple[int, Message], ...] = (
        (42, Drive(left_duty=0.125, right_duty=0.1234, mode=DriveMode.RUN, counter=200)),
        (42, State(left_position_mm=-12.0, right_position_mm=-12.1, device_time_s=0.25, counter=0)),
        (0, Hello(SCHEMA_HASH, PROTOCOL_VERSION, nonce=255)),
        (17, Identity(SCHEMA_HASH, firmware_major=1, firmware_minor=0, serial_number=1)),
        (60, Home(nonce=1)),
        (93, Status(DeviceMode.HOMING, open_ends, DeviceFault(0), 25.0, 12.0, drive_counter=44, command_nonce=1)),
    )
    for (name, number, line), (sequence, message) in zip(whole, shown[2:], strict=True):
        assert (name, int(number), bytes.fromhex(line)) == (
            type(message).__name__,
            sequence,
            encode_frame(FUNCTION[type(message)], sequence, encode(message)),
        )
    for (line, rows), (sequence, message) in zip(examples, shown[:2], strict=True):
        assert bytes.fromhex(line) == encode_frame(FUNCTION[type(message)], sequence, encode(message))
        assert f"function {FUNCTION[type(message)]}, {type(message).__name__} |" in rows
        assert " ".join(re.findall(r"^\| `([0-9a-f ]+)` \|", rows, re.MULTILINE)) == line


def test_the_crcs_of_the_readmes_examples_are_over_what_it_says() -> None:
    checked = re.findall(r"^\| `([0-9a-f ]+)` \| CRC-(8|16) over `([0-9a-f ]+)` \|$", PAGE, re.MULTILINE)
    assert len(checked) == 3
    for crc, width, data in checked:
        assert int.from_bytes(bytes.fromhex(crc), "big") == (bitwise_crc8 if width == "8" else bitwise_crc16)(
            bytes.fromhex(data)
        )


def test_the_readme_says_which_way_round_the_schema_hash_is() -> None:
    assert f"`{SCHEMA_HASH.to_bytes(4, 'big').hex(' ')} ..` is 0x{SCHEMA_HASH:08X}" in PAGE
    assert f"`{SCHEMA_HASH.to_bytes(4, 'little').hex(' ')}`)" in PAGE


def test_the_readmes_timing_is_what_the_codecs_frames_take() -> None:
    for message in (Drive(0.0, 0.0, DriveMode.OFF, 1), State(0, 0, 0, 1)):
        payload = encode(message)
        serial_ms = 0.01 * len(encode_frame(FUNCTION[type(message)], 0, payload))
        # ISO 11898-1 with the most stuffing: a bit for every four after the first of 34 + 8 n
        can_ms = 0.001 * (47 + 8 * len(payload) + (34 + 8 * len(payload) - 1) // 4)
        said = {Drive: "a Drive is at most {:.2f} ms on its way", State: "on its way, a State {:.2f} ms."}[
            type(message)
        ]
        assert said.format(max(serial_ms, math.ceil(100 * can_ms) / 100)) in PAGE


# -- the C codec and framing; which value stands where, its twin in Python tells (test_c_device.py) --------------------


def test_under_sanitizers_c_knows_the_same_payloads_in_both_directions(exchange) -> None:
    answers = exchange([f"decode {vector['function']} {vector['payload']}" for vector in MESSAGES["valid"]])
    assert answers == [f"ok {vector['payload']}" for vector in MESSAGES["valid"]]


def test_c_refuses_the_same_payloads(library: ctypes.CDLL) -> None:
    results = set()
    for vector in MESSAGES["invalid"]:
        message, payload = ctypes.create_string_buffer(64), bytes.fromhex(vector["payload"])
        function, length = ctypes.c_uint8(vector["function"]), ctypes.c_size_t(len(payload))
        results.add(library.tormag_decode(message, function, payload, length))
    assert results == {1, 2, 3, 4}, "0 is taken"


@pytest.mark.parametrize(
    ("function", "step", "result"), [(2, 0, 0), (2, 0xFF, 4), (7, 0xFF, 4), (10, 0, 1), (0, 0, 1)], ids=str
)
def test_c_sends_no_step_out_of_range_and_no_unknown_function(
    library: ctypes.CDLL, function: int, step: int, result: int
) -> None:
    """Every byte of the signals is `step`; a mode of 255 is none."""
    payload, length = ctypes.create_string_buffer(MAX_PAYLOAD), ctypes.c_size_t()
    assert library.tormag_encode(payload, ctypes.byref(length), bytes((function, *[step] * 63))) == result


def test_under_sanitizers_c_frames_the_golden_payloads(exchange) -> None:
    vectors = FRAMES["valid"]
    asked = [f"frame {vector['function']} {vector['sequence']} {vector['payload'] or '-'}" for vector in vectors]
    assert exchange(asked) == [vector["frame"] for vector in vectors]
    assert exchange([f"frame 1 1 {'00' * (MAX_PAYLOAD + 1)}"]) == ["-"]


def test_under_sanitizers_golden_streams_are_read_as_written_down(exchange) -> None:
    requests, expected = [], []
    for vector in FRAMES["streams"]:
        requests += ["restart", f"stream {vector['bytes']}"]
        frames = [f"{frame['function']}:{frame['sequence']}:{frame['payload'] or '-'}" for frame in vector["frames"]]
        counts = [str(vector["statistics"][name]) for name in FramingStatistics.__match_args__]
        expected += ["-", " ".join([*frames, *counts])]
    assert exchange(requests) == expected
