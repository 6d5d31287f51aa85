"""The serial door: the device behind a pseudo-terminal.

A pty carries bytes at once whatever the baud rate; the pacing is the device's.
"""

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
    """Pseudo-terminal in raw mode that hosts may open and close as they like.

    The host's side is kept open too: so the line stays raw, and no end of file comes between hosts.
    """

    def __init__(self) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.address = os.ttyname(self._theirs)

    def close(self) -> None:
        """Close both ends of the line, once: a second call raises OSError. A host that has it open finds it hung up."""
        os.close(self._ours)
        os.close(self._theirs)

    def descriptors(self) -> Sequence[int]:
        """Return the descriptor of the device's end."""
        return (self._ours,)

    def read(self) -> bytes:
        """Return what the host has written, READ_BYTES at most; the rest waits. Raises BlockingIOError where there is
        nothing."""
        return os.read(self._ours, READ_BYTES)

    def write(self, data: bytes) -> None:
        """Hand `data` to the host at once. What nobody reads is thrown away, as in any receiver that overruns.

        Bytes that still wait are dropped where they and `data` would fill MAX_UNREAD_BYTES. Both are dropped where the
        line takes nothing, and the end of `data` where it takes a part. Nothing of that is told.
        """
        (unread,) = struct.unpack("i", fcntl.ioctl(self._theirs, termios.FIONREAD, bytes(4)))
        if unread + len(data) > MAX_UNREAD_BYTES - 1:
            termios.tcflush(self._theirs, termios.TCIFLUSH)
        try:
            os.write(self._ours, data)
        except BlockingIOError:
            termios.tcflush(self._theirs, termios.TCIFLUSH)


class PtyDoor(Pty):
    """The serial device behind a pseudo-terminal."""

    def __init__(self, device: VirtualDevice) -> None:
        super().__init__()
        self._device = device

    def exchange(self, now_s: float, readable: Sequence[int]) -> None:
        """Hand the device the host's bytes, if `readable` is not empty, and the host what the device has sent by
        `now_s`.

        `now_s` is seconds from power-on. READ_BYTES of the host's are taken at most; the rest waits. Raises
        BlockingIOError where `readable` is not true, and ValueError for a time before the last.
        """
        if readable:
            self._device.receive(now_s, self.read())
        if out := self._device.transmit(now_s):
            self.write(out)
