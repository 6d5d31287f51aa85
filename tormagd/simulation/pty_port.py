"""The serial door: the device behind a pseudo-terminal, which carries bytes at once at any baud rate."""

import fcntl
import os
import struct
import termios
import tty
from collections.abc import Sequence

from tormagd.simulation.device import VirtualDevice

READ_BYTES = 4096
MAX_UNREAD_BYTES = 4096


class Pty:
    """A pseudo-terminal in raw mode that hosts may open and close at any time."""

    def __init__(self) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.address = os.ttyname(self._theirs)

    def close(self) -> None:
        """Close both ends of the line, once."""
        os.close(self._ours)
        os.close(self._theirs)

    def descriptors(self) -> Sequence[int]:
        return (self._ours,)

    def read(self) -> bytes:
        """Return at most READ_BYTES of what the host has written."""
        return os.read(self._ours, READ_BYTES)

    def write(self, data: bytes) -> None:
        """Hand `data` to the host at once."""
        (unread,) = struct.unpack("i", fcntl.ioctl(self._theirs, termios.FIONREAD, bytes(4)))
        if unread + len(data) > MAX_UNREAD_BYTES - 1:
            termios.tcflush(self._theirs, termios.TCIFLUSH)
        try:
            os.write(self._ours, data)
        except BlockingIOError:
            termios.tcflush(self._theirs, termios.TCIFLUSH)


class PtyPort(Pty):
    def __init__(self, device: VirtualDevice) -> None:
        super().__init__()
        self._device = device

    def exchange(self, now_s: float, readable: Sequence[int]) -> None:
        """Exchange bytes between host and device until `now_s`."""
        if readable:
            self._device.receive(now_s, self.read())
        if out := self._device.transmit(now_s):
            self.write(out)
