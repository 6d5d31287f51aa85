"""The C codec and framing against the golden vectors and against Python, in both directions, also under sanitizers."""

import ctypes
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import firmware_protocol
from firmware_protocol.codec import DecodeError, decode
from firmware_protocol.framing import MAX_PAYLOAD, FrameDecoder, encode_frame
from firmware_protocol.layouts import LAYOUTS
from firmware_protocol.schema import Layout

Exchange = Callable[[list[str]], list[str]]

ROOM = Path(firmware_protocol.__file__).parent
MESSAGES: dict[str, Any] = json.loads((ROOM / "vectors" / "messages.json").read_text(encoding="utf-8"))
FRAMES: dict[str, Any] = json.loads((ROOM / "vectors" / "frames.json").read_text(encoding="utf-8"))
STEP_TYPES = {
    "b": ctypes.c_int8,
    "B": ctypes.c_uint8,
    "h": ctypes.c_int16,
    "H": ctypes.c_uint16,
    "I": ctypes.c_uint32,
}
OK, UNKNOWN_FUNCTION, OUT_OF_RANGE = 0, 1, 4
REFUSALS = 4


def structure(layout: Layout) -> type[ctypes.Structure]:
    """struct tormag_..._t of a message."""
    names = [signal.name for signal in layout.signals] + ["crc"] * layout.protected
    fields = [(name, STEP_TYPES[code]) for name, code in zip(names, layout.format[1:], strict=True)]
    return type(layout.message.__name__, (ctypes.Structure,), {"_fields_": fields})


class Signals(ctypes.Union):
    _fields_ = [(layout.message.__name__, structure(layout)) for layout in LAYOUTS]


class CMessage(ctypes.Structure):
    """struct tormag_message."""

    _fields_ = [("function", ctypes.c_uint8), ("signals", Signals)]


class Codec:
    """tormag_decode and tormag_encode in terms of steps."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library

    def decode(self, function: int, payload: bytes) -> tuple[int, dict[str, int]]:
        """The result and, if it is OK, the steps of the message's signals."""
        message = CMessage()
        result = self._library.tormag_decode(
            ctypes.byref(message), ctypes.c_uint8(function), payload, ctypes.c_size_t(len(payload))
        )
        layout = next((layout for layout in LAYOUTS if layout.function == function), None)
        if result != OK or layout is None:
            return result, {}
        assert message.function == function
        steps = getattr(message.signals, layout.message.__name__)
        return result, {signal.name: getattr(steps, signal.name) for signal in layout.signals}

    def encode(self, function: int, name: str, steps: dict[str, int]) -> tuple[int, bytes]:
        """The result and, if it is OK, the payload; a checksum field is filled with what must not be sent."""
        message = CMessage(function=function)
        signals = getattr(message.signals, name)
        for signal, step in steps.items():
            setattr(signals, signal, step)
        if hasattr(signals, "crc"):
            signals.crc = 0xA5
        payload = ctypes.create_string_buffer(MAX_PAYLOAD)
        length = ctypes.c_size_t()
        result = self._library.tormag_encode(payload, ctypes.byref(length), ctypes.byref(message))
        return result, payload.raw[: length.value]


@pytest.fixture(scope="module")
def codec(library: ctypes.CDLL) -> Codec:
    return Codec(library)


def hexed(data: bytes) -> str:
    """As the exchange program writes bytes."""
    return data.hex() or "-"


# -- payloads ------------------------------------------------------------------------------------------------------


def test_valid_payloads_in_both_directions(codec: Codec) -> None:
    for vector in MESSAGES["valid"]:
        payload = bytes.fromhex(vector["payload"])
        assert codec.decode(vector["function"], payload) == (OK, vector["steps"]), vector
        assert codec.encode(vector["function"], vector["message"], vector["steps"]) == (OK, payload), vector


def test_invalid_payloads_are_refused(codec: Codec) -> None:
    results = set()
    for vector in MESSAGES["invalid"]:
        result, _ = codec.decode(vector["function"], bytes.fromhex(vector["payload"]))
        assert result != OK, vector
        results.add(result)
    assert results == set(range(1, REFUSALS + 1))


def test_steps_out_of_range_are_not_sent(codec: Codec) -> None:
    drive = {"left_duty": 0, "right_duty": 0, "mode": 0, "counter": 0}
    assert codec.encode(2, "Drive", drive)[0] == OK
    for signal, step in {"left_duty": 10001, "right_duty": -10001, "mode": 2}.items():
        assert codec.encode(2, "Drive", drive | {signal: step})[0] == OUT_OF_RANGE
    assert codec.encode(7, "Status", {"faults": 1024})[0] == OUT_OF_RANGE
    assert codec.encode(10, "Drive", drive)[0] == codec.encode(0, "Drive", drive)[0] == UNKNOWN_FUNCTION


def random_payloads(generator: random.Random, count: int) -> list[tuple[int, bytes]]:
    """Functions with payloads: golden ones, as they are or damaged, and noise of every length."""
    golden = [(vector["function"], bytes.fromhex(vector["payload"])) for vector in MESSAGES["valid"]]
    payloads = golden + [(vector["function"], bytes.fromhex(vector["payload"])) for vector in MESSAGES["invalid"]]
    while len(payloads) < count:
        function, payload = generator.choice(golden)
        match generator.randrange(4):
            case 0:
                payload = generator.randbytes(generator.randrange(12))
            case 1:
                payload = generator.randbytes(len(payload))
            case 2:
                payload = bytes(byte ^ (1 << generator.randrange(8)) * (generator.random() < 0.2) for byte in payload)
            case _:
                function = generator.randrange(256)
        payloads.append((function, payload))
    return payloads


def test_under_sanitizers_every_payload_is_accepted_or_refused_as_by_python(exchange: Exchange) -> None:
    payloads = random_payloads(random.Random(20240512), 6000)
    answers = exchange([f"decode {function} {hexed(payload)}" for function, payload in payloads])
    accepted = 0
    for (function, payload), answer in zip(payloads, answers, strict=True):
        try:
            decode(function, payload)
        except DecodeError:
            assert answer.startswith("refused "), (function, payload.hex(), answer)
        else:
            accepted += 1
            assert answer == f"ok {hexed(payload)}"
    assert 1000 < accepted < 5000


# -- frames --------------------------------------------------------------------------------------------------------


def test_under_sanitizers_any_payload_is_framed_as_by_python(exchange: Exchange) -> None:
    generator = random.Random(20240513)
    frames = []
    for _ in range(2000):
        length = generator.randrange(MAX_PAYLOAD + 1)
        # zeros are what COBS is about
        payload = bytes(generator.choice((0, 0, 1, 255, generator.randrange(256))) for _ in range(length))
        frames.append((generator.randrange(256), generator.randrange(256), payload))
    answers = exchange([f"frame {function} {sequence} {hexed(payload)}" for function, sequence, payload in frames])
    assert answers == [encode_frame(*frame).hex() for frame in frames]
    assert exchange([f"frame 1 1 {'00' * (MAX_PAYLOAD + 1)}"]) == ["-"]


def received_by_python(decoder: FrameDecoder, data: bytes) -> str:
    """The answer that the exchange program should give to a piece of a stream."""
    frames = decoder.feed(data)
    seen = decoder.statistics
    counts = (seen.bytes, seen.frames, seen.corrupt, seen.lost, seen.repeated, seen.resynchronisations)
    return "".join(f"{f.function}:{f.sequence}:{hexed(f.payload)} " for f in frames) + " ".join(map(str, counts))


def test_under_sanitizers_golden_and_damaged_streams_are_read_as_by_python(
    exchange: Exchange,
) -> None:
    generator = random.Random(20240514)
    traffic = bytearray()
    sequence = 0
    for function, payload in random_payloads(generator, 4000):
        frame = bytearray(encode_frame(function, sequence, payload[:MAX_PAYLOAD]))
        sequence = (sequence + (generator.random() > 0.02) + (generator.random() < 0.02)) % 256
        match generator.randrange(12):
            case 0:
                frame[generator.randrange(len(frame))] ^= 1 << generator.randrange(8)
            case 1:
                del frame[generator.randrange(len(frame))]
            case 2:
                frame.insert(generator.randrange(len(frame)), generator.randrange(256))
            case 3:
                frame *= 2
            case 4:
                frame += generator.randbytes(generator.randrange(40))
        traffic += frame
    requests, expected = [], []
    for vector in FRAMES["streams"]:
        requests += ["restart", f"stream {vector['bytes']}"]
        expected += ["-", received_by_python(FrameDecoder(), bytes.fromhex(vector["bytes"]))]
    requests.append("restart")
    expected.append("-")
    decoder = FrameDecoder()
    position = 0
    while position < len(traffic):
        piece = bytes(traffic[position : position + generator.choice((1, 2, 5, 14, 60, 400))])
        position += len(piece)
        requests.append(f"stream {piece.hex()}")
        expected.append(received_by_python(decoder, piece))
    assert exchange(requests) == expected
    statistics = decoder.statistics
    assert all(getattr(statistics, name) > 50 for name in statistics.__match_args__)
