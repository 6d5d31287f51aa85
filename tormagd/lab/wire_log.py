"""What was said on the wire, as a log that CAN tools read: candump (.log), Vector (.asc, .blf) and more.

On CAN, `python -m can.logger` records the bus and nothing of ours is needed. A serial line has one owner, so `tap` goes
between: it holds the device's port, offers the daemon a pseudo-terminal instead, passes every byte on and logs the
frames. `viewer` prints what python-can's viewer needs to know of the messages.
"""

import argparse
import contextlib
import os
import select
import signal
import time
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import can
import serial

from firmware_protocol.codec import FUNCTION, can_identifier
from firmware_protocol.framing import Frame, FrameDecoder
from firmware_protocol.layouts import LAYOUTS
from tormagd.lab.errors import LabError
from tormagd.lab.main import Found
from tormagd.simulation.device import DEFAULT_BAUD

NODE = 1
READ_BYTES = 4096
POLL_MS = 100


class WireLog:
    """A log of both directions of one serial line; also a context manager.

    A frame is stamped with the time its last byte passed. What is no frame, or names a function that CAN has no
    identifier for, is counted in `damaged` and not in the log. Raises ValueError for a file type that python-can does
    not know, and OSError where the file cannot be made.
    """

    def __init__(self, path: Path, node: int = NODE) -> None:
        self._node = node
        self._log = can.Logger(path)
        self._decoders = {is_rx: FrameDecoder() for is_rx in (False, True)}
        self._nameless = 0
        self.frames = 0

    @property
    def damaged(self) -> int:
        """Stretches of bytes that could not be logged."""
        return self._nameless + sum(decoder.statistics.corrupt for decoder in self._decoders.values())

    def to_device(self, time_s: float, data: bytes) -> None:
        """Bytes from the host."""
        self._add(time_s, data, is_rx=False)

    def to_host(self, time_s: float, data: bytes) -> None:
        """Bytes from the device."""
        self._add(time_s, data, is_rx=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._log.stop()

    def _add(self, time_s: float, data: bytes, *, is_rx: bool) -> None:
        for frame in self._decoders[is_rx].feed(data):
            if not 1 <= frame.function <= 0x7F:
                self._nameless += 1
                continue
            self._log.on_message_received(self._message(time_s, frame, is_rx))
            self.frames += 1

    def _message(self, time_s: float, frame: Frame, is_rx: bool) -> can.Message:
        return can.Message(
            timestamp=time_s,
            arbitration_id=can_identifier(frame.function, self._node),
            is_extended_id=False,
            data=frame.payload,
            is_rx=is_rx,
            channel="can0",
        )


def tap(port: serial.Serial, log: WireLog, announce: Callable[[str], None], stopped: Callable[[], bool]) -> None:
    """Passes bytes between `port` and a pseudo-terminal, whose path is announced, until `stopped()`.

    Raises OSError when the port goes away.
    """
    with contextlib.ExitStack() as resources:
        ours, theirs = os.openpty()
        resources.callback(os.close, ours)
        resources.callback(os.close, theirs)  # held open, so that there is no end of file between hosts
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        announce(os.ttyname(theirs))
        poll = select.poll()
        poll.register(ours, select.POLLIN)
        poll.register(port.fileno(), select.POLLIN)
        while not stopped():
            for descriptor, _ in poll.poll(POLL_MS):
                data = os.read(descriptor, READ_BYTES)
                if not data:
                    raise OSError(f"{port.port}: the device was unplugged")
                if descriptor == ours:
                    _pass_on(port.fileno(), data)
                    log.to_device(time.time(), data)
                else:
                    _pass_on(ours, data)
                    log.to_host(time.time(), data)


def _pass_on(descriptor: int, data: bytes) -> None:
    """What nobody fetches is lost, as on a port; descriptors do not block."""
    with contextlib.suppress(BlockingIOError):
        os.write(descriptor, data)


def viewer_formats(node: int = NODE) -> list[str]:
    """`ID:FORMAT:DIVISOR...` of each message, as `python -m can.viewer -d FILE` reads them."""
    lines = []
    for layout in LAYOUTS:
        divisors = [repr(1.0 / signal.scale) if signal.type is float else "1" for signal in layout.signals]
        divisors += ["1"] * layout.protected
        lines.append(":".join([f"{can_identifier(FUNCTION[layout.message], node):X}", layout.format, *divisors]))
    return lines


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of `tormag-lab wire-log`."""
    ways = parser.add_subparsers(dest="way", required=True)
    tapped = ways.add_parser("tap", help="log what passes between the daemon and a serial device")
    ways.add_parser("viewer", help="print the messages' formats for python-can's viewer")
    tapped.add_argument("file", type=Path, help="its ending says which format: .log, .asc, .blf, ...")
    tapped.add_argument("--port", default="/dev/tormag", help="the device's port")
    tapped.add_argument("--baud", type=int, default=DEFAULT_BAUD)


def run(options: argparse.Namespace) -> Found:
    """Logs until a signal ends it. Raises LabError, OSError for a file or port that cannot be used."""
    if options.way == "viewer":
        formats = viewer_formats()
        return Found(formats, formats)
    try:
        log = WireLog(options.file)
    except ValueError as error:
        raise LabError(str(error)) from error
    with log:
        _tap_until_stopped(options.port, options.baud, log)
    return Found({"file": str(options.file), "frames": log.frames, "damaged": log.damaged})


def _tap_until_stopped(path: str, baud: int, log: WireLog) -> None:
    stopping = False

    def stop(_signal: int, _frame: object) -> None:
        nonlocal stopping
        stopping = True

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    with serial.Serial(path, baud, timeout=0, exclusive=True) as port:
        tap(
            port,
            log,
            lambda pty: print(f"{pty}  # give this to the daemon as device.port", flush=True),
            lambda: stopping,
        )
