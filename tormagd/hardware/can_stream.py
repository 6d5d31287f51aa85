"""Messages to CAN frames and back: the part of the CAN backend that works without a bus."""

from collections import deque
from collections.abc import Iterable
from typing import ClassVar

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
from firmware_protocol.framing import FramingStatistics, Succession

FROM_DEVICE = (State, Sense, Status, Identity)
UNREADABLE = (0x2000_0000, b"")
"""What stands for an error frame, and for bytes that were no frame at all: linux/can.h, CAN_ERR_FLAG."""
ECHOES = 32
"""Sent Drives that are kept, to know their echo by, on a bus that returns what is sent (UDP multicast)."""


class SecondHostError(Exception):
    """A Drive to the node came from another host."""


class CanStream:
    """Both directions of one conversation with one node. A frame that does not decode is counted, never raised."""

    __match_args__: ClassVar = ("node", "statistics", "_states", "_drives", "_synchronised")

    def __init__(self, node: int) -> None:
        """Begin a conversation with `node`."""
        self.node = node
        self.statistics = FramingStatistics()
        self._identifiers = {message: can_identifier(function, node) for message, function in FUNCTION.items()}
        self._states = Succession()
        self._drives: deque[bytes] = deque(maxlen=ECHOES)
        self._synchronised = True
        self.received: list[tuple[int, bytes]] = []
        """The node's frames since the reader of the bus last emptied the list, UNREADABLE among them."""
        self.sent = UNREADABLE
        """The newest outgoing frame."""

    def pack(self, message: Message) -> tuple[int, bytes]:
        """Return a message's CAN identifier and data, and keep both in `sent` until the next call."""
        data = encode(message)
        if isinstance(message, Drive):
            self._drives.append(data)
        self.sent = self._identifiers[type(message)], data
        return self.sent

    def unpack_all(self, frames: Iterable[tuple[int, bytes]]) -> list[Message]:
        """Return the messages in frames (identifier, data), in their order, as `unpack` of each; UNREADABLE counts as
        corrupt."""
        messages: list[Message] = []
        for identifier, data in frames:
            if identifier == UNREADABLE[0]:
                self.count_unreadable()
            elif (message := self.unpack(identifier, data)) is not None:
                messages.append(message)
        return messages

    def unpack(self, identifier: int, data: bytes) -> Message | None:
        """Return the message in a frame; None for a frame of another node, of a host, or one that does not decode."""
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
        """Count an error frame, or bytes that were no frame, as corrupt, and note UNREADABLE in `received`."""
        self.received.append(UNREADABLE)
        self._count_corrupt()

    def _count_corrupt(self) -> None:
        self.statistics.corrupt += 1
        self._synchronised = False
