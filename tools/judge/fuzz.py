"""libFuzzer's bytes, put to the firmware's codec, framing and device under address and undefined sanitizers.

The corpus begins with the golden vectors and with runs that lead through every mode. What must hold besides the
sanitizers is in `firmware_protocol/c/fuzz`: a payload is taken only with the right CRC-8, a frame only if encoding it
gives its own bytes again, so a false accept is no more likely than the CRC's odds. Python then hears what was found for
codec and framing, and must agree with the C in every frame, count and verdict.
"""

import json
import os
import re
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import firmware_protocol
from firmware_protocol.c.build import BuildError, Target, build
from firmware_protocol.codec import DecodeError, crc8, decode
from firmware_protocol.framing import MAX_PAYLOAD, FrameDecoder, FramingStatistics, encode_frame
from firmware_protocol.layouts import LAYOUTS

VECTORS = Path(firmware_protocol.__file__).parent / "vectors"
LINE_BYTES = 4000
PROTECTED = {layout.function for layout in LAYOUTS if layout.protected}
HELLO, HOME, CLEAR, RETRACT, RELEASE = (b"\x1e\0", b"\x06\0", b"\x0e\0", b"\x16\0", b"\x26\0")
WAIT, CLOSE, OPEN, MEND = b"\xf8", b"\xff\x30", b"\xff\xd0", b"\x03"
"Operations of firmware_protocol/c/fuzz/device.c: 125 ticks, and 32 Drives of RUN."
ARMED = HELLO + HOME + 11 * WAIT + 4 * CLOSE
RESTED = MEND + 8 * WAIT + CLEAR


def run(seconds: int, seed: int) -> dict[str, Any]:
    try:
        program = build(Target.FUZZ)
    except BuildError as error:
        return {"skipped": str(error), "failures": []}
    with TemporaryDirectory() as folder:
        executions, failures = Counter[str](), list[str]()
        for name, seeds in SEEDS.items():
            corpus = Path(folder) / name
            corpus.mkdir()
            for number, data in enumerate(seeds()):
                (corpus / f"{number:04}").write_bytes(data)
            share_s = max(1, round(seconds / len(SEEDS)))
            # the corpus and what was found are run to their end too, however slow the machine was
            for bound in (f"-max_total_time={share_s}", "-runs=0"):
                executed, failed = fuzzed(program, corpus, seed, bound)
                executions[name] += executed
                failures += failed
        found = {name: [path.read_bytes() for path in sorted((Path(folder) / name).iterdir())] for name in SEEDS}
    differ = differences(found["codec"], found["framing"])
    if differ:
        failures.append(f"Python and C differ {differ} times")
    return {
        "executions": executions,
        "inputs": {name: len(inputs) for name, inputs in found.items()},
        "languages_differ": differ,
        "failures": failures,
    }


def fuzzed(program: Path, corpus: Path, seed: int, bound: str) -> tuple[int, list[str]]:
    """Return how many inputs ran within libFuzzer's `bound`, and what failed, with its bytes."""
    name, crashes = corpus.name, corpus.with_name(f"{corpus.name}-crash-")
    command = [
        *(str(program), str(corpus), bound, f"-seed={seed}", "-print_final_stats=1", f"-artifact_prefix={crashes}"),
        *("-max_len=512", "-timeout=120"),
    ]
    environment = os.environ | {"TORMAG_FUZZ": name}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", check=False)
    executed = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    if done.returncode == 0:
        return int(executed[1]) if executed else 0, []
    why = re.search(r"does not hold: .*|runtime error: .*|ERROR: .*", done.stderr)
    inputs = [path.read_bytes().hex() for path in corpus.parent.glob(f"{crashes.name}*")]
    reason = why[0] if why else done.stderr[-500:] or f"exit status {done.returncode}"
    return int(executed[1]) if executed else 0, [f"{name}: {reason}: {', '.join(inputs)}"]


# -- what it begins with -------------------------------------------------------------------------------------------


def payloads() -> Iterator[bytes]:
    vectors = json.loads((VECTORS / "messages.json").read_text(encoding="utf-8"))
    for vector in (*vectors["valid"], *vectors["invalid"]):
        yield bytes((vector["function"],)) + bytes.fromhex(vector["payload"])


def streams() -> Iterator[bytes]:
    vectors = json.loads((VECTORS / "frames.json").read_text(encoding="utf-8"))
    for text in [
        *(vector["frame"] for vector in vectors["valid"]),
        *(vector["bytes"] for vector in vectors["streams"]),
    ]:
        yield in_pieces(bytes.fromhex(text), 127, lambda size: size)


def lives() -> Iterator[bytes]:
    vectors = json.loads((VECTORS / "frames.json").read_text(encoding="utf-8"))
    for vector in vectors["valid"]:
        yield in_pieces(bytes.fromhex(vector["frame"]), 31, lambda size: size << 3 | 4)
    for vector in vectors["valid"][::3]:
        said = b"\x05" + bytes((vector["function"],)) + bytes.fromhex(vector["payload"])
        yield ARMED + 2 * said + 2 * OPEN + 4 * WAIT
    for what in range(32):
        spoil = bytes((what << 3 | 2,))
        for value, other in ((b"\x00\x14", b"\x00\x0c"), (b"\xff\x7f", b"\x00\x80")):
            yield ARMED + spoil + value + 4 * OPEN + 8 * WAIT + RESTED
            yield ARMED + spoil + value + 2 * WAIT + spoil + other + 2 * WAIT + RESTED
    for end in (RELEASE, RETRACT, 4 * WAIT, b"\x01\x20", 9 * OPEN, HELLO, HOME, CLEAR):
        yield ARMED + end + 6 * WAIT + HOME + RESTED + HELLO


def in_pieces(data: bytes, most: int, head: Callable[[int], int]) -> bytes:
    """Return a stream as a harness reads it: each piece after a byte that `head` makes of its size."""
    pieces = [data[at : at + most] for at in range(0, len(data), most)]
    return b"".join(bytes((head(len(piece)),)) + piece for piece in pieces)


SEEDS: dict[str, Callable[[], Iterator[bytes]]] = {"codec": payloads, "framing": streams, "device": lives}


# -- both languages ------------------------------------------------------------------------------------------------


def differences(of_codec: list[bytes], of_framing: list[bytes]) -> int:
    """Return how many frames, counts and verdicts differ between Python and the C under sanitizers."""
    heard = [one for data in of_codec if data for one in (data, sealed(data))]
    requests, ours = [], []
    for data in heard:
        requests.append(f"decode {data[0]} {data[1:].hex() or '-'}")
        ours.append(verdict(data[0], data[1:]))
    for data in of_framing:
        line, decoder = line_of(data), FrameDecoder()
        requests.append("restart")
        ours.append("-")
        for at in range(0, len(line), LINE_BYTES):
            piece = line[at : at + LINE_BYTES]
            requests.append(f"stream {piece.hex()}")
            frames = [f"{one.function}:{one.sequence}:{one.payload.hex() or '-'}" for one in decoder.feed(piece)]
            counts = [str(getattr(decoder.statistics, name)) for name in FramingStatistics.__match_args__]
            ours.append(" ".join(frames + counts))
    text = "".join(f"{request}\n" for request in requests)
    # a sanitizer's complaint ends the program (firmware_protocol/c/host/exchange.c)
    done = subprocess.run([build(Target.SANITIZED_EXCHANGE)], input=text, capture_output=True, text=True, check=True)
    theirs = [re.sub(r"^refused .*", "refused", answer) for answer in done.stdout.splitlines()]
    return sum(one != other for one, other in zip_longest(ours, theirs))


def verdict(function: int, payload: bytes) -> str:
    try:
        decode(function, payload)
    except DecodeError:
        return "refused"
    return f"ok {payload.hex() or '-'}"


def sealed(data: bytes) -> bytes:
    """Return an input of the codec with the right CRC-8, if its function has one."""
    return data[:-1] + bytes((crc8(data[:-1]),)) if data[0] in PROTECTED and len(data) > 1 else data


def line_of(data: bytes) -> bytes:
    """Return the stream of an input of the framing, as firmware_protocol/c/fuzz/framing.c reads it."""
    line, at = bytearray(), 0
    while at < len(data):
        piece, at = data[at], at + 1
        if piece < 128 or len(data) - at < 2:
            line += data[at : at + piece]
            at += piece
            continue
        payload = data[at + 2 : at + 2 + (piece & 15)]
        if len(payload) <= MAX_PAYLOAD:
            line += encode_frame(data[at], data[at + 1], payload)
        at += 2 + (piece & 15)
    return bytes(line)
