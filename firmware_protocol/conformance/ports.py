"""Real ports in real time: pyserial for a serial line, python-can for a bus."""

import contextlib
import errno
import os
import select
import termios
import time
from abc import ABC, abstractmethod
from typing import Any, Final, final

import can
import serial
from can.interfaces import BACKENDS

from firmware_protocol.conformance.line import CanLine, Line, SerialLine

PATIENCE_S: Final = 1.0
"A port that takes nothing for this time is gone."


class RealPort(ABC):
    """Waits for a descriptor."""

    now_s = staticmethod(time.monotonic)
    _fd: int

    def read(self, until_s: float) -> list[Any]:
        came: list[Any] = []
        while (left_s := until_s - time.monotonic()) > 0.0 or not came:
            if select.select([self._fd], [], [], max(left_s, 0.0))[0]:
                came.extend((time.monotonic(), *one) for one in self._received())
            elif left_s <= 0.0:
                break
        return came

    @abstractmethod
    def _received(self) -> list[tuple[Any, ...]]:
        """Take what came."""


@final
class SerialPort(RealPort):
    """An open, exclusively held serial port: a `Port`."""

    def __init__(self, path: str, baud: int) -> None:
        """Open the port at `path`, with its latency timer at 1 ms if it has one."""
        try:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=PATIENCE_S, exclusive=True)
            self._port.reset_input_buffer()
        except (OSError, termios.error) as error:  # unplugged while it was set up, too
            raise OSError(f"{path}: {_why(error)}") from error
        # USB serial chips hold bytes back for 16 ms by default; a pty has no such mode
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            self._port.set_low_latency_mode(True)
        self._fd = self._port.fileno()

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def _received(self) -> list[tuple[bytes]]:
        data = os.read(self._fd, 4096)
        if not data:
            raise OSError(errno.ENODEV, "the device was unplugged")
        return [(data,)]

    def close(self) -> None:
        """Close the port without waiting for unsent bytes."""
        with contextlib.suppress(OSError, termios.error):  # it may be gone
            self._port.reset_output_buffer()
            self._port.close()


@final
class CanPort(RealPort):
    """An open CAN bus: a `Port`."""

    def __init__(self, interface: str, channel: str, bitrate: int, baud: int) -> None:
        """Open a bus by python-can; `baud` is of an adapter's serial port."""
        known: dict[str, dict[str, Any]] = {
            "slcan": {"tty_baudrate": baud, "sleep_after_open": 0.0, "timeout": 0.0},  # else it sleeps for 2 s
            "udp_multicast": {"hop_limit": 0, "fd": False},
        }
        try:
            self._bus = can.Bus(
                interface=interface, channel=channel, bitrate=bitrate, ignore_config=True, **known.get(interface, {})
            )
            self._fd = self._bus.fileno()
        except (
            can.CanError,
            ValueError,
            OSError,
            NotImplementedError,
        ) as error:
            raise OSError(f"{interface}:{channel}: cannot be opened: {_why(error)}") from error

    def write(self, identifier: int, data: bytes) -> None:
        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=PATIENCE_S)
        except can.CanError as error:
            raise OSError(str(error)) from error

    def close(self) -> None:
        with contextlib.suppress(can.CanError, OSError):  # it may be gone
            self._bus.shutdown()

    def _received(self) -> list[tuple[int, bytes]]:
        """Return the classical data frame with an 11-bit identifier that is there, or none."""
        try:
            frame = self._bus.recv(0)
        except (can.CanError, OSError, ValueError, IndexError) as error:
            raise OSError(str(error)) from error
        if frame is None or frame.is_error_frame or frame.is_extended_id or frame.is_remote_frame or frame.is_fd:
            return []
        return [(frame.arbitration_id, bytes(frame.data))]


def _why(error: Exception) -> str:
    return "allowed is a serial port; this is none" if os.strerror(errno.ENOTTY) in str(error) else str(error)


def open_line(name: str, baud: int, bitrate: int, node: int) -> Line:
    """Open a line: a serial port by its path, a CAN bus as INTERFACE:CHANNEL."""
    interface, colon, channel = name.partition(":")
    if colon and interface in BACKENDS:
        return CanLine(CanPort(interface, channel, bitrate, baud), node)
    return SerialLine(SerialPort(name, baud))
