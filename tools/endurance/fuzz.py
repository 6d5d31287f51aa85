"""Damaged serial frames and CAN payloads through the host's decoder and the firmware's.

Every damage starts from valid traffic. After each run of damaged serial frames come two clean ones; the second must
arrive, or the decoder did not find back in time. A false accept is a message that was not sent, or given twice in a
row. Where the carrier was right, it is a payload taken for a message that is none. It is allowed as often as chance
gives it at the odds of the CRC, one judgement in 2^16 or 2^8. It is never allowed where the odds are 0. The bound is a
count that chance exceeds once in a million runs. `wrong_frames` had a right CRC-16 and were not sent. They are allowed
likewise.

Both languages hear all of it, the C99 under sanitizers, and must agree in every frame, count and verdict.
"""

import random
import struct
import subprocess
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise, zip_longest
from typing import Any

from scipy import stats
from tqdm import tqdm

from firmware_protocol.c.build import BuildError, Target, build
from firmware_protocol.codec import (
    FUNCTION,
    Clear,
    DecodeError,
    Drive,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    crc8,
    decode,
)
from firmware_protocol.framing import MAX_PAYLOAD, Frame, FrameDecoder, FramingStatistics, encode_frame
from firmware_protocol.layouts import LAYOUTS
from firmware_protocol.schema import Layout, Signal
from tormagd.hardware.can_stream import CanStream

CHUNK = 8_192
"Damaged frames of one kind at once."
BURSTS = (1, 4, 16)
"Damaged frames between clean ones."
PIECES = (3, 16, 300, 4096)
"Bytes fed at once."
CAN_SHARE, CAN_FD_PAYLOAD = 0.1, 48
NODE = 1
EDGES = 0.3
"Share of signals at zero or at an end of their range: zeros are what COBS is about."
CRC16_ODDS, CRC8_ODDS = 2.0**-16, 2.0**-8
CHANCE = 1e-6
LINE_BYTES = 4000
"Bytes in one request to the C filter; its lines end at 8192 characters."
TIME_LIMIT_S = 600
HEARD_BY = {"device": (Drive, Retract, Clear, Home, Hello), "host": (State, Sense, Status, Identity)}
"The first is the one that a CRC-8 protects, the last has a 32-bit number, by which a clean frame is known again."
RANGED = {"device": Drive, "host": Status}
UNKNOWN = sorted(set(range(128)) - set(FUNCTION.values()))
Payload = tuple[int, bytes]
"Function and payload."


class Fuzz:
    """One run. `program` is the firmware's framing and codec under sanitizers, empty where it cannot be built."""

    def __init__(self, program: str = "") -> None:
        self._program = program
        self.tallies: dict[str, Counter[str]] = {}
        self.runs = self.lost_second = self.differences = 0

    def serial(self, kind: str, receiver: str, rng: random.Random, count: int) -> None:
        """Frames that the line damages, or whole frames with bad payloads, with clean frames between."""
        burst, piece = rng.choice(BURSTS), rng.choice(PIECES)
        sent: set[bytes] = set()
        clean: list[bytes] = []
        line = bytearray()
        frame = encode_frame(*_numbered(0, drawn(rng, receiver)))
        for number in range(1, count + 1):
            if kind in WIRE_DAMAGE:
                before, body = frame, drawn(rng, receiver)
                frame = encode_frame(*_numbered(number, body))
                line += damaged(kind, rng, frame, before)
            else:
                body = spoilt(kind, rng, receiver, MAX_PAYLOAD)
                line += encode_frame(*_numbered(number, body))
            sent.add(_known(number, body))
            if number % burst == 0 or number == count:
                for _ in range(2):
                    body = _anchor(receiver, len(clean))
                    clean.append(_known(len(clean), body))
                    line += encode_frame(*_numbered(len(clean) - 1, body))
        frames, statistics = heard(bytes(line), piece)
        received = [_known(each.sequence, (each.function, each.payload)) for each in frames]
        come, expected = set(received), set(clean)
        self.runs += len(clean) // 2
        self.lost_second += sum(each not in come for each in clean[1::2])
        unclean = [each for each in received if each not in expected]
        surplus = [each for each in unclean if each not in sent]
        surplus += [each for each, before in pairwise(received) if each == before]
        payloads = [(each[0], each[2:]) for each in unclean]
        verdicts = accepted(payloads)
        self.differences += self._differences(bytes(line), frames, statistics, payloads, verdicts)
        judged = count
        if kind in WIRE_DAMAGE:
            verdicts = accepted([(each[0], each[2:]) for each in surplus])
            judged = statistics.corrupt + len(surplus)
        self._count(f"serial: {kind}", count, judged, verdicts, len(surplus))

    def can(self, kind: str, receiver: str, rng: random.Random, count: int) -> None:
        """Bad payloads in good CAN frames."""
        payloads = [spoilt(kind, rng, receiver, CAN_FD_PAYLOAD) for _ in range(count)]
        verdicts = accepted(payloads)
        self.differences += self._differences(b"", [], FramingStatistics(), payloads, verdicts)
        if receiver == "host":
            stream = CanStream(NODE)
            verdicts = [stream.unpack(function << 4 | NODE, payload) for function, payload in payloads]
        self._count(f"CAN: {kind}", count, count, verdicts, 0)

    def _count(self, kind: str, frames: int, judged: int, verdicts: Sequence[Message | None], wrong: int) -> None:
        accepts = sum(message is not None for message in verdicts)
        tally = self.tallies.setdefault(kind, Counter())
        tally.update(frames=frames, judged=judged, false_accepts=accepts, wrong_frames=wrong)

    def _differences(
        self,
        data: bytes,
        frames: Sequence[Frame],
        statistics: FramingStatistics,
        payloads: Sequence[Payload],
        messages: Sequence[Message | None],
    ) -> int:
        """How many frames and counts of the stream, and verdicts on payloads, the firmware's C has otherwise."""
        if not self._program:
            return 0
        stream = [f"stream {data[at : at + LINE_BYTES].hex()}" for at in range(0, len(data), LINE_BYTES)]
        asked = [*stream, *(f"decode {function} {payload.hex() or '-'}" for function, payload in payloads)]
        text = "".join(f"{line}\n" for line in asked)
        # a sanitizer's complaint ends the program (firmware_protocol/c/host/exchange.c)
        done = subprocess.run(
            [self._program], input=text, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=True
        )
        answers = done.stdout.splitlines()
        theirs: list[str] = []
        counted = [str(getattr(statistics, name)) for name in FramingStatistics.__match_args__]
        counts = ["0"] * len(counted)
        for answer in answers[: len(stream)]:
            words = answer.split(" ")
            theirs += words[: -len(counts)]
            counts = words[-len(counts) :]
        theirs += counts
        theirs += ["refused" if answer.startswith("refused ") else answer for answer in answers[len(stream) :]]
        ours = [f"{frame.function}:{frame.sequence}:{frame.payload.hex() or '-'}" for frame in frames] + counted
        ours += [
            "refused" if message is None else f"ok {payload.hex() or '-'}"
            for (_, payload), message in zip(payloads, messages, strict=True)
        ]
        return sum(one != other for one, other in zip_longest(ours, theirs))


def run(count: int, seed: int) -> dict[str, Any]:
    """`count` damaged frames, a tenth of them on CAN; the figures, and `failures`."""
    try:
        program, decoder = str(build(Target.SANITIZED_EXCHANGE)), "C99 under sanitizers"
    except BuildError as error:
        program, decoder = "", str(error)
    fuzz = Fuzz(program)
    can = round(CAN_SHARE * count)
    tasks = [(fuzz.serial, kind, to, count - can) for to in HEARD_BY for kind in (*WIRE_DAMAGE, *PAYLOAD_DAMAGE)]
    on_can = [(fuzz.can, kind, to, can) for to in HEARD_BY for kind in PAYLOAD_DAMAGE]
    with tqdm(total=count, desc="fuzz", unit="frame", unit_scale=True, disable=None) as progress:
        for task, kind, receiver, frames in tasks + on_can:
            share = max(1, frames // (len(on_can) if task == fuzz.can else len(tasks)))
            for start in range(0, share, CHUNK):
                name = f"{seed} {task.__name__} {kind} {receiver} {start}"
                try:
                    task(kind, receiver, random.Random(name), min(CHUNK, share - start))
                except Exception as error:
                    error.add_note(f"fuzz: {name}")
                    raise
            progress.update(share)
    return {
        "frames": sum(tally["frames"] for tally in fuzz.tallies.values()),
        "device_decoder": decoder,
        "false_accepts": sum(tally["false_accepts"] for tally in fuzz.tallies.values()),
        "runs_of_damage": fuzz.runs,
        "second_lost": fuzz.lost_second,
        "languages_differ": fuzz.differences,
        "kinds": fuzz.tallies,
        "failures": failures(fuzz),
    }


def failures(fuzz: Fuzz) -> list[str]:
    """What did not hold, in words."""
    found = []
    for kind, tally in fuzz.tallies.items():
        damage = kind.partition(": ")[2]
        odds = {
            "false_accepts": PAYLOAD_DAMAGE[damage][0] if damage in PAYLOAD_DAMAGE else CRC16_ODDS,
            "wrong_frames": CRC16_ODDS if damage in WIRE_DAMAGE else 0.0,
        }
        for what, chance in odds.items():
            allowed = int(stats.binom.isf(CHANCE, tally["judged"], chance)) if chance else 0
            if tally[what] > allowed:
                found.append(f"{kind}: {tally[what]} {what}, allowed {allowed}")
    if fuzz.lost_second:
        found.append(f"not resynchronised within two frames: {fuzz.lost_second} times")
    if fuzz.differences:
        found.append(f"Python and C differ {fuzz.differences} times")
    return found


# -- traffic and damage --------------------------------------------------------------------------------------------


def drawn(rng: random.Random, receiver: str, kind: type[Message] | None = None) -> Payload:
    """A valid message for that receiver with random steps, of any kind where none is said."""
    layout = _layout(kind or rng.choice(HEARD_BY[receiver]))
    return layout.function, _packed(layout, [_step(rng, signal) for signal in layout.signals])


def _layout(kind: type[Message]) -> Layout:
    return next(layout for layout in LAYOUTS if layout.message is kind)


def _step(rng: random.Random, signal: Signal) -> int:
    if rng.random() < EDGES:
        return rng.choice((signal.lowest, max(signal.lowest, 0), signal.highest))
    return rng.randint(signal.lowest, signal.highest)


def _packed(layout: Layout, steps: list[int]) -> bytes:
    """The payload, with the right CRC-8 where there is one."""
    if not layout.protected:
        return struct.pack(layout.format, *steps)
    data = struct.pack(layout.format, *steps, 0)[:-1]
    return data + bytes((crc8(bytes((layout.function,)) + data),))


def _anchor(receiver: str, number: int) -> Payload:
    layout = _layout(HEARD_BY[receiver][-1])
    return layout.function, struct.pack("<I", number).ljust(struct.calcsize(layout.format), b"\0")


def _numbered(number: int, body: Payload) -> tuple[int, int, bytes]:
    return body[0], number % 256, body[1]


def _known(number: int, body: Payload) -> bytes:
    return bytes((body[0], number % 256)) + body[1]


WIRE_DAMAGE: dict[str, Callable[[random.Random, bytes, bytes, int, int], bytes]] = {
    "1 to 3 bits flipped": lambda rng, frame, *_: _flipped(frame, rng.sample(range(8 * len(frame)), rng.randint(1, 3))),
    "burst of up to 16 bits": lambda rng, frame, *_: _flipped(frame, _burst(rng, len(frame), 16)),
    "bytes overwritten": lambda rng, frame, _, start, end: (
        frame[:start] + rng.randbytes(end + 1 - start) + frame[end + 1 :]
    ),
    "bytes cut out": lambda _rng, frame, _, start, end: frame[:start] + frame[end + 1 :],
    "bytes inserted": lambda rng, frame, _, start, _end: (
        frame[:start] + rng.randbytes(rng.randint(1, 4)) + frame[start:]
    ),
    # COBS's 1 before the delimiter taken away where it stands, and put where it does not
    "a zero more or less at the end": lambda _, frame, *__: (
        frame[:-2] + b"\0" if frame[-2] == 1 else frame[:-1] + b"\1\0"
    ),
    "delimiters inserted": lambda rng, frame, _, start, _end: frame[:start] + bytes(rng.randint(1, 3)) + frame[start:],
    "delimiter lost": lambda _, frame, *__: frame[:-1],
    "two frames spliced": lambda rng, frame, other, *_: (
        frame[: rng.randrange(1, len(frame))] + other[rng.randrange(1, len(other)) :]
    ),
    "frame repeated": lambda rng, frame, *_: frame * rng.randint(2, 3),
    "noise": lambda rng, *_: rng.randbytes(rng.randint(1, 40)),
}
"""What a line does to sealed frames, of a frame, what went before it, and two of its places. None of these should give
a frame that was not sent."""


def damaged(kind: str, rng: random.Random, frame: bytes, other: bytes) -> bytes:
    """A sealed frame that a line has damaged; `other` went before it. Raises KeyError for an unknown kind."""
    start, end = sorted((rng.randrange(len(frame)), rng.randrange(len(frame))))
    return WIRE_DAMAGE[kind](rng, frame, other, start, end)


Spoils = Callable[[random.Random, str, int, int, bytes], Payload]
"Makes a wrong payload for a receiver, of at most so many bytes, of a valid function and payload."
PAYLOAD_DAMAGE: dict[str, tuple[float, Spoils]] = {
    "CRC-8: 1 or 2 bits flipped": (
        0.0,
        lambda rng, _receiver, _longest, function, payload: (
            function,
            _flipped(payload, rng.sample(range(8 * len(payload)), rng.randint(1, 2))),
        ),
    ),
    "CRC-8: burst of up to 8 bits": (
        0.0,
        lambda rng, _receiver, _longest, function, payload: (function, _flipped(payload, _burst(rng, len(payload), 8))),
    ),
    # all in range, and another counter than that of the message whose CRC-8 it is
    "CRC-8: of another message": (
        CRC8_ODDS,
        lambda rng, receiver, _longest, function, payload: (
            function,
            drawn(rng, receiver, HEARD_BY[receiver][0])[1][:-2]
            + bytes(((payload[-2] + rng.randint(1, 255)) % 256, payload[-1])),
        ),
    ),
    "CRC-8: random payload": (
        CRC8_ODDS,
        lambda rng, _receiver, _longest, function, payload: (function, rng.randbytes(len(payload))),
    ),
    "wrong length": (
        0.0,
        lambda rng, _receiver, longest, function, payload: (
            function,
            (payload + rng.randbytes(longest))[
                : rng.choice([*range(len(payload)), *range(len(payload) + 1, longest + 1)])
            ],
        ),
    ),
    "out of range or enumeration": (
        0.0,
        lambda rng, receiver, _longest, _function, _payload: _out_of_range(rng, _layout(RANGED[receiver])),
    ),
    "unknown function": (0.0, lambda rng, _receiver, _longest, _function, payload: (rng.choice(UNKNOWN), payload)),
}
"What is wrong in a payload that the carrier brought whole, and the odds that the codec takes it for a message."


def spoilt(kind: str, rng: random.Random, receiver: str, longest: int) -> Payload:
    """A payload of at most `longest` bytes that the codec has to refuse. Raises KeyError for an unknown kind."""
    valid = drawn(rng, receiver, HEARD_BY[receiver][0] if kind.startswith("CRC-8") else None)
    return PAYLOAD_DAMAGE[kind][1](rng, receiver, longest, *valid)


def _out_of_range(rng: random.Random, layout: Layout) -> Payload:
    """One signal, of those whose type holds more than their range does, at a step outside of it."""
    steps = [_step(rng, signal) for signal in layout.signals]
    spans = [256 ** struct.calcsize(f"<{code}") for code in layout.format[1:]]
    roomy = [at for at, one in enumerate(layout.signals) if one.highest - one.lowest + 1 < spans[at]]
    at = rng.choice(roomy)
    signal, span = layout.signals[at], spans[at]
    step = rng.randrange(span - (signal.highest - signal.lowest + 1))
    step -= span // 2 if layout.format[1 + at].islower() else 0
    steps[at] = step + (signal.highest - signal.lowest + 1 if step >= signal.lowest else 0)
    return layout.function, _packed(layout, steps)


def _flipped(data: bytes, bits: list[int]) -> bytes:
    """With these bits turned, counted from the first byte's highest."""
    number = int.from_bytes(data, "big")
    for bit in bits:
        number ^= 1 << (8 * len(data) - 1 - bit)
    return number.to_bytes(len(data), "big")


def _burst(rng: random.Random, length: int, span: int) -> list[int]:
    """A first bit, and any of the next `span` - 1 that there are."""
    first = rng.randrange(8 * length)
    return [first, *(bit for bit in range(first + 1, min(first + span, 8 * length)) if rng.random() < 0.5)]


# -- who hears it --------------------------------------------------------------------------------------------------


def heard(data: bytes, piece: int) -> tuple[list[Frame], FramingStatistics]:
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
