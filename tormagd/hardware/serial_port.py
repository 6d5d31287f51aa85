"""An open serial port: frames are written to its descriptor, and what has come is read from it when it is asked for."""

import contextlib
import os
import termios
from typing import Final, final

import serial

from firmware_protocol.codec import Message
from tormagd.hardware.backend import BackendError, LinkStatistics
from tormagd.hardware.frame_stream import FrameStream

READ_BYTES: Final = 4_096
UNSENT_BYTES: Final = 512
"Half a frame may wait for the driver; more means that nobody reads at the other end."


@final
class SerialPort:
    """Of a port that is exclusively held. Nothing here waits."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        self._fd: int = port.fileno()
        self.stream = FrameStream()
        self._unsent = b""

    @property
    def statistics(self) -> LinkStatistics:
        """Counters since the port was opened."""
        return self.stream.statistics

    def receive(self) -> list[Message]:
        """All valid messages that have arrived. Raises BackendError at end-of-file or a read error."""
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return self.stream.unpack(b"")
        except OSError as error:
            raise BackendError(f"{self._port.port}: reading failed: {error.strerror}") from error
        if not data:
            raise BackendError(f"{self._port.port}: the device was unplugged")
        return self.stream.unpack(data)

    def send(self, message: Message) -> None:
        """Writes one frame. Raises BackendError when the port is gone or its far end has stopped reading."""
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
        """Closes the port and drops its lock."""
        # what was not sent is void, and closing would wait for it, up to half a minute; a device that is gone refuses
        with contextlib.suppress(OSError, termios.error):
            self._port.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._port.close()
