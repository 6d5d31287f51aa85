"""Messages to CAN frames and back: the part of the CAN backend that needs no bus."""

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
"""An error frame, and what stands for a line that is no frame at all: linux/can.h, CAN_ERR_FLAG."""
ECHOES = 32
"""Drives that may be on the way while their own echo is not back, on a bus that has one (UDP multicast)."""


class SecondHostError(Exception):
    """Somebody else drives our node."""


class CanStream:
    """Both directions of one conversation with one node. What does not decode is counted, never raised.

    `statistics` are of the frames of our node; what the bus itself discards is not seen. Corrupt are error frames, too,
    and lost are States missing from their counter: one that is no news is given out for the link to count.
    """

    __match_args__: ClassVar = ("node", "statistics", "_states", "_drives", "_synchronised")

    def __init__(self, node: int) -> None:
        """Raises EncodeError for a node outside 0..15."""
        self.node = node
        self.statistics = FramingStatistics()
        self._identifiers = {message: can_identifier(function, node) for message, function in FUNCTION.items()}
        self._states = Succession()
        self._drives: deque[bytes] = deque(maxlen=ECHOES)
        self._synchronised = True
        self.received: list[tuple[int, bytes]] = []
        """The node's frames that were taken apart, UNREADABLE among them; whoever reads the bus begins it anew."""
        self.sent = UNREADABLE
        """The newest outgoing frame."""

    def pack(self, message: Message) -> tuple[int, bytes]:
        """Identifier and data of the frame. Raises EncodeError for a value that does not fit the wire."""
        data = encode(message)
        if isinstance(message, Drive):
            self._drives.append(data)
        self.sent = self._identifiers[type(message)], data
        return self.sent

    def unpack_all(self, frames: Iterable[tuple[int, bytes]]) -> list[Message]:
        """The messages in frames that were read together, UNREADABLE among them. Raises SecondHostError."""
        messages: list[Message] = []
        for identifier, data in frames:
            if identifier == UNREADABLE[0]:
                self.count_unreadable()
            elif (message := self.unpack(identifier, data)) is not None:
                messages.append(message)
        return messages

    def unpack(self, identifier: int, data: bytes) -> Message | None:
        """The message in a frame; None for another node's, a host's and an unusable one.

        Raises SecondHostError for a Drive to our node that is not the echo of one of ours.
        """
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
        """Counts a frame that could not even be taken apart."""
        self.received.append(UNREADABLE)
        self._count_corrupt()

    def _count_corrupt(self) -> None:
        self.statistics.corrupt += 1
        self._synchronised = False
