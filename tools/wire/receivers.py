"""What hears the fuzzed traffic: the host's Python, and the firmware's C99 under sanitizers."""

import subprocess
from collections.abc import Iterator, Sequence
from itertools import zip_longest

from firmware_protocol.c.build import BuildError, Target, build
from firmware_protocol.codec import (
    SCHEMA_HASH,
    DecodeError,
    DeviceFault,
    DeviceMode,
    Identity,
    Message,
    Sense,
    State,
    Status,
    Switches,
    decode,
)
from firmware_protocol.framing import Frame, FrameDecoder, FramingStatistics
from tormagd.hardware.link import DeviceLink
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import FirmwareKind
from tormagd.simulation.firmware import Answer, Firmware, Sensors
from tormagd.simulation.parameters import load_plant

LINE_BYTES = 4000
"""Bytes in one request to the C filter; its lines end at 8192 characters."""
TIME_LIMIT_S = 600
PERIOD_S = 1e-3
AT_REST = Sensors(0, 0, 0.0, 0.0, 0.0, 0, Switches(0), 12.0, 25.0)

Payload = tuple[int, bytes]


def receive_stream(data: bytes, piece: int) -> tuple[list[Frame], FramingStatistics]:
    """What the host's frame decoder makes of a stream that comes in pieces of `piece` bytes."""
    decoder = FrameDecoder()
    frames: list[Frame] = []
    for start in range(0, len(data), piece):
        frames += decoder.feed(data[start : start + piece])
    return frames, decoder.statistics


def accepted(payloads: Sequence[Payload]) -> list[Message | None]:
    """What the host's codec makes of each payload; None where it refuses."""
    messages: list[Message | None] = []
    for function, payload in payloads:
        try:
            messages.append(decode(function, payload))
        except DecodeError:
            messages.append(None)
    return messages


def measured(messages: Sequence[Message | None]) -> Iterator[bool]:
    """Whether each message gave the daemon's link a new measurement."""
    link = DeviceLink(0.0)
    for first in (
        Identity(SCHEMA_HASH, 1, 0, 1),
        Status(DeviceMode.IDLE, Switches.HOMED, DeviceFault(0), 25.0, 12.0, 0, 0),
        Sense(0.0, 0.0, 0.0, 0.0),
        State(0.0, 0.0, 0.0, 255),
    ):
        link.receive(0.0, first)
    for tick, message in enumerate(messages, start=1):
        before = link.measurement
        if message is not None:
            link.receive(tick * PERIOD_S, message)
        assert before is not None
        assert link.measurement is not None
        yield link.measurement.number != before.number


def answered(messages: Sequence[Message | None], boot: FirmwareKind) -> Iterator[bool]:
    """Whether the firmware accepted each message, and so answered it."""
    firmware = boot(load_plant("sample_1"))
    for tick, message in enumerate(messages, start=1):
        yield message is not None and firmware.receive(tick * PERIOD_S, message, AT_REST) is not Answer.NONE


def firmware_kind() -> FirmwareKind:
    """The firmware's C sources where they can be built, else their Python twin."""
    try:
        CompiledFirmware(load_plant("sample_1"))
    except BuildError:
        return Firmware
    return CompiledFirmware


class SanitizedFirmware:
    """Framing and codec of the firmware, compiled with the address and undefined-behaviour sanitizers.

    A sanitizer's complaint ends the program (`firmware_protocol/c/host/exchange.c`), and raises CalledProcessError.
    """

    def __init__(self) -> None:
        """Raises BuildError without a C compiler or its sanitizers."""
        self._program = build(Target.SANITIZED_EXCHANGE)

    def differences(
        self,
        data: bytes,
        frames: Sequence[Frame],
        statistics: FramingStatistics,
        payloads: Sequence[Payload],
        messages: Sequence[Message | None],
    ) -> int:
        """How many frames and counts of the stream, and verdicts on payloads, are not those of the host."""
        stream = [f"stream {data[at : at + LINE_BYTES].hex()}" for at in range(0, len(data), LINE_BYTES)]
        answers = self._ask([*stream, *(f"decode {function} {_hexed(payload)}" for function, payload in payloads)])
        received: list[str] = []
        counted = [str(getattr(statistics, name)) for name in FramingStatistics.__match_args__]
        counts = ["0"] * len(counted)
        for answer in answers[: len(stream)]:
            words = answer.split(" ")
            received += words[: -len(counts)]
            counts = words[-len(counts) :]
        expected = [f"{frame.function}:{frame.sequence}:{_hexed(frame.payload)}" for frame in frames]
        verdicts = ["refused" if answer.startswith("refused ") else answer for answer in answers[len(stream) :]]
        ours = [
            "refused" if message is None else f"ok {_hexed(payload)}"
            for (_, payload), message in zip(payloads, messages, strict=True)
        ]
        return _unequal(received, expected) + _unequal(counts, counted) + _unequal(verdicts, ours)

    def _ask(self, requests: Sequence[str]) -> list[str]:
        text = "".join(f"{request}\n" for request in requests)
        done = subprocess.run(
            [self._program], input=text, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=True
        )
        return done.stdout.splitlines()


def _hexed(data: bytes) -> str:
    """As the filter writes bytes."""
    return data.hex() or "-"


def _unequal(one: Sequence[str], other: Sequence[str]) -> int:
    return sum(a != b for a, b in zip_longest(one, other))
