"""Converts messages to serial bytes or CAN frames and back, without a port or a bus."""

from collections import deque
from collections.abc import Iterable
from typing import ClassVar, final

from firmware_protocol.codec import (
    FUNCTION,
    DecodeError,
    Drive,
    Identity,
    Message,
    Sense,
    State,
    Status,
    can_identifier,
    decode,
    encode,
)
from firmware_protocol.framing import FrameDecoder, FramingStatistics, Succession, encode_frame

FROM_DEVICE = (State, Sense, Status, Identity)
UNREADABLE = (0x2000_0000, b"")
"""Stands for an error frame and for bytes that were no frame: CAN_ERR_FLAG of linux/can.h."""
ECHOES = 32
"""Sent Drives that are kept, to recognise their echo on a bus that returns what is sent (UDP multicast)."""


class SecondHostError(Exception):
    """A Drive to the node came from another host."""


@final
class CanStream:
    """Both directions of the conversation with one node. A frame that does not decode is counted, never raised."""

    __match_args__: ClassVar = ("node", "statistics", "_states", "_drives", "_synchronised")

    def __init__(self, node: int) -> None:
        self.node = node
        self.statistics = FramingStatistics()
        self._identifiers = {message: can_identifier(function, node) for message, function in FUNCTION.items()}
        self._states = Succession()
        self._drives: deque[bytes] = deque(maxlen=ECHOES)
        self._synchronised = True
        self.received: list[tuple[int, bytes]] = []
        """Frames of the newest read, UNREADABLE among them."""
        self.sent = UNREADABLE

    def pack(self, message: Message) -> tuple[int, bytes]:
        data = encode(message)
        if isinstance(message, Drive):
            self._drives.append(data)
        self.sent = self._identifiers[type(message)], data
        return self.sent

    def unpack_all(self, frames: Iterable[tuple[int, bytes]]) -> list[Message]:
        messages: list[Message] = []
        for identifier, data in frames:
            if identifier == UNREADABLE[0]:
                self.count_unreadable()
            elif (message := self.unpack(identifier, data)) is not None:
                messages.append(message)
        return messages

    def unpack(self, identifier: int, data: bytes) -> Message | None:
        """Return this node's message in a frame, or None. Raises SecondHostError for another host's Drive."""
        if identifier & 0xF != self.node:
            return None
        self.received.append((identifier, data))
        self.statistics.bytes += len(data)
        try:
            message = decode(identifier >> 4, data)
        except DecodeError as error:
            self._count_corrupt()
            self.statistics.refused[error.name or f"function {identifier >> 4}"] = error.check
            return None
        if isinstance(message, Drive) and data not in self._drives:
            raise SecondHostError
        if not isinstance(message, FROM_DEVICE):
            return None
        if not self._synchronised:
            self.statistics.resynchronisations += 1
            self._synchronised = True
        if isinstance(message, State):
            self.statistics.lost += self._states.lost(message.counter)
        self.statistics.frames += 1
        return message

    def count_unreadable(self) -> None:
        self.received.append(UNREADABLE)
        self._count_corrupt()

    def _count_corrupt(self) -> None:
        self.statistics.corrupt += 1
        self._synchronised = False


@final
class FrameStream:
    """Both directions of one serial conversation. A frame that does not decode is counted, never raised."""

    __match_args__: ClassVar = ("_decoder", "_sequence")

    def __init__(self) -> None:
        self._decoder = FrameDecoder()
        self._sequence, self.received, self.sent = 0, b"", b""

    @property
    def statistics(self) -> FramingStatistics:
        return self._decoder.statistics

    def pack(self, message: Message) -> bytes:
        frame = encode_frame(FUNCTION[type(message)], self._sequence, encode(message))
        self._sequence = (self._sequence + 1) % 256
        self.sent = frame
        return frame

    def unpack(self, data: bytes) -> list[Message]:
        """Return the valid messages that `data` completes, in order, and keep `data` in `received`."""
        self.received = data
        messages: list[Message] = []
        for frame in self._decoder.feed(data):
            try:
                messages.append(decode(frame.function, frame.payload))
            except DecodeError as error:
                self.statistics.corrupt += 1
                self.statistics.refused[error.name or f"function {frame.function}"] = error.check
        return messages
