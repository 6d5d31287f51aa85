"""The conversation with the device run again: the same `Connection`, fed what was read at the times recorded."""

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
"The types in a connection's memory."


class Found(NamedTuple):
    """The first difference: its field, the recorded and the replayed value, and the frame it belongs to.

    `frame` is None where the difference is not about frames.
    """

    field: str
    recorded: Any
    replayed: Any
    frame: int | None = None


def differing(where: str, recorded: Any, replayed: Any, frame: int | None = None) -> Found | None:
    """Return the first difference between two plain values, its field behind `where` and a point; None where they agree
    to the bit.

    `frame` is the frame of what is returned. Plain is what `exact.plain` gives: anything else raises TypeError.
    """
    found = first_difference(recorded, replayed)
    return None if found is None else Found(f"{where}.{found[0]}".strip("."), *found[1:], frame)


class Conversation:
    """The recorded conversation with the device run again: a `Connection`, and the backend that gives it what was read.

    What the connection writes is kept for comparison, and goes nowhere. Without a snapshot, or while no port was open,
    there is no connection: reading and comparing then do nothing.
    """

    def __init__(self, frame: int) -> None:
        self._connection: Connection | None = None
        self.stream: Stream = FrameStream()
        self._unread: Sequence[Any] = ()
        "What to read next: one piece of bytes, or frames of a bus."
        self._written: list[Sent] = []
        self.frame = frame
        "Number of the newest frame in the file, from 1; set by the caller."
        self.frames = 0

    def begin(self, memory: Any) -> None:
        """Replace the connection by one with this `memory`, as `Connection.memory` gives it; by none for None.

        Its stream is a serial port's or a CAN node's, as `memory` says. Raises InexactError, EncodeError, TypeError or
        LookupError for a memory that no connection writes: then there is no connection.
        """
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
        """Return where the connection's memory differs from the `recorded` one, with the newest frame's number.

        None where it does not differ, or no port was open. Changes nothing.
        """
        own = self._connection
        return None if own is None else differing("state.connection", recorded, own.memory(), self.frame)

    def compare(self, recorded: Measurement | None) -> Found | None:
        """Return where the connection's newest measurement differs from the one that the recorded step was given.

        `recorded` None is a step without a measurement. The result has the newest frame's number. None where nothing
        differs, or no port was open. Changes nothing.
        """
        own = self._connection
        return None if own is None else differing("measurement", plain(recorded), plain(own.measurement), self.frame)

    def read(self, entry: Any) -> None:
        """Feed the connection a READ entry, and add its frames to `frames`.

        `entry` is the name, the time, s on the monotonic clock, and what was read. That is bytes, which count as one
        frame, or a list of a bus's frames. Without a connection nothing happens, and the entry is not looked at. Where
        another host drives the node, the connection is lost, as it was then. Raises ValueError, TypeError or
        msgspec.ValidationError for a malformed entry.
        """
        if self._connection is not None:
            _, now_s, raw = entry
            self._unread = pieces = raw if isinstance(raw, list) else [raw]
            self._connection.receive(now_s)
            self.frames += len(pieces)

    def wrote(self, entry: Any, output: Duty) -> Found | None:
        """Send a step's `output` again, and return the first frame that differs from those of the WROTE entry.

        `entry` is the name, the time, s, the list of frames, and how many messages the wire had not taken so far.
        `frame` has to be the number of the last of these frames. None where none differs, which adds them to `frames`,
        or where no port was open. A frame that only one side has is "nothing" on the other. Raises ValueError or
        TypeError for an entry of another form, EncodeError for an output that does not fit the wire.
        """
        if self._connection is None:
            return None
        _, now_s, recorded, unsent = entry
        self._written, self.statistics.unsent = [], unsent
        self._connection.exchange(
            now_s, output.left_duty, output.right_duty, output.mode, output.request, output.request_number
        )
        for number, (told, own) in enumerate(zip_longest(recorded, self._written), self.frame - len(recorded) + 1):
            if packed(told) != packed(own):
                return Found("written", _shown(told), _shown(own), number)
        self.frames += len(recorded)
        return None

    @property
    def statistics(self) -> LinkStatistics:
        """Return the link's counters since the port was opened."""
        return self.stream.statistics

    def receive(self) -> list[Message]:
        """Decode what `read` was given last, and return the messages; empty where that was done before.

        Raises BackendError where another host drives the CAN node, and msgspec.ValidationError or TypeError for what is
        no frame.
        """
        pieces, self._unread = self._unread, ()
        if isinstance(self.stream, FrameStream):
            return [message for piece in pieces for message in self.stream.unpack(piece)]
        try:
            return self.stream.unpack_all(msgspec.convert(pieces, list[tuple[int, bytes]]))
        except SecondHostError as error:
            raise BackendError("another host drives the node") from error

    def send(self, message: Message) -> None:
        """Encode a message, and keep its bytes or frame."""
        self._written.append(self.stream.pack(message))

    def close(self) -> None:
        """Do nothing: no port is open."""


def _shown(frame: Any) -> str:
    """Return a frame as text: bytes in hexadecimal, behind the identifier and "#" on a bus; "nothing" for None.

    Raises TypeError or ValueError for what is neither bytes nor identifier and bytes.
    """
    if frame is None:
        return "nothing"
    if isinstance(frame, bytes):
        return frame.hex()
    identifier, data = frame
    return f"{identifier:03X}#{data.hex()}"
