"""The serial door: the device behind a pseudo-terminal, in real time, in one thread.

A pty carries bytes at once whatever the baud rate; the pacing is the device's. Between events the process sleeps, until
the next byte from the host or the next thing the device has to do, so a reply leaves when its last bit would have.
"""

import fcntl
import gc
import os
import select
import struct
import termios
import time
import tty
from collections.abc import Callable
from typing import NamedTuple, TextIO

from tormagd.simulation.device import VirtualDevice

READ_BYTES = 4096
LATE_S = 2e-3
"""From this lateness on, a wake-up counts as falling behind: two firmware ticks."""
SLIP_S = 20e-3
"""From this lateness on, the device's time stands still instead: the process did not run, and the device must not take
its own sleep for the host's silence."""
MAX_UNREAD_BYTES = 4096
TRUTH_PERIOD_S = 1e-3
TRUTH_HEADER = "t_ns,force_N,gap_mm,left_mm,right_mm,handle_mm,handle_mm_s,temperature_C\n"


class Punctuality(NamedTuple):
    """How well real time was kept."""

    late: int
    worst_s: float
    slipped_s: float


class PtyDoor:
    """Serves one device on a pseudo-terminal that hosts may open and close as they like.

    The door keeps the host's side open too: so the line stays in raw mode and there is no end of file between hosts.
    """

    def __init__(self, device: VirtualDevice) -> None:
        self._device = device
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(self._theirs)

    def close(self) -> None:
        """Take the line away."""
        os.close(self._ours)
        os.close(self._theirs)

    def serve(self, stopped: Callable[[], bool], truth: TextIO | None = None) -> Punctuality:
        """Run until `stopped()`, asked about once a millisecond; `truth` gets a CSV row a millisecond."""
        device = self._device
        # nothing made so far will die: keep the collector from walking it while the device runs
        gc.freeze()
        power_on_s = time.monotonic()
        realtime_ns = time.time_ns()
        late, worst_s, slipped_s = 0, 0.0, 0.0
        row_s = 0.0
        if truth is not None:
            truth.write(TRUTH_HEADER)
        while not stopped():
            due_s = device.next_event_s
            wait_s = due_s - (time.monotonic() - power_on_s)
            readable, _, _ = select.select([self._ours], [], [], max(wait_s, 0.0))
            now_s = time.monotonic() - power_on_s
            lateness_s = now_s - due_s
            if lateness_s > LATE_S:
                late += 1
                worst_s = max(worst_s, lateness_s)
                if lateness_s > SLIP_S:
                    power_on_s += lateness_s
                    realtime_ns += round(lateness_s * 1e9)
                    slipped_s += lateness_s
                    now_s = due_s
            if truth is not None:
                while row_s <= now_s:
                    device.advance(row_s)
                    truth.write(_truth_row(device, realtime_ns + round(row_s * 1e9)))
                    row_s += TRUTH_PERIOD_S
            if readable:
                device.receive(now_s, os.read(self._ours, READ_BYTES))
            if out := device.transmit(now_s):
                self._write(out)
        return Punctuality(late, worst_s, slipped_s)

    def _write(self, data: bytes) -> None:
        """Hand bytes to the host. When nobody reads, the oldest are lost, as in any receiver that overruns."""
        (unread,) = struct.unpack("i", fcntl.ioctl(self._theirs, termios.FIONREAD, bytes(4)))
        if unread + len(data) > MAX_UNREAD_BYTES - 1:
            termios.tcflush(self._theirs, termios.TCIFLUSH)
        try:
            os.write(self._ours, data)
        except BlockingIOError:
            termios.tcflush(self._theirs, termios.TCIFLUSH)


def _truth_row(device: VirtualDevice, t_ns: int) -> str:
    truth = device.truth
    return (
        f"{t_ns},{truth.force_N:.5f},{truth.gap_mm:.5f},{truth.left_mm:.5f},{truth.right_mm:.5f},"
        f"{truth.handle_mm:.4f},{truth.handle_mm_s:.3f},{truth.temperature_C:.3f}\n"
    )
