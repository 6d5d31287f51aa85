"""Converts messages to serial bytes and back, without a port."""

from typing import ClassVar, final

from firmware_protocol.codec import FUNCTION, DecodeError, Message, decode, encode
from firmware_protocol.framing import FrameDecoder, FramingStatistics, encode_frame


@final
class FrameStream:
    """Both directions of one serial conversation. A frame that does not decode is counted, never raised."""

    __match_args__: ClassVar = ("_decoder", "_sequence")

    def __init__(self) -> None:
        self._decoder = FrameDecoder()
        self._sequence = 0
        self.received = b""
        self.sent = b""

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
