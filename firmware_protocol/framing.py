"""Serial frames: which bytes of a stream belong together, and whether they arrived whole.

    COBS( function u8 | sequence u8 | payload 0..8 | CRC-16/GENIBUS u16, big-endian ) 0x00

COBS takes the zeros out of a frame, so that a zero on the line always ends a frame. After any disturbance the receiver
finds the next frame behind the next zero. The sequence counts the frames of one direction modulo 256.
"""

from binascii import crc_hqx
from typing import ClassVar, Final, final

from firmware_protocol.codec import EncodeError
from firmware_protocol.value import Value

DELIMITER: Final = b"\x00"
CRC_INITIAL: Final = 0xFFFF
CRC_FINAL_XOR: Final = 0xFFFF
CRC_RESIDUE: Final = 0x1D0F
"""Register after data and their own CRC. It is not 0, so a zero more or less at the end shows."""
CRC_LENGTH: Final = 2
HEADER_LENGTH: Final = 2
MAX_PAYLOAD: Final = 8
OVERTAKEN: Final = 16
"A frame whose sequence is behind the newest by less was overtaken or repeated, or its sender began anew."
ALL_MISSING: Final = (1 << (OVERTAKEN - 1)) - 1
MAX_ENCODED: Final = 1 + HEADER_LENGTH + MAX_PAYLOAD + CRC_LENGTH
"""Longest frame before its delimiter; under 254 bytes, COBS adds exactly one."""
_BYTES: Final = [bytes((byte,)) for byte in range(256)]
_DISTANCES: Final = _BYTES[1:-1]
"""The byte that COBS puts before a run without zeros, by the run's length."""


@final
class Frame(Value):
    """One frame that arrived whole. Its payload may still be no message."""

    def __init__(self, function: int, sequence: int, payload: bytes) -> None:
        self.function: Final = function
        self.sequence: Final = sequence
        self.payload: Final = payload


@final
class FramingStatistics(Value):
    __match_args__ = ("bytes", "frames", "corrupt", "lost", "repeated", "resynchronisations")

    def __init__(
        self,
        bytes: int = 0,
        frames: int = 0,
        corrupt: int = 0,
        lost: int = 0,
        repeated: int = 0,
        resynchronisations: int = 0,
    ) -> None:
        self.bytes, self.frames, self.repeated = bytes, frames, repeated
        self.corrupt = corrupt
        """Stretches between two delimiters that were not a frame."""
        self.lost = lost
        """Frames missing from the sequence, including corrupt ones, but not overtaken ones."""
        self.resynchronisations = resynchronisations
        """Frames found again after something corrupt."""
        self.unsent = 0
        """Sent frames that the port did not take at once."""
        self.refused: dict[str, str] = {}
        """Why the newest was refused, by "frame" or the name of a message."""


@final
class Succession:
    """Counts the numbers that are missing from a sequence modulo 256."""

    __match_args__: ClassVar = ("_missing", "newest")
    __slots__ = __match_args__

    def __init__(self) -> None:
        self.newest = -2  # before the first
        self._missing = 0  # of the OVERTAKEN before the newest, a bit each, the nearest lowest

    def lost(self, number: int) -> int:
        """Take the next number; return the change in how many are missing."""
        ahead = (number - self.newest) % 256
        if ahead == 1:  # as nearly always
            self.newest = number
            self._missing = self._missing << 1 & ALL_MISSING
            return 0
        if self.newest < 0:
            self.newest = number
            return 0
        behind = (256 - ahead) % 256
        if behind < OVERTAKEN:
            bit = 1 << behind >> 1
            if not self._missing & bit:
                return 0
            self._missing ^= bit
            return -1
        self.newest = number
        # all that lie between the two are missing, the nearest first
        missing = ALL_MISSING if ahead >= OVERTAKEN else (self._missing << ahead) | ((1 << (ahead - 1)) - 1)
        self._missing = missing & ALL_MISSING
        return ahead - 1


def cobs_encode(data: bytes) -> bytes:
    """Return `data` (under 254 bytes) without zeros, one byte longer."""
    encoded = b""
    for run in data.split(DELIMITER):
        encoded += _DISTANCES[len(run)] + run
    return encoded


def cobs_decode(data: bytes) -> bytes | None:
    """Invert `cobs_encode`; None if the distances do not end where `data` does."""
    length = len(data)
    if length == 0:
        return b""
    end = data[0]
    decoded = data[1:end]
    while end < length:
        position = end
        end += data[position]
        decoded += DELIMITER + data[position + 1 : end]
    return decoded if end == length else None


def encode_frame(function: int, sequence: int, payload: bytes) -> bytes:
    if not (0 <= function <= 0xFF and 0 <= sequence <= 0xFF and len(payload) <= MAX_PAYLOAD):
        raise EncodeError(
            f"frame of function {function}, sequence {sequence}, {len(payload)} bytes: "
            f"allowed are 0 to 255, 0 to 255, 0 to {MAX_PAYLOAD}"
        )
    body = _BYTES[function] + _BYTES[sequence] + payload
    crc = crc_hqx(body, CRC_INITIAL) ^ CRC_FINAL_XOR
    return cobs_encode(body + crc.to_bytes(CRC_LENGTH, "big")) + DELIMITER


@final
class FrameDecoder:
    """Decodes a byte stream, in pieces of any size, into frames."""

    __match_args__: ClassVar = ("_last", "_pending", "_succession", "_synchronised", "statistics")
    __slots__ = __match_args__

    def __init__(self) -> None:
        self.statistics = FramingStatistics()
        self._pending = b""
        self._last: Frame | None = None
        self._succession = Succession()
        self._synchronised = True

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that `data` completes, in order."""
        self.statistics.bytes += len(data)
        stretches = data.split(DELIMITER)
        rest = stretches.pop()
        frames: list[Frame] = []
        for stretch in stretches:
            if self._pending:
                stretch = self._pending + stretch
                self._pending = b""
            if stretch:
                frame = self._accept(stretch)
                if frame is not None:
                    frames.append(frame)
        if rest:
            # one byte over the longest frame is kept, enough to know at its end that it is too long
            self._pending = (self._pending + rest[: MAX_ENCODED + 1])[: MAX_ENCODED + 1]
        return frames

    def _accept(self, encoded: bytes) -> Frame | None:
        """Count the bytes between two delimiters, and return their frame, unless it is corrupt or repeated."""
        statistics = self.statistics
        frame = _parse(encoded)
        if isinstance(frame, str):
            statistics.corrupt += 1
            statistics.refused["frame"] = frame
            self._synchronised = False
            return None
        if not self._synchronised:
            statistics.resynchronisations += 1
            self._synchronised = True
        last = self._last
        self._last = frame
        if last is not None and frame.sequence == last.sequence:
            statistics.repeated += 1
            if frame.function == last.function and frame.payload == last.payload:
                return None
        statistics.lost += self._succession.lost(frame.sequence)
        statistics.frames += 1
        return frame


def _parse(encoded: bytes) -> Frame | str:
    """Return the frame between two delimiters, or in a few words which check it failed."""
    if len(encoded) > MAX_ENCODED:
        return f"over {MAX_ENCODED} bytes"
    body = cobs_decode(encoded)
    if body is None:
        return "COBS"
    if len(body) < HEADER_LENGTH + CRC_LENGTH:
        return "too short"
    if crc_hqx(body, CRC_INITIAL) != CRC_RESIDUE:
        return "CRC-16"
    return Frame(body[0], body[1], body[HEADER_LENGTH:-CRC_LENGTH])
