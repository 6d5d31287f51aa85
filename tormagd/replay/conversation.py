"""The conversation with the device run again: the very same `Connection`, over what was read and when."""

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import msgspec

from firmware_protocol.codec import DeviceFault, DeviceMode, Identity, Message, Sense, State, Status, Switches
from firmware_protocol.framing import Frame, FramingStatistics
from tormagd.config import Device
from tormagd.control.records import Duty
from tormagd.exact import first_difference, kinds, packed, plain
from tormagd.hardware.backend import BackendError, LinkStatistics, Sent, Stream
from tormagd.hardware.can_stream import CanStream, SecondHostError
from tormagd.hardware.connection import Connection
from tormagd.hardware.frame_stream import FrameStream
from tormagd.hardware.link import LinkState
from tormagd.hardware.link_quality import Counts, LinkQuality
from tormagd.hardware.measurement import Measurement
from tormagd.safety.operating_state import DeviceRequest

KNOWN = kinds(
    *(LinkState, DeviceRequest, Identity, State, Sense, Status, DeviceMode, Switches, DeviceFault),
    *(LinkQuality, Counts, Frame, FramingStatistics),
)
"All that a conversation's memory consists of."


class Found(NamedTuple):
    """What differs: where, what was recorded and what is replayed; in or after which frame, where it is about those."""

    field: str
    recorded: Any
    replayed: Any
    frame: int | None = None


def differing(where: str, recorded: Any, replayed: Any, frame: int | None = None) -> Found | None:
    """Where two plain data, which stand at `where`, differ first; None where they are the same to the bit."""
    found = first_difference(recorded, replayed)
    return None if found is None else Found(f"{where}.{found[0]}".strip("."), *found[1:], frame)


class Damage(msgspec.Struct, frozen=True):
    """The first damaged frame: which of the file's, when, and why it was refused."""

    frame: int
    time_s: float
    why: str


class RecordedWire:
    """The backend of a connection: what is read stands in the file, what is written is compared."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.unread: Sequence[Any] = ()
        "Pieces: one of bytes, or a bus's frames."
        self.damaged: list[int] = []
        "Of those that were read last, which were."
        self.written: list[Sent] = []
        self.connection = Connection(Device(), lambda: self, lambda: None)
        self.connection.open(0.0)

    @property
    def statistics(self) -> LinkStatistics:
        """Counters since the port was opened."""
        return self.stream.statistics

    def receive(self) -> list[Message]:
        """The messages in what was read."""
        messages: list[Message] = []
        pieces, self.unread, self.damaged = self.unread, (), []
        for place, piece in enumerate(pieces):
            corrupt = self.stream.statistics.corrupt
            messages += self._unpack(piece)
            if self.stream.statistics.corrupt > corrupt:
                self.damaged.append(place)
        return messages

    def _unpack(self, piece: Any) -> list[Message]:
        if isinstance(self.stream, FrameStream):
            return self.stream.unpack(piece)
        try:
            return self.stream.unpack_all([msgspec.convert(piece, tuple[int, bytes])])
        except SecondHostError as error:
            raise BackendError("another host drives the node") from error

    def send(self, message: Message) -> None:
        """Keeps what it becomes."""
        self.written.append(self.stream.pack(message))

    def close(self) -> None:
        """There is nothing to give back."""


class Conversation:
    """What is known of it between two entries; nothing before the first snapshot, or while no port was open."""

    def __init__(self, frame: int) -> None:
        self._wire: RecordedWire | None = None
        self.frame = frame
        "The file's newest, from 1; whoever reads the entries counts."
        self.frames = self.damaged = self.resynchronised = 0
        self.first_damage: Damage | None = None

    def begin(self, memory: Any) -> None:
        """Goes on with what was remembered then. Raises InexactError, TypeError, LookupError for what nobody does."""
        self._wire = None
        if memory is not None:
            told = memory["stream"]
            serial = FrameStream.__name__ in told
            wire = RecordedWire(FrameStream() if serial else CanStream(told[CanStream.__name__]["node"]))
            wire.connection.remember(memory, KNOWN)
            self._wire = wire

    def compare_memory(self, recorded: Any) -> Found | None:
        """What it remembers otherwise than was recorded."""
        if self._wire is None:
            return None
        return differing("state.connection", recorded, self._wire.connection.memory(), self.frame)

    def compare(self, recorded: Measurement | None) -> Found | None:
        """What it measures otherwise than the recorded step was given."""
        if self._wire is None:
            return None
        return differing("measurement", plain(recorded), plain(self._wire.connection.measurement), self.frame)

    def read(self, entry: Any) -> None:
        """Something came."""
        wire = self._wire
        if wire is None:
            return
        _, now_s, raw = entry
        wire.unread = pieces = raw if isinstance(raw, list) else [raw]
        seen, found_again = wire.statistics, wire.statistics.resynchronisations
        wire.connection.receive(now_s)
        self.frames += len(pieces)
        self.damaged += len(wire.damaged)
        self.resynchronised += seen.resynchronisations - found_again
        if wire.damaged and self.first_damage is None:
            why = ", ".join(f"{name}: {each}" for name, each in seen.refused.items()) or "unreadable"
            self.first_damage = Damage(self.frame - len(pieces) + 1 + wire.damaged[0], now_s, why)

    def wrote(self, entry: Any, output: Duty) -> Found | None:
        """A step's output went to the device: what was written otherwise."""
        wire = self._wire
        if wire is None:
            return None
        _, now_s, recorded, unsent = entry
        wire.written, wire.statistics.unsent = [], unsent
        wire.connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        for number, (told, own) in enumerate(zip_longest(recorded, wire.written), self.frame - len(recorded) + 1):
            if packed(told) != packed(own):
                return Found("written", _shown(told), _shown(own), number)
        self.frames += len(recorded)
        return None


def _shown(frame: Any) -> str:
    if frame is None:
        return "nothing"
    if isinstance(frame, bytes):
        return frame.hex()
    identifier, data = frame
    return f"{identifier:03X}#{data.hex()}"
