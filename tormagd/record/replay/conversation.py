"""The conversation with the device run again: the same `Connection`, fed what was read at the recorded times."""

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

import msgspec

from firmware_protocol.codec import DeviceFault, DeviceMode, Identity, Message, Sense, State, Status, Switches
from firmware_protocol.framing import Frame, FramingStatistics
from tormagd.config import Device
from tormagd.control.records import Duty
from tormagd.ground.plain_values import first_difference, kinds, packed, plain
from tormagd.hardware.backend import BackendError, Sent, Stream
from tormagd.hardware.connection import Connection
from tormagd.hardware.link import LinkState
from tormagd.hardware.link_statistics import LinkQuality
from tormagd.hardware.measurement import DeviceRequest, Measurement
from tormagd.hardware.streams import CanStream, FrameStream, SecondHostError

KNOWN = kinds(
    *(LinkState, DeviceRequest, Identity, State, Sense, Status, DeviceMode, Switches, DeviceFault),
    *(LinkQuality, Frame, FramingStatistics),
)


class Found(msgspec.Struct, frozen=True):
    """The first difference: its field, both values, and the frame that it belongs to. `tick` counts from 1, `time_s`
    from the file's first tick."""

    field: str
    recorded: Any
    replayed: Any
    frame: int | None = None
    tick: int = 0
    time_s: float = 0.0


def differing(where: str, recorded: Any, replayed: Any, frame: int | None = None) -> Found | None:
    """Return the first difference between two plain values, its field prefixed with `where`."""
    found = first_difference(recorded, replayed)
    return None if found is None else Found(f"{where}.{found[0]}".strip("."), *found[1:], frame)


class Conversation:
    def __init__(self, frame: int) -> None:
        self._connection: Connection | None = None
        self.stream: Stream = FrameStream()
        self._unread: Sequence[Any] = ()
        self._written: list[Sent] = []
        self.frame = frame
        self.frames = 0

    def begin(self, memory: Any) -> None:
        self._connection = None
        if memory is not None:
            told = memory["stream"]
            is_serial = FrameStream.__name__ in told
            self.stream = FrameStream() if is_serial else CanStream(told[CanStream.__name__]["node"])
            connection = Connection(Device(), lambda: self, lambda: None)
            connection.open(0.0)
            connection.remember(memory, KNOWN)
            self._connection = connection

    def compare_memory(self, recorded: Any) -> Found | None:
        """Return where the connection's memory differs from the `recorded` one."""
        own = self._connection
        return None if own is None else differing("state.connection", recorded, own.memory(), self.frame)

    def compare(self, recorded: Measurement | None) -> Found | None:
        """Return where the newest measurement differs from the recorded step's."""
        own = self._connection
        return None if own is None else differing("measurement", plain(recorded), plain(own.measurement), self.frame)

    def read(self, entry: Any) -> None:
        if self._connection is not None:
            _, now_s, raw = entry
            self._unread = pieces = raw if isinstance(raw, list) else [raw]
            self._connection.receive(now_s)
            self.frames += len(pieces)

    def wrote(self, entry: Any, output: Duty) -> Found | None:
        """Send a step's `output` again, and return the first frame that differs from the WROTE entry's."""
        if self._connection is None:
            return None
        _, now_s, recorded, unsent = entry
        self._written, self.stream.statistics.unsent = [], unsent
        self._connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        for number, (told, own) in enumerate(zip_longest(recorded, self._written), self.frame - len(recorded) + 1):
            if packed(told) != packed(own):
                return Found("written", _shown(told), _shown(own), number)
        self.frames += len(recorded)
        return None

    def receive(self) -> list[Message]:
        """Decode what `read` was last given; empty when called again."""
        pieces, self._unread = self._unread, ()
        if isinstance(self.stream, FrameStream):
            return [message for piece in pieces for message in self.stream.unpack(piece)]
        try:
            return self.stream.unpack_all(msgspec.convert(pieces, list[tuple[int, bytes]]))
        except SecondHostError as error:
            raise BackendError("another host drives the node") from error

    def send(self, message: Message) -> None:
        self._written.append(self.stream.pack(message))

    def close(self) -> None:
        """Do nothing: no port is open."""


def _shown(frame: Any) -> str:
    """Return a frame as hexadecimal text, behind the identifier and "#" on a bus."""
    if frame is None:
        return "nothing"
    if isinstance(frame, bytes):
        return frame.hex()
    identifier, data = frame
    return f"{identifier:03X}#{data.hex()}"
