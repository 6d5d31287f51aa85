"""The serial backend: pyserial opens the port, whose descriptor is then read and written directly.

USB serial chips hold received bytes back by a latency timer, by default for 16 ms; the chip's driver shows it in sysfs.
A device's own USB or a pty has none, and holds nothing back.
"""

import errno
import logging
import os
import termios
from pathlib import Path
from typing import Annotated

import serial
from msgspec import Meta

from tormagd.config import Device
from tormagd.hardware.backend import NO_PORT, BackendError, Driver
from tormagd.hardware.serial_port import SerialPort
from tormagd_client.endpoints import Strict

SYSFS = Path("/sys/bus/usb-serial/devices")
PROMPT_MS = 1

log = logging.getLogger(__name__)


def latency_ms(port: str, sysfs: Path = SYSFS) -> int | None:
    try:
        return int((sysfs / Path(port).resolve().name / "latency_timer").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def make_prompt(port: serial.Serial, sysfs: Path = SYSFS) -> None:
    """Set an open port's latency timer to 1 ms, where it has a longer one."""
    found_ms = latency_ms(port.port, sysfs)
    if found_ms is None or found_ms <= PROMPT_MS:
        return
    refusal = ""
    try:
        port.set_low_latency_mode(True)
    except (OSError, ValueError) as error:  # pyserial makes a ValueError of the driver's answer
        refusal = f" ({error})"
    left_ms = latency_ms(port.port, sysfs)
    if left_ms is not None and left_ms > PROMPT_MS:
        log.warning(
            "%s keeps received bytes back for %d ms and cannot be told otherwise%s: tormagctl doctor says how to",
            port.port,
            left_ms,
            refusal,
        )


# remedies for errors that do not suggest one
_HELD = ("another process holds it", "tormagctl ports says who; end it, and it is tried again")
_REFUSALS = {
    errno.EAGAIN: _HELD,  # from flock
    errno.EBUSY: _HELD,
    errno.ENOENT: ("there is no such port", "plug the device in and switch it on; it is tried again"),
    errno.ENOTTY: NO_PORT,
    errno.EACCES: ("no permission", "join the group that owns it (dialout or tormag; ls -l shows it), log in again"),
}


class SerialOptions(Strict, frozen=True):
    """Options of a serial port."""

    baud: Annotated[int, Meta(ge=115_200, le=12_000_000)] = 1_000_000
    "The default carries control at 1 kHz; a native USB device ignores it."


def open_serial(device: Device, options: SerialOptions) -> SerialPort:
    """Open `device.port` exclusively, with the driver's latency timer at 1 ms where it can be set."""
    try:
        port = serial.Serial(device.port, options.baud, timeout=0, write_timeout=0, exclusive=True)
        port.reset_input_buffer()
        make_prompt(port)
    except OSError as error:  # SerialException is one too; its text repeats path and number
        number = errno.ENOTTY if os.strerror(errno.ENOTTY) in str(error) else error.errno or 0
        reason, remedy = _REFUSALS.get(number, (os.strerror(number) if number else str(error), ""))
        raise BackendError(f"{device.port}: cannot be opened: {reason}", remedy) from error
    except (termios.error, ValueError) as error:  # unplugged during set-up, or a rate that the driver lacks
        raise BackendError(f"{device.port}: cannot be opened: {error.args[-1]}") from error
    return SerialPort(port)


DRIVER = Driver(SerialOptions, open_serial)
