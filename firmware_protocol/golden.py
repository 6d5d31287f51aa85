"""Golden vectors: bytes that every implementation of the wire must produce, read and refuse.

They are independent of this package's codec and framing: cantools packs the payloads, the CRCs are computed bit by bit,
and the `cobs` package stuffs the frames. What a receiver must make of a damaged stream is written down by hand.
"""

import json
import random
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import cantools
from cobs import cobs  # type: ignore[import-untyped]

from firmware_protocol.dbc import MessageSource, Schema, steps_held

RANDOM_VECTORS: Final = 8
RANDOM_SEED: Final = 20240229

Json = dict[str, Any]


def bitwise_crc(data: bytes, bits: int, polynomial: int) -> int:
    """Return a CRC straight from its definition."""
    register = ones = (1 << bits) - 1
    for byte in data:
        register ^= byte << bits - 8
        for _ in range(8):
            register = (register << 1) ^ (polynomial | ones + 1 if register & (ones + 1) >> 1 else 0)
    return register ^ ones


bitwise_crc8 = partial(bitwise_crc, bits=8, polynomial=0x1D)
"CRC-8/SAE-J1850."
bitwise_crc16 = partial(bitwise_crc, bits=16, polynomial=0x1021)
"CRC-16/GENIBUS."


def vector_files(schema: Schema, dbc: Path) -> dict[str, str]:
    database = cantools.database.load_file(dbc, database_format="dbc", strict=True)
    valid = [vector for message in schema.messages for vector in _valid_payloads(message, database)]
    head = {"protocol_version": schema.version, "schema_hash": f"{schema.schema_hash():08X}"}
    messages = head | {"valid": valid, "invalid": list(_invalid_payloads(schema, valid))}
    frames = head | {"valid": _valid_frames(valid), "streams": _streams()}
    return {"messages.json": _text(messages), "frames.json": _text(frames)}


def _text(document: Json) -> str:
    blocks = []
    for key, value in document.items():
        lines = ",\n".join(f"    {json.dumps(entry)}" for entry in value) if isinstance(value, list) else None
        blocks.append(f'  "{key}": ' + (json.dumps(value) if lines is None else f"[\n{lines}\n  ]"))
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def _valid_payloads(message: MessageSource, database: Any) -> Iterator[Json]:
    """Yield payloads of a message: all signals at their least, at their greatest, and at random."""
    generator = random.Random(f"{RANDOM_SEED} {message.name}")
    fields = message.fields
    cases = [tuple(signal.steps[0] for signal in fields), tuple(signal.steps[1] for signal in fields)]
    cases += [tuple(generator.randint(*signal.steps) for signal in fields) for _ in range(RANDOM_VECTORS)]
    for steps in cases:
        raw = {signal.name: step for signal, step in zip(fields, steps, strict=True)}
        payload = _packed(message, raw, database)
        yield {
            "message": message.name,
            "function": message.function,
            "can_identifier": message.frame_id,
            "steps": raw,
            "values": {
                signal.name: step * signal.scale if signal.python_type == "float" else step
                for signal, step in zip(fields, steps, strict=True)
            },
            "payload": payload.hex(),
        }


def _packed(message: MessageSource, steps: dict[str, int], database: Any) -> bytes:
    """Return the payload of raw steps with its CRC-8, also of steps out of range."""
    checksum = {message.signals[-1].name: 0} if message.protected else {}
    target = database.get_message_by_name(message.name)
    payload = bytes(target.encode(steps | checksum, scaling=False, strict=False))
    if not message.protected:
        return payload
    return payload[:-1] + bytes((bitwise_crc8(bytes((message.function,)) + payload[:-1]),))


def _invalid_payloads(schema: Schema, valid: list[Json]) -> Iterator[Json]:
    """Yield payloads to refuse, with the reason."""

    def refused(function: int, payload: bytes, reason: str) -> Json:
        return {"function": function, "payload": payload.hex(), "reason": reason}

    for function in (0, max(message.function for message in schema.messages) + 1, 0xFF):
        yield refused(function, bytes(8), "unknown function")
    for message in schema.messages:
        payload = bytes.fromhex(next(v["payload"] for v in reversed(valid) if v["message"] == message.name))
        yield refused(message.function, payload[:-1], f"{message.name} a byte short")
        yield refused(message.function, payload + b"\x00", f"{message.name} a byte long")
        yield refused(message.function, b"", f"{message.name} without payload")
        if message.protected:
            for bit in range(0, 8 * len(payload), 7):
                flipped = (int.from_bytes(payload, "big") ^ 1 << bit).to_bytes(len(payload), "big")
                yield refused(message.function, flipped, f"{message.name} with one bit flipped")
            for other in schema.messages:
                if other is not message and other.protected and other.length == len(payload):
                    yield refused(other.function, payload, f"{message.name} taken for {other.name}")
        for signal in message.fields:
            lowest, highest = steps_held(signal.length, signal.signed)
            for step in (signal.steps[0] - 1, signal.steps[1] + 1):
                if not lowest <= step <= highest:
                    continue
                body = bytearray(payload)
                first, count = signal.start // 8, signal.length // 8
                body[first : first + count] = step.to_bytes(count, "little", signed=signal.signed)
                if message.protected:
                    body[-1] = bitwise_crc8(bytes((message.function,)) + body[:-1])
                yield refused(
                    message.function, bytes(body), f"{message.name}.{signal.name} out of range at step {step}"
                )


def _checked(function: int, sequence: int, payload: bytes) -> bytes:
    body = bytes((function, sequence)) + payload
    return body + bitwise_crc16(body).to_bytes(2, "big")


def _ended(checked: bytes) -> bytes:
    return bytes(cobs.encode(checked)) + b"\x00"


def _stuffed(function: int, sequence: int, payload: bytes) -> bytes:
    return _ended(_checked(function, sequence, payload))


def _valid_frames(messages: list[Json]) -> list[Json]:
    return [
        {
            "function": vector["function"],
            "sequence": sequence,
            "payload": vector["payload"],
            "frame": _stuffed(vector["function"], sequence, bytes.fromhex(vector["payload"])).hex(),
        }
        for sequence, vector in enumerate(messages)
    ]


def _streams() -> list[Json]:
    """Return byte streams, each with the frames and counters that a receiver must take from it."""
    payload = bytes.fromhex("0011002233440055")
    a, b, c, d = (_stuffed(3, sequence, payload) for sequence in (254, 255, 0, 1))
    flipped = b[:4] + bytes((b[4] ^ 0x10,)) + b[5:]
    short = _ended(bytes((3, 255, 0)))
    bare = _ended(b"\x00\x00")  # the CRC of nothing, and nothing
    another = _stuffed(8, 254, b"\x01")
    # not the longest payload, which one zero more makes too long, whatever the CRC
    longer = _ended(_checked(3, 255, payload[:-1]) + b"\x00")
    shorter = _ended(next(body for n in range(256) if (body := _checked(3, 255, bytes((n,))))[-1] == 0)[:-1])

    def stream(name: str, data: bytes, frames: list[bytes], **counts: int) -> Json:
        expected = [cobs.decode(frame[:-1])[:-2] for frame in frames]
        statistics = {"corrupt": 0, "lost": 0, "repeated": 0, "resynchronisations": 0} | counts
        return {
            "name": name,
            "bytes": data.hex(),
            "frames": [{"function": e[0], "sequence": e[1], "payload": e[2:].hex()} for e in expected],
            "statistics": {"bytes": len(data), "frames": len(frames)} | statistics,
        }

    damaged = {"corrupt": 1, "lost": 1, "resynchronisations": 1}
    return [
        stream("four in a row, sequence through zero", a + b + c + d, [a, b, c, d]),
        stream("idle zeros between frames", b"\x00\x00" + a + b"\x00" + b, [a, b]),
        stream("one bit flipped", a + flipped + c, [a, c], **damaged),
        stream("cut off in the middle", a + b[:6] + c + d, [a, d], corrupt=1, lost=2, resynchronisations=1),
        stream("delimiter gone", a + b[:-1] + c + d, [a, d], corrupt=1, lost=2, resynchronisations=1),
        stream("zero inside a frame", a + b[:6] + b"\x00" + b[6:] + c, [a, c], corrupt=2, lost=1, resynchronisations=1),
        stream("noise, then a frame", b"\x55\xaa\xff\x01" + a + b + c, [b, c], corrupt=1, resynchronisations=1),
        stream("too long", a + b"\x07" * 300 + b"\x00" + b, [a, b], corrupt=1, resynchronisations=1),
        stream("too short", a + short + c, [a, c], **damaged),
        stream("a CRC without a header", a + bare + c, [a, c], **damaged),
        stream("a byte more than a whole frame", a + b[:-1] + b"\x01\x00" + c, [a, c], **damaged),
        stream("a zero more than a whole frame", a + longer + c, [a, c], **damaged),
        stream("a zero less than a whole frame", a + shorter + c, [a, c], **damaged),
        stream("COBS distance past the end", a + b"\x09\x01\x02\x00" + c, [a, c], **damaged),
        stream("one missing", a + c + d, [a, c, d], lost=1),
        stream("one overtaken", a + c + b + d, [a, c, b, d]),
        stream("a late repetition", a + b + c + a + d, [a, b, c, a, d]),
        stream("the same frame twice", a + b + b + c, [a, b, c], repeated=1),
        stream("same sequence, another frame", a + another + b, [a, another, b], repeated=1),
        stream("unfinished", a + b[:-1], [a]),
    ]
