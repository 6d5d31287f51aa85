"""The golden vectors, and what the README shows: its examples in both directions, its times, its table of modes."""

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

import firmware_protocol
from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DecodeError,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    State,
    Status,
    Switches,
    can_identifier,
    decode,
    encode,
)
from firmware_protocol.framing import Frame, FrameDecoder, FramingStatistics, encode_frame
from firmware_protocol.golden import bitwise_crc8, bitwise_crc16
from firmware_protocol.layouts import LAYOUTS
from tormagd.simulation.firmware import Answer, Firmware, Sensors
from tormagd.simulation.parameters import load_plant

ROOM = Path(firmware_protocol.__file__).parent
MESSAGES: dict[str, Any] = json.loads((ROOM / "vectors" / "messages.json").read_text(encoding="utf-8"))
FRAMES: dict[str, Any] = json.loads((ROOM / "vectors" / "frames.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("document", [MESSAGES, FRAMES], ids=["messages", "frames"])
def test_vectors_are_of_this_schema(document: dict[str, Any]) -> None:
    assert document["schema_hash"] == f"{SCHEMA_HASH:08X}"
    assert document["protocol_version"] == PROTOCOL_VERSION


def test_every_message_has_vectors() -> None:
    assert {vector["message"] for vector in MESSAGES["valid"]} == {layout.message.__name__ for layout in LAYOUTS}


def test_valid_payloads_in_both_directions() -> None:
    types = {layout.message.__name__: layout.message for layout in LAYOUTS}
    for vector in MESSAGES["valid"]:
        payload = bytes.fromhex(vector["payload"])
        message = types[vector["message"]](**vector["values"])
        assert encode(message) == payload, vector
        assert decode(vector["function"], payload) == message, vector
        assert can_identifier(FUNCTION[type(message)]) == vector["can_identifier"]


@pytest.mark.parametrize("vector", MESSAGES["invalid"], ids=lambda vector: f"{vector['reason']} {vector['payload']}")
def test_invalid_payloads_are_refused(vector: dict[str, Any]) -> None:
    with pytest.raises(DecodeError):
        decode(vector["function"], bytes.fromhex(vector["payload"]))


def test_valid_frames_in_both_directions() -> None:
    for vector in FRAMES["valid"]:
        frame = Frame(vector["function"], vector["sequence"], bytes.fromhex(vector["payload"]))
        encoded = bytes.fromhex(vector["frame"])
        assert encode_frame(frame.function, frame.sequence, frame.payload) == encoded
        assert FrameDecoder().feed(encoded) == [frame]


@pytest.mark.parametrize("vector", FRAMES["streams"], ids=lambda vector: vector["name"])
def test_streams_give_the_frames_and_counts_written_down(vector: dict[str, Any]) -> None:
    decoder = FrameDecoder()
    received = decoder.feed(bytes.fromhex(vector["bytes"]))
    assert received == [Frame(f["function"], f["sequence"], bytes.fromhex(f["payload"])) for f in vector["frames"]]
    assert decoder.statistics == FramingStatistics(**vector["statistics"])


def test_the_examples_of_the_readme_are_true() -> None:
    text = (ROOM / "README.md").read_text(encoding="utf-8")
    examples = re.findall(
        r"```frame\n([0-9a-f ]+)\n```\n\n\| bytes \| meaning \|\n\| --- \| --- \|\n((?:\|.*\n)+)", text
    )
    open_ends = Switches.LEFT_OPEN | Switches.RIGHT_OPEN
    shown: tuple[tuple[int, Message], ...] = (
        (42, Drive(left_duty=0.125, right_duty=0.1234, mode=DriveMode.RUN, counter=200)),
        (42, State(left_position_mm=-12.0, right_position_mm=-12.1, device_time_s=0.25, counter=0)),
        (0, Hello(SCHEMA_HASH, PROTOCOL_VERSION, nonce=255)),
        (17, Identity(SCHEMA_HASH, firmware_major=1, firmware_minor=0, serial_number=1)),
        (60, Home(nonce=1)),
        (93, Status(DeviceMode.HOMING, open_ends, DeviceFault(0), 25.0, 12.0, drive_counter=44, command_nonce=1)),
    )
    for (line, rows), (sequence, message) in zip(examples, shown, strict=True):
        assert bytes.fromhex(line) == encode_frame(FUNCTION[type(message)], sequence, encode(message))
        assert f"function {FUNCTION[type(message)]}, {type(message).__name__} |" in rows
        annotated = re.findall(r"^\| `([0-9a-f ]+)` \|", rows, re.MULTILINE)
        assert " ".join(annotated) == line


def test_the_crcs_of_the_readmes_examples_are_over_what_it_says() -> None:
    text = (ROOM / "README.md").read_text(encoding="utf-8")
    checked = re.findall(r"^\| `([0-9a-f ]+)` \| CRC-(8|16) over `([0-9a-f ]+)` \|$", text, re.MULTILINE)
    assert len(checked) == 4
    for crc, width, data in checked:
        expected = bitwise_crc8 if width == "8" else bitwise_crc16
        assert int.from_bytes(bytes.fromhex(crc), "big") == expected(bytes.fromhex(data))


def test_the_readme_says_which_way_round_the_schema_hash_is() -> None:
    text = (ROOM / "README.md").read_text(encoding="utf-8")
    assert f"`{SCHEMA_HASH.to_bytes(4, 'big').hex(' ')} ..` is 0x{SCHEMA_HASH:08X}" in text
    assert f"`{SCHEMA_HASH.to_bytes(4, 'little').hex(' ')}`)" in text


def test_the_readmes_timing_is_what_the_codecs_frames_take() -> None:
    """At 1 Mbaud a byte takes 10 us, at 1 Mbit/s a bit takes 1."""
    text = (ROOM / "README.md").read_text(encoding="utf-8")
    for message, said in (
        (Drive(0.0, 0.0, DriveMode.OFF, 1), "Drive on its way"),
        (State(0, 0, 0, 1), "State on its way"),
    ):
        payload = encode(message)
        serial_ms = 0.01 * len(encode_frame(FUNCTION[type(message)], 0, payload))
        # ISO 11898-1 with the most stuffing: a bit for every four after the first of the 34 + 8 n that are stuffed
        can_ms = 0.001 * (47 + 8 * len(payload) + (34 + 8 * len(payload) - 1) // 4)
        assert f"| {said} | {serial_ms:.2f} ms serial, at most {math.ceil(100 * can_ms) / 100:.2f} ms CAN |" in text


# -- what each mode takes, as the page says --------------------------------------------------------------------------

AT_REST = Sensors(0, 0, 0.0, 0.0, 0.0, 0, Switches(0), 12.0, 25.0)
ASKED = 0.25
"""A duty."""


def in_mode(mode: DeviceMode) -> Firmware:
    """A homed device that has met its host, brought there by what a host says."""
    firmware = Firmware(load_plant("sample_1"))
    firmware.receive(0.0, Hello(SCHEMA_HASH, PROTOCOL_VERSION, 255), AT_REST)
    firmware.homed = True
    before: dict[DeviceMode, tuple[Message, ...]] = {
        DeviceMode.IDLE: (),
        DeviceMode.RUN: (Drive(0.0, 0.0, DriveMode.RUN, 1),),
        DeviceMode.HOMING: (Home(1),),
        DeviceMode.RETRACTING: (Retract(1),),
        DeviceMode.LATCHED: (Hello(SCHEMA_HASH ^ 1, PROTOCOL_VERSION, 255), Hello(SCHEMA_HASH, PROTOCOL_VERSION, 255)),
    }
    for message in before[mode]:
        firmware.receive(0.0, message, AT_REST)
    assert firmware.mode is mode
    return firmware


SAID: dict[str, Message] = {
    "Drive OFF": Drive(0.0, 0.0, DriveMode.OFF, 2),
    "Drive RUN": Drive(ASKED, 0.0, DriveMode.RUN, 2),
    "Hello that fits": Hello(SCHEMA_HASH, PROTOCOL_VERSION, 9),
    "Hello that does not": Hello(SCHEMA_HASH ^ 1, PROTOCOL_VERSION, 9),
    "Retract": Retract(9),
    "Home": Home(9),
    "Clear": Clear(9),
}


def taken() -> list[tuple[str, DeviceMode, str]]:
    """The cells of the page's table: what is said, in which mode, and what comes of it."""
    text = (ROOM / "README.md").read_text(encoding="utf-8")
    head, _, *rows = re.findall(r"^\|(.*)\|$", text.partition("### What each mode takes")[2].partition("###")[0], re.M)
    modes = [DeviceMode[name.strip()] for name in head.split("|")[1:]]
    cells = [[cell.strip() for cell in row.split("|")] for row in rows]
    return [(said, mode, what) for said, *row in cells for mode, what in zip(modes, row, strict=True)]


def test_the_table_of_the_page_is_whole() -> None:
    assert [(said, mode) for said, mode, _ in taken()] == [(said, mode) for said in SAID for mode in DeviceMode]


@pytest.mark.parametrize(("said", "mode", "what"), taken())
def test_the_firmware_does_what_the_pages_table_says(said: str, mode: DeviceMode, what: str) -> None:
    firmware = in_mode(mode)
    answer = firmware.receive(0.001, SAID[said], AT_REST)
    first = re.match(r"\w+", what)
    assert first is not None
    assert firmware.mode is DeviceMode.__members__.get(first[0], mode)
    nonce = firmware.status(AT_REST).command_nonce
    if said.startswith("Drive"):
        assert answer is Answer.MEASUREMENT
        assert (firmware.output.left_duty == ASKED) == (firmware.mode is DeviceMode.RUN)
    elif said.startswith("Hello"):
        assert (answer, nonce) == (Answer.IDENTITY, 9)
        assert (DeviceFault.SCHEMA_MISMATCH in firmware.faults) == ("not" in said or mode is DeviceMode.LATCHED)
    else:
        assert (answer, nonce == 9) == (Answer.NONE, what != "refused")
    if "not homed" in what:
        assert not firmware.homed
