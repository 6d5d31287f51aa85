"""The golden vectors, and the worked examples of the README, in both directions."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import firmware_protocol
from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    DecodeError,
    Drive,
    DriveMode,
    Message,
    State,
    can_identifier,
    decode,
    encode,
)
from firmware_protocol.framing import Frame, FrameDecoder, FramingStatistics, encode_frame
from firmware_protocol.layouts import LAYOUTS

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
    messages: tuple[Message, ...] = (
        Drive(left_duty=0.125, right_duty=0.1234, mode=DriveMode.RUN, counter=200),
        State(left_position_mm=-12.0, right_position_mm=-12.1, device_time_s=0.25, counter=0),
    )
    for (line, rows), message in zip(examples, messages, strict=True):
        assert bytes.fromhex(line) == encode_frame(FUNCTION[type(message)], 42, encode(message))
        annotated = re.findall(r"^\| `([0-9a-f ]+)` \|", rows, re.MULTILINE)
        assert " ".join(annotated) == line
