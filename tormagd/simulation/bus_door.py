"""The door onto a bus that is already there: any python-can interface, `socketcan` with `vcan0` for one."""

from collections.abc import Sequence
from typing import Any

import can

from firmware_protocol.codec import FUNCTION, Identity, Sense, State, Status
from tormagd.simulation.can_device import DEVICE, CanDevice
from tormagd.simulation.can_frame import MAX_DATA, CanFrame

FRAMES_AT_ONCE = 64
OPTIONS: dict[str, dict[str, Any]] = {"udp_multicast": {"hop_limit": 0, "fd": False}}
"""Keeps a simulated device on this machine."""
OWN_FUNCTIONS = {FUNCTION[message] for message in (State, Sense, Status, Identity)}
"""Functions that only a device sends: UDP multicast hands a sender its own frames."""


class BusDoor:
    """The device as a node of a CAN bus that others run. The bus must have a descriptor to wait for."""

    def __init__(self, device: CanDevice, spec: str) -> None:
        """Open the bus of `spec`, INTERFACE:CHANNEL."""
        interface, _, channel = spec.partition(":")
        try:
            self._bus = can.Bus(interface=interface, channel=channel, ignore_config=True, **OPTIONS.get(interface, {}))
            self._fd: int = self._bus.fileno()
        except (can.CanError, NotImplementedError, ValueError, OSError) as error:
            raise OSError(f"{spec}: cannot be opened: {error}") from error
        self._device = device
        self.address = channel

    def descriptors(self) -> Sequence[int]:
        """Return the bus's descriptor."""
        return (self._fd,)

    def exchange(self, now_s: float, readable: Sequence[int]) -> None:
        """Hand the device what waits on the bus, if the bus is `readable`, and send what the device has sent by
        `now_s`."""
        if readable:
            for _ in range(FRAMES_AT_ONCE):
                frame = self._bus.recv(0)
                if frame is None:
                    break
                if not (frame.is_extended_id or frame.is_remote_frame or frame.is_error_frame or frame.is_fd):
                    self._take(now_s, CanFrame(frame.arbitration_id, bytes(frame.data)))
        for sender, sent in self._device.transmit(now_s):
            if sender == DEVICE:
                self._bus.send(
                    can.Message(arbitration_id=sent.identifier, data=sent.data, is_extended_id=False), timeout=0
                )

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _take(self, now_s: float, frame: CanFrame) -> None:
        if frame.identifier >> 4 not in OWN_FUNCTIONS and len(frame.data) <= MAX_DATA:
            self._device.receive(now_s, frame)
