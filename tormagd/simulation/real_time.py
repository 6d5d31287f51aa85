"""Runs a simulated device in real time, in one thread, behind whatever door the host comes through.

Between events the process sleeps, until a host sends something or the device has something to do. So a reply leaves
when its last bit would have.
"""

import gc
import select
import time
from collections.abc import Callable
from typing import NamedTuple, TextIO, TypeAlias

from tormagd.simulation.can_device import CanDevice
from tormagd.simulation.can_port import CanPort
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.plant import Truth
from tormagd.simulation.pty_port import PtyPort, SlcanPort

LATE_S = 2e-3
"From here on a wake-up is late: two firmware ticks."
SLIP_S = 5e-3
"From here on the device's time stands still instead, because the process did not run."
TRUTH_PERIOD_S = 1e-3
TRUTH_HEADER = "t_ns,force_N,gap_mm,left_mm,right_mm,handle_mm,handle_mm_s,temperature_C,kinetic_N\n"


PacedDevice: TypeAlias = VirtualDevice | CanDevice
"A device with its wire; times are seconds from power-on and never fall."
Door: TypeAlias = PtyPort | SlcanPort | CanPort
"Where hosts reach a device."


class Punctuality(NamedTuple):
    late: int
    worst_s: float
    slipped_s: float


def serve(device: PacedDevice, door: Door, stopped: Callable[[], bool], truth: TextIO | None = None) -> Punctuality:
    """Run `device` behind `door` in real time until `stopped()`, and return how well that was kept."""
    # keeps the collector from walking what will not die while the device runs
    gc.freeze()
    power_on_s = time.monotonic()
    realtime_ns = time.time_ns()
    late, worst_s, slipped_s = 0, 0.0, 0.0
    row_s = 0.0
    while not stopped():
        due_s = device.next_event_s
        wait_s = due_s - (time.monotonic() - power_on_s)
        readable, _, _ = select.select(door.descriptors(), [], [], max(wait_s, 0.0))
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
                truth.write(_truth_row(device.messages.truth, realtime_ns + round(row_s * 1e9)))
                row_s += TRUTH_PERIOD_S
        door.exchange(now_s, readable)
    return Punctuality(late, worst_s, slipped_s)


def _truth_row(truth: Truth, t_ns: int) -> str:
    return (
        f"{t_ns},{truth.force_N:.5f},{truth.gap_mm:.5f},{truth.left_mm:.5f},{truth.right_mm:.5f},"
        f"{truth.handle_mm:.4f},{truth.handle_mm_s:.3f},{truth.temperature_C:.3f},{truth.kinetic_N:.5f}\n"
    )
