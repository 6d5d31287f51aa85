"""The simulated device on a CAN bus: frames in, frames out, each for as long as its bits take.

One bus: whoever has something to send waits until it is free, then the lowest identifier goes first.
"""

import math
from heapq import heappop, heappush
from typing import NamedTuple, Protocol

from tormagd.simulation.can_frame import MAX_IDENTIFIER, CanFrame, frame_bits
from tormagd.simulation.device import MessageDevice
from tormagd.simulation.plant import Truth

DEFAULT_BITRATE = 1_000_000
DEFAULT_NODE = 1
MAX_WAITING = 32
"""Frames that the controllers on the bus hold together; what comes on top is lost, as in a full transmit queue."""
DEVICE = 0
"""The device as a sender; hosts count from 1."""


class Delivery(NamedTuple):
    """A frame that all nodes but its sender have just received."""

    sender: int
    frame: CanFrame


class CanLine(Protocol):
    """What a host has of a device on a bus: a `CanDevice`, or what lies in front of one."""

    @property
    def messages(self) -> MessageDevice:
        """The device itself."""

    @property
    def truth(self) -> Truth:
        """The plant's true state at the time of the last call."""

    def receive(self, now_s: float, frame: CanFrame) -> None:
        """Take the frame that the host hands to its controller at `now_s`."""

    def transmit(self, now_s: float) -> list[Delivery]:
        """Let time pass until `now_s` and return the frames that have gone by since the last call."""


class CanDevice:
    """One device and the bus it is on: the frames that wait, the one under way, and those that are not fetched yet."""

    def __init__(self, messages: MessageDevice, bitrate: int = DEFAULT_BITRATE, node: int = DEFAULT_NODE) -> None:
        self.messages = messages
        """The device itself."""
        self.lost = 0
        """Frames that found the queue full."""
        self._bit_s = 1.0 / bitrate
        self._node = node
        self._order = 0
        self._waiting: list[tuple[int, int, Delivery]] = []
        self._flight: Delivery | None = None
        self._free_s = 0.0
        self._now_s = 0.0
        self._delivered: list[Delivery] = []

    @property
    def truth(self) -> Truth:
        return self.messages.truth

    @property
    def next_event_s(self) -> float:
        """Return when something happens next, s from power-on: a frame ends or may start, or an event inside the
        device."""
        event_s = self.messages.next_event_s
        is_used = self._flight is not None or self._waiting
        return min(event_s, max(self._free_s, self._now_s)) if is_used else event_s

    def receive(self, now_s: float, frame: CanFrame, host: int = 1) -> None:
        """Let time pass until `now_s` and queue the frame that `host` sends then; in a full queue it is lost, and
        counted in `lost`."""
        self.advance(now_s)
        self._queue(Delivery(host, frame))

    def transmit(self, now_s: float) -> list[Delivery]:
        """Let time pass until `now_s` and return the frames whose last bit has gone by since the last call, in that
        order."""
        self.advance(now_s)
        delivered, self._delivered = self._delivered, []
        return delivered

    def advance(self, now_s: float) -> None:
        """Let time pass until `now_s`: frames end and start on the bus."""
        if not self._now_s <= now_s < math.inf:
            raise ValueError(f"now_s = {now_s}: allowed is from {self._now_s} on")
        while (event_s := self.next_event_s) <= now_s:
            self._pass_time(event_s)
            if self._flight is not None and self._free_s <= event_s:
                self._end_frame(self._flight)
            if self._flight is None and self._waiting and self._free_s <= event_s:
                self._start_frame(event_s)
        self._pass_time(now_s)

    def _pass_time(self, time_s: float) -> None:
        """Advance the device to `time_s`, take what it sends out of its `outbox`, and queue that."""
        self.messages.advance(time_s)
        self._now_s = time_s
        outbox = self.messages.outbox
        while outbox:
            packet = outbox.popleft()
            self._queue(Delivery(DEVICE, CanFrame(packet.function << 4 | self._node, packet.payload)))

    def _queue(self, delivery: Delivery) -> None:
        """Queue a frame by its identifier, behind equal ones; where MAX_WAITING are waiting, drop it and count it in
        `lost`."""
        if len(self._waiting) >= MAX_WAITING:
            self.lost += 1
            return
        self._order += 1
        heappush(self._waiting, (delivery.frame.identifier, self._order, delivery))

    def _start_frame(self, time_s: float) -> None:
        _, _, self._flight = heappop(self._waiting)
        self._free_s = time_s + frame_bits(self._flight.frame) * self._bit_s

    def _end_frame(self, delivery: Delivery) -> None:
        """Free the bus, and put its frame among the delivered."""
        self._flight = None
        self._delivered.append(delivery)
        sender, frame = delivery
        if sender != DEVICE and frame.identifier <= MAX_IDENTIFIER and frame.identifier & 0xF == self._node:
            self.messages.receive(self._free_s, frame.identifier >> 4, frame.data)
