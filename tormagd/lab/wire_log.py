"""Log what is said on the wire, for CAN tools: candump (.log), Vector (.asc, .blf) and more.

On CAN, `python -m can.logger` records the bus by itself. A serial port has one owner, so `tap` sits in between. It
holds the device's port, offers the daemon a pseudo-terminal, passes every byte on and logs the frames. `virtual` logs a
session in virtual time. `viewer` prints the message formats for python-can's viewer.
"""

import argparse
import contextlib
import math
import os
import select
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import serial

from firmware_protocol.codec import FUNCTION, can_identifier
from firmware_protocol.framing import FrameDecoder
from firmware_protocol.layouts import LAYOUTS
from tormagd.assembly.build import build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import load_config
from tormagd.control.records import TimedSetpoint
from tormagd.interrupt import interrupted_by
from tormagd.lab.errors import LabError
from tormagd.lab.main import Found, whole, within
from tormagd.simulation.device import DEFAULT_BAUD, VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd.simulation.pty_door import READ_BYTES, Pty

NODE = 1
POLL_MS = 100
MEAN_N, SWING_N, SWING_HZ = 1.5, 0.3, 1.2


class WireLog:
    """Log of both directions of one serial line, in a file that CAN tools read. Bytes that are no frame are counted in
    `damaged`."""

    def __init__(self, path: Path) -> None:
        if path.suffix.lower() == ".db":  # python-can would append to it
            path.unlink(missing_ok=True)
        self._log = can.Logger(path)
        self._decoders = {is_rx: FrameDecoder() for is_rx in (False, True)}
        self._nameless = 0
        self.frames = 0

    @property
    def damaged(self) -> int:
        return self._nameless + sum(decoder.statistics.corrupt for decoder in self._decoders.values())

    def close(self) -> None:
        self._log.stop()

    def add(self, time_s: float, data: bytes, *, is_rx: bool) -> None:
        """Log the frames that `data` completes, stamped with `time_s`."""
        for frame in self._decoders[is_rx].feed(data):
            if not 1 <= frame.function <= 0x7F:
                self._nameless += 1
                continue
            message = can.Message(
                timestamp=time_s,
                arbitration_id=can_identifier(frame.function, NODE),
                is_extended_id=False,
                data=frame.payload,
                is_rx=is_rx,
                channel="can0",
            )
            self._log.on_message_received(message)
            self.frames += 1

    def read(self, now_s: float, raw: Any) -> None:
        self.add(now_s, raw, is_rx=True)

    def wrote(self, now_s: float, raw: list[Any], unsent: int) -> None:
        self.add(now_s, b"".join(raw), is_rx=False)

    def connected(self, memory: Any) -> None:
        """Ignore the beginning and end of a conversation."""


def virtual_session(seconds: float, log: WireLog) -> None:
    """Log a session of the virtual device, sample 1, in virtual time."""
    config = load_config(None)
    core = build_core(config)
    loop = ClosedLoop(
        config, core.stepper(), core.planner(), VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1)
    )
    loop.connection.traffic = log
    loop.arm()

    def asked(now_s: float) -> TimedSetpoint:
        return TimedSetpoint(MEAN_N + SWING_N * math.sin(math.tau * SWING_HZ * now_s), now_s, 0.1)

    for _ in loop.run(seconds, asked):
        pass


def tap(port: serial.Serial, log: WireLog, announce: Callable[[str], None], stopped: Callable[[], bool]) -> None:
    """Pass bytes between `port` and a new pseudo-terminal until `stopped()`, and log their frames."""
    with contextlib.closing(Pty()) as line:
        announce(line.address)
        poll = select.poll()
        for descriptor in (*line.descriptors(), port.fileno()):
            poll.register(descriptor, select.POLLIN)
        while not stopped():
            for descriptor, _ in poll.poll(POLL_MS):
                data = os.read(descriptor, READ_BYTES)
                if not data:
                    raise OSError(f"{port.port}: the device was unplugged")
                is_rx = descriptor == port.fileno()
                if is_rx:
                    line.write(data)
                else:
                    with contextlib.suppress(BlockingIOError):  # bytes that the device does not fetch are lost
                        os.write(port.fileno(), data)
                log.add(time.time(), data, is_rx=is_rx)


def viewer_formats() -> list[str]:
    """Return a line `ID:FORMAT:DIVISOR...` for each message, for `python -m can.viewer -d FILE`."""
    lines = []
    for layout in LAYOUTS:
        divisors = [repr(1.0 / signal.scale) if signal.type is float else "1" for signal in layout.signals]
        divisors += ["1"] * layout.protected
        lines.append(":".join([f"{can_identifier(FUNCTION[layout.message], NODE):X}", layout.format, *divisors]))
    return lines


def add_options(parser: argparse.ArgumentParser) -> None:
    ways = parser.add_subparsers(dest="way", required=True)
    virtual = ways.add_parser("virtual", help="log a session in virtual time")
    tapped = ways.add_parser("tap", help="log what passes between the daemon and a serial device")
    ways.add_parser("viewer", help="print the messages' formats for python-can's viewer")
    for way in (virtual, tapped):
        way.add_argument("file", type=Path, help="its ending says which format: .log, .asc, .blf, ...")
    virtual.add_argument("--seconds", type=within(0.0, 86_400.0, "s"), default=5.0, help="after homing and enabling")
    tapped.add_argument("--port", default="/dev/tormag", help="the device's port")
    tapped.add_argument("--baud", type=whole(1, 12_000_000), default=DEFAULT_BAUD)


def run(options: argparse.Namespace) -> Found:
    if options.way == "viewer":
        formats = viewer_formats()
        return Found(formats, formats)
    try:
        log = WireLog(options.file)
    except ValueError as error:
        raise LabError(str(error)) from error
    with contextlib.closing(log):
        if options.way == "virtual":
            virtual_session(options.seconds, log)
        else:
            with (
                interrupted_by(signal.SIGINT, signal.SIGTERM) as is_stopped,
                serial.Serial(options.port, options.baud, timeout=0, exclusive=True) as port,
            ):
                tap(port, log, _announce, is_stopped)
    return Found({"file": str(options.file), "frames": log.frames, "damaged": log.damaged})


def _announce(pty: str) -> None:
    print(f"{pty}  # give this to the daemon as device.port", flush=True)
