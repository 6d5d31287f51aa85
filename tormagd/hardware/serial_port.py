"""An open serial port, whose descriptor is written and read without waiting."""

import contextlib
import os
import termios
from fcntl import ioctl
from typing import Final, final

import serial

from firmware_protocol.codec import Message
from tormagd.hardware.backend import BackendError
from tormagd.hardware.streams import FrameStream

READ_BYTES: Final = 4_096
UNSENT_BYTES: Final = 512
"Some frames may wait for the driver; more bytes mean that nobody reads at the other end."


@final
class SerialPort:
    """An exclusively held serial port and the conversation on it: a `Backend`."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        self._fd: int = port.fileno()
        self.stream = FrameStream()
        self._unsent = b""
        self._waiting = bytearray(4)

    def receive(self) -> list[Message]:
        try:
            # `read` on an empty terminal waits for a kernel worker (flush_to_ldisc), up to 100 ms on a busy machine
            ioctl(self._fd, termios.FIONREAD, self._waiting)
            data = os.read(self._fd, READ_BYTES) if any(self._waiting) else b""
        except OSError as error:
            raise BackendError(f"{self._port.port}: unplugged, or not readable: {error.strerror}") from error
        return self.stream.unpack(data)

    def send(self, message: Message) -> None:
        """Write one frame after what the driver has not taken yet, and keep what it does not take now."""
        data = self._unsent + self.stream.pack(message)
        try:
            written = os.write(self._fd, data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise BackendError(f"{self._port.port}: writing failed: {error.strerror}") from error
        self._unsent = data[written:]
        if self._unsent:
            self.stream.statistics.unsent += 1
        if len(self._unsent) > UNSENT_BYTES:
            raise BackendError(f"{self._port.port}: nobody reads at the other end")

    def close(self) -> None:
        # closing would wait for unsent bytes, up to half a minute
        with contextlib.suppress(OSError, termios.error):
            self._port.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._port.close()
