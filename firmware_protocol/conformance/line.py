"""Lines carry frames between the kit and a device, have a clock, and can send damaged frames."""

from collections.abc import Mapping
from itertools import product
from typing import Any, Final, Protocol, TypeAlias

from firmware_protocol.codec import can_identifier
from firmware_protocol.framing import (
    DELIMITER,
    MAX_ENCODED,
    FrameDecoder,
    FramingStatistics,
    cobs_decode,
    cobs_encode,
    encode_frame,
)

NODES, NO_FUNCTION = 16, 127
NOISE: Final = bytes((0x55, 0xAA, 0xFF, 0x01, 0x7E, 0x80, 0x0D, 0x0A, 0x11, 0x13)) * 3
"Not a frame; it includes bytes that a terminal acts on: XON and XOFF, CR and LF."


TOO_MANY: Final = (1, 2, 5, 8, 12, 13, 14, 15, 16, 32, 64, 128, 243, 256)
"Bytes too many, where a buffer's end may cut them off."


Arrival: TypeAlias = tuple[float, int, bytes]
"""When a frame came, its function, and its payload."""


class Port(Protocol):
    """A serial port, or a CAN bus for classical frames with 11-bit identifiers; and a clock, real or virtual."""

    def now_s(self) -> float:
        """Return a time that never falls."""

    def write(self, *data: Any) -> None:
        """Send bytes; on a bus a frame, by its identifier and data. Raises OSError when the port is gone."""

    def read(self, until_s: float) -> list[Any]:
        """Wait until `until_s`; return what came: the time, on a bus the identifier, the data. Raises OSError when the
        port is gone.
        """

    def close(self) -> None:
        """Close the port."""


class SerialLine:
    """One conversation with a device, in frames of COBS and CRC-16 on a serial port."""

    def __init__(self, port: Port) -> None:
        self.port = port
        self._decoder = FrameDecoder()
        self._sequence, self._has_begun = 0, False
        port.write(DELIMITER)  # ends whatever was there before

    def send(self, function: int, payload: bytes) -> None:
        self.port.write(self._frame(function, payload))

    def damages(self, function: int, payload: bytes) -> Mapping[str, tuple[bytes, ...]]:
        """Return damaged forms of a frame, by the kind of damage, which a device has to ignore."""
        body = self._frame(function, payload)[:-1]
        whole = cobs_decode(body) or b""
        last = whole.rfind(DELIMITER) + 1
        damaged = {
            "a bit": [
                cobs_encode(whole[:at] + bytes((whole[at] ^ 1 << bit,)) + whole[at + 1 :])
                for at, bit in product(range(len(whole)), range(8))
            ],
            "two bytes exchanged": sorted(
                {cobs_encode(whole[:at] + whole[at : at + 2][::-1] + whole[at + 2 :]) for at in range(len(whole) - 1)}
                - {body}
            ),
            "CRC-16 without its final XOR": [
                cobs_encode(whole[:-2] + (int.from_bytes(whole[-2:], "big") ^ 0xFFFF).to_bytes(2, "big"))
            ],
            "cut off": [body[:length] for length in range(1, len(body))],
            "a zero inside": [body[:at] + DELIMITER + body[at:] for at in range(1, len(body))],
            "COBS that points too far": [body[:last] + bytes((body[last] + 1,)) + body[last + 1 :]],
            "too long": [body + b"\x07" * many for many in TOO_MANY] + [body[:-1] * 3],
            "too long before": [b"\x07" * many + body for many in TOO_MANY],
            "noise": [NOISE, NOISE[: MAX_ENCODED - 2], NOISE * 40],
        }
        return {what: tuple(form + DELIMITER for form in forms) for what, forms in damaged.items()}

    def unusual(self, function: int, payload: bytes) -> tuple[tuple[int, tuple[bytes, ...]], ...]:
        """Return writes, and how many of their frames count."""
        sequence = self._sequence
        first, second, third, fourth, fifth = (self._frame(function, payload) for _ in range(5))
        beside = encode_frame(NO_FUNCTION, (sequence + 4) % 256, payload)
        other = encode_frame(function, (sequence + 4) % 256, payload[:-1] + bytes((payload[-1] ^ 1,)))
        return (
            (1, (first, DELIMITER + first, first)),
            (1, (DELIMITER * 3 + second + DELIMITER * 3,)),
            (1, (third[:5], third[5:])),
            (1, (fourth, NOISE + DELIMITER)),
            (3, (beside, fifth, other, fifth)),
            *((1, (encode_frame(function, (sequence + leap) % 256, payload),)) for leap in (105, 95, 205, 25)),
        )

    def send_damaged(self, unit: bytes) -> None:
        self.port.write(unit)

    def receive(self, until_s: float) -> list[Arrival]:
        """Wait until `until_s`, and return the whole frames that came."""
        arrivals = [
            (time_s, frame.function, frame.payload)
            for time_s, data in self.port.read(until_s)
            for frame in self._decoder.feed(data)
        ]
        if arrivals and not self._has_begun:
            self._has_begun, self._decoder.statistics = True, FramingStatistics()
        return arrivals

    def _frame(self, function: int, payload: bytes) -> bytes:
        frame = encode_frame(function, self._sequence, payload)
        self._sequence = (self._sequence + 1) % 256
        return frame

    @property
    def frame_errors(self) -> dict[str, int]:
        """What was wrong with the device's frames, and how often."""
        statistics = self._decoder.statistics
        errors = {
            f"not a frame ({statistics.refused.get('frame', '')})": statistics.corrupt - (not self._has_begun),
            # a damaged frame is missing too, and is one error
            "missing from the sequence": statistics.lost - statistics.corrupt,
            "sequence number repeated": statistics.repeated,
        }
        return {what: count for what, count in errors.items() if count > 0}


class CanLine:
    """One conversation with a node on a CAN bus."""

    def __init__(self, port: Port, node: int) -> None:
        self.port, self._node = port, node
        self._others: set[int] = set()
        self.frame_errors: dict[str, int] = {}

    def send(self, function: int, payload: bytes) -> None:
        self.port.write(can_identifier(function, self._node), payload)

    def damages(self, function: int, payload: bytes) -> Mapping[str, tuple[bytes, ...]]:
        """Return whole frames to other nodes, which the device has to ignore."""
        free = [node for node in range(NODES) if node != self._node and node not in self._others]
        frames = tuple(can_identifier(function, node).to_bytes(2, "big") + payload for node in free)
        return {"other_node": frames} if frames else {}

    def send_damaged(self, unit: bytes) -> None:
        """Send a frame that is given as two bytes of identifier and its data."""
        self.port.write(int.from_bytes(unit[:2], "big"), unit[2:])

    def receive(self, until_s: float) -> list[Arrival]:
        """Wait until `until_s`, and return the node's frames; note which other nodes are on the bus."""
        frames = self.port.read(until_s)
        self._others |= {identifier & 0xF for _, identifier, _ in frames} - {self._node}
        return [
            (time_s, identifier >> 4, data) for time_s, identifier, data in frames if identifier & 0xF == self._node
        ]


Line: TypeAlias = SerialLine | CanLine
