"""The serial doors: the device behind a pseudo-terminal, which carries bytes at once at any baud rate.

The device's own line is one; a CAN adapter's is the other, by the Lawicel ASCII protocol ("slcan"). It does what a
CANable or a Lawicel CAN232 does between a host's serial port and the bus (Lawicel CAN232 manual, version 3). Commands
end with CR and are answered with CR, or with BEL when they are refused.
"""

import fcntl
import os
import re
import struct
import termios
import tty
from collections.abc import Sequence

from tormagd.simulation.can_device import DEVICE, CanDevice, CanFrame
from tormagd.simulation.device import VirtualDevice

READ_BYTES = 4096
MAX_UNREAD_BYTES = 4096
END = b"\r"
OK = b"\r"
REFUSED = b"\a"
SENT = b"z\r"
LONGEST_COMMAND = 32
"""The longest command, a 29-bit frame of 8 bytes, has 26 characters."""
TOLD = {b"V": b"V1013\r", b"N": b"NSIM1\r", b"F": b"F00\r"}
_FRAME = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")


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


class SlcanAdapter:
    """Translates between the Lawicel protocol and CAN frames, without I/O or clock."""

    def __init__(self) -> None:
        self.is_open = False
        """Whether the channel is on the bus; a host opens it with `O`."""
        self._pending = b""

    def feed(self, data: bytes) -> tuple[bytes, list[CanFrame]]:
        """Take the host's characters; return the answer, and the frames that the host sends."""
        *commands, rest = (self._pending + data).split(END)
        # too long a command is refused at its end, so only enough to show its length is kept
        self._pending = rest[: LONGEST_COMMAND + 1]
        answers, frames = b"", []
        for command in commands:
            frame = _frame(command) if self.is_open else None
            if frame is None:
                answers += self._answer(command)
            else:
                answers += SENT
                frames.append(frame)
        return answers, frames

    def line(self, frame: CanFrame) -> bytes:
        """Return a received frame as characters for the host."""
        return b"t%03X%d%s\r" % (frame.identifier, len(frame.data), frame.data.hex().upper().encode())

    def _answer(self, command: bytes) -> bytes:
        match command[:1]:
            case b"":  # hosts send empty lines to end whatever was there before
                return OK
            case b"O" if not self.is_open:
                self.is_open = True
                return OK
            case b"C":
                self.is_open = False
                return OK
            case b"S" if not self.is_open and command[1:] in {b"%d" % number for number in range(9)}:
                return OK  # without effect: the simulated bus has its own bit rate
        return TOLD.get(command[:1], REFUSED)


class SlcanPort(Pty):
    """The device on a CAN bus, behind an slcan adapter on a pseudo-terminal."""

    def __init__(self, device: CanDevice) -> None:
        super().__init__()
        self._device = device
        self._adapter = SlcanAdapter()

    def exchange(self, now_s: float, readable: Sequence[int]) -> None:
        """Exchange frames and answers between host and device until `now_s`."""
        out = b""
        if readable:
            out, frames = self._adapter.feed(self.read())
            for frame in frames:
                self._device.receive(now_s, frame)
        for sender, frame, _ in self._device.transmit(now_s):
            if sender == DEVICE and self._adapter.is_open:
                out += self._adapter.line(frame)
        if out:
            self.write(out)


def _frame(command: bytes) -> CanFrame | None:
    """Return the frame in `tiiildd..`"""
    match = _FRAME.fullmatch(command)
    if match is None or len(match[3]) != 2 * int(match[2]):
        return None
    return CanFrame(int(match[1], 16), bytes.fromhex(match[3].decode()))
