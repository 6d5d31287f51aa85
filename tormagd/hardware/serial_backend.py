"""The serial backend: pyserial opens and configures the port, the event loop watches its descriptor."""

import contextlib
import errno
import os
import termios
from typing import Annotated

import serial
from msgspec import Meta

from firmware_protocol.codec import Message
from tormagd.config import Device, Strict
from tormagd.hardware.backend import BackendError, Driver, LinkStatistics
from tormagd.hardware.frame_stream import FrameStream
from tormagd.hardware.usb_latency import make_prompt

READ_BYTES = 4_096
UNSENT_BYTES = 512  # half a frame may wait for the driver; more means that nobody reads at the other end

# why a port does not open, where the kernel's own words leave open what to do
_HELD = ("another process holds it", "tormagctl ports says who; end it, and it is tried again")
_REFUSALS = {
    errno.EAGAIN: _HELD,  # from flock
    errno.EBUSY: _HELD,
    errno.ENOENT: ("there is no such port", "plug the device in and switch it on; it is tried again"),
    errno.EACCES: ("no permission", "join the group that owns it (dialout or tormag; ls -l shows it), log in again"),
}


class SerialBackend:
    """An open, exclusively held serial port."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        self._fd: int = port.fileno()
        self.stream = FrameStream()
        self._unsent = b""

    @property
    def statistics(self) -> LinkStatistics:
        """Counters since the port was opened."""
        return self.stream.statistics

    def fileno(self) -> int:
        """The port's descriptor."""
        return self._fd

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


class SerialOptions(Strict, frozen=True):
    """`[device.options]` of a serial port."""

    baud: Annotated[int, Meta(ge=115_200, le=12_000_000)] = 1_000_000
    "Carries control at 1 kHz with room to spare; a USB device of its own takes no notice of it."


def open_serial(device: Device, options: SerialOptions) -> SerialBackend:
    """Opens `device.port` exclusively. Raises BackendError saying why not."""
    try:
        port = serial.Serial(device.port, options.baud, timeout=0, write_timeout=0, exclusive=True)
        port.reset_input_buffer()
        _tell_nothing_from_gone(port.fileno())
        make_prompt(port)
    except OSError as error:  # SerialException is one too; its text repeats path and number
        reason = os.strerror(error.errno) if error.errno else str(error)
        reason, remedy = _REFUSALS.get(error.errno or 0, (reason, ""))
        raise BackendError(f"{device.port}: cannot be opened: {reason}", remedy) from error
    except termios.error as error:  # no OSError; unplugged while it was set up
        raise BackendError(f"{device.port}: cannot be opened: {error.args[-1]}") from error
    return SerialBackend(port)


def _tell_nothing_from_gone(fd: int) -> None:
    # with pyserial's VMIN = 0 a read returns no bytes both when none have come and when the device is unplugged
    attributes = termios.tcgetattr(fd)
    attributes[6][termios.VMIN] = 1
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


DRIVER = Driver(SerialOptions, open_serial)
"""The entry point `serial`."""
