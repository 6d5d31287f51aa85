"""The simulated device on a CAN bus: frames in, frames out.

A frame of n bytes takes 47 + 8 n bits: those of ISO 11898-1 without stuffed ones, with the pause of 3. A sender waits
until the bus is free, then the lowest identifier goes first.
"""

import math
from heapq import heappop, heappush
from itertools import count
from typing import NamedTuple, Protocol

from tormagd.simulation.device import MessageDevice

DEFAULT_BITRATE = 1_000_000
DEFAULT_NODE = 1
MAX_WAITING = 32
"""As in a full transmit queue, frames above this are lost."""
DEVICE = 0
"""The device as a sender; hosts have other numbers."""
MAX_IDENTIFIER = 0x7FF
MAX_DATA = 8
ERROR_FLAG = 0x2000_0000
"""Marks an error frame, a report of the controller (linux/can.h)."""


class CanFrame(NamedTuple):
    """A classical frame: 11-bit identifier and 0 to 8 bytes of data; with ERROR_FLAG a report of an error."""

    identifier: int
    data: bytes


class Delivery(NamedTuple):
    """A frame that all nodes but its sender have just received."""

    sender: int
    frame: CanFrame
    time_s: float
    """When its last bit passed, from power-on."""


class CanLine(Protocol):
    """A host's view of a device on a bus: a `CanDevice`, or what lies in front of one."""

    @property
    def messages(self) -> MessageDevice:
        """The device itself."""

    def receive(self, now_s: float, frame: CanFrame) -> None:
        """Take the frame that the host hands to its controller."""

    def transmit(self, now_s: float) -> list[Delivery]:
        """Advance to `now_s` and return the frames that have passed since the last call."""


class CanDevice:
    """One device and its bus, with the waiting, current and unfetched frames."""

    def __init__(self, messages: MessageDevice, bitrate: int = DEFAULT_BITRATE, node: int = DEFAULT_NODE) -> None:
        self.messages = messages
        self._bit_s = 1.0 / bitrate
        self._node = node
        self._order = count()
        self._waiting: list[tuple[int, int, int, CanFrame]] = []
        self._flight: Delivery | None = None
        self._now_s = 0.0
        self._delivered: list[Delivery] = []

    @property
    def next_event_s(self) -> float:
        return min(self.messages.next_event_s, math.inf if self._flight is None else self._flight.time_s)

    def receive(self, now_s: float, frame: CanFrame, host: int = 1) -> None:
        """Advance to `now_s` and queue the frame of `host`; a full queue loses it."""
        self.advance(now_s)
        self._queue(host, frame)
        self._start_frame()

    def transmit(self, now_s: float) -> list[Delivery]:
        """Advance to `now_s` and return the frames that have passed since the last call, in order."""
        self.advance(now_s)
        delivered, self._delivered = self._delivered, []
        return delivered

    def advance(self, now_s: float) -> None:
        """Advance to `now_s`: frames end and start on the bus."""
        if not self._now_s <= now_s < math.inf:
            raise ValueError(f"now_s = {now_s}: allowed is from {self._now_s} on")
        while (event_s := self.next_event_s) <= now_s:
            self._pass_time(event_s)
        self._pass_time(now_s)

    def _pass_time(self, time_s: float) -> None:
        """Advance the device, take what it sends, and end and start frames."""
        self.messages.advance(time_s)
        self._now_s = time_s
        outbox = self.messages.outbox
        while outbox:
            packet = outbox.popleft()
            self._queue(DEVICE, CanFrame(packet.function << 4 | self._node, packet.payload))
        if self._flight is not None and self._flight.time_s <= time_s:
            self._delivered.append(self._flight)
            sender, frame, _ = self._flight
            self._flight = None
            if sender != DEVICE and frame.identifier & 0xF == self._node:
                self.messages.receive(time_s, frame.identifier >> 4, frame.data)
        self._start_frame()

    def _queue(self, sender: int, frame: CanFrame) -> None:
        if len(self._waiting) < MAX_WAITING:
            heappush(self._waiting, (frame.identifier, next(self._order), sender, frame))

    def _start_frame(self) -> None:
        if self._flight is None and self._waiting:
            _, _, sender, frame = heappop(self._waiting)
            self._flight = Delivery(sender, frame, self._now_s + (47 + 8 * len(frame.data)) * self._bit_s)
