"""The fault matrix: each fault injected at 1.8 N in virtual time, what notices it, what happens, how long until safe.

Safe means: the plant's force is below 1 N, and the gap is open. Times count from the injection. How fast the force is
lost on the way is measured too: a force that vanishes at once is a hazard of its own.
"""

import argparse
import json
import math
import sys
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import msgspec
from tqdm import tqdm

from tormagd.closed_loop import ClosedLoop, Sample
from tormagd.config import load_config
from tormagd.control.core import build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

FORCE_N = 1.8
SWING_N = 0.1
SAFE_N = 1.0
OPEN_MM = 94.0
INJECTED_S = 5.0
"Virtual time of the injection: homed, enabled and settled by then."
USUAL_S = 2.0
WATCHED_S = 6.0
LOSS_MS = 50
"A loss of force is what a hand feels of it: the greatest over so long."
OTHER_N = 0.6
"What the source asks for that takes over."


class Injection(NamedTuple):
    """A fault: of the simulated device (a `--fault` word), of the host, or of the publisher."""

    name: str
    device: str | None = None
    host: str | None = None
    stall_ms: int = 0


MATRIX = (
    Injection("daemon killed or cable cut", host="silent"),
    Injection("daemon stalls for 45 ms", stall_ms=45),
    Injection("daemon stalls for 83 ms", stall_ms=83),
    Injection("device hears nothing", device="commands_vanish"),
    Injection("device resets", device="reset"),
    Injection("motor supply fails", device="supply_loss"),
    Injection("left encoder stuck", device="encoder_stuck_left"),
    Injection("left drag +50%", device="drag_left=+50%"),
    Injection("worn gearbox", device="worn_gearbox"),
    Injection("worn gearbox, then daemon killed", device="worn_gearbox", host="silent"),
    Injection("publisher silent", host="stale"),
    Injection("another source takes over", host="other"),
    Injection("operator: stop", host="stop"),
    Injection("operator: disable", host="disable"),
)


class Cell(NamedTuple):
    """One row of the matrix. A time is null where it did not come to that within 6 s."""

    injected: str
    host_faults: tuple[str, ...]
    device_faults: tuple[str, ...]
    limits: tuple[str, ...]
    reaction: str
    noticed_ms: float | None
    below_1N_ms: float | None
    open_ms: float | None
    loss_N_s: float


def main() -> int:
    """Prints the matrix; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    steps = tqdm(MATRIX, desc="faults", unit="fault", disable=not sys.stderr.isatty())
    cells = [inject(injection, options.plant) for injection in steps]
    if options.json:
        print(json.dumps({"plant": options.plant, "cells": [cell._asdict() for cell in cells]}))
    else:
        print_table(cells)
    return 0


def inject(injection: Injection, plant: str) -> Cell:
    """Runs one fault."""
    config = msgspec.structs.replace(load_config(None), scene="coronary")
    core = build_core(config)
    faults = [parse_fault(f"{injection.device}@{INJECTED_S}")] if injection.device else []
    device = VirtualDevice(load_plant(plant), SteadyHand(), faults, seed=1)
    loop = ClosedLoop(config, core.stepper, core.planner, device)
    loop.arm()
    setpoint = Publisher()
    usual: dict[str, None] = {}
    for sample in loop.run(INJECTED_S - loop.now_s, setpoint):
        if sample.time_s > INJECTED_S - USUAL_S:
            usual |= dict.fromkeys(map(str, (*sample.plan.limits, *sample.output.limits)))
    if injection.host in ("stop", "disable"):
        loop.command(injection.host)
    setpoint.is_silent, setpoint.is_other = injection.host == "stale", injection.host == "other"
    watch = Watch(usual)
    for tick in range(round(WATCHED_S * config.rates.control_hz)):
        if injection.host == "silent" or tick < injection.stall_ms:
            loop.skip()
            watch.see(loop, None)
        else:
            watch.see(loop, loop.tick(setpoint(loop.now_s)))
    return watch.cell(injection.name, loop)


class Publisher:
    """A force setpoint every 2 ms, until it falls silent; it swings a little, because a fault may hide from a rest."""

    def __init__(self) -> None:
        self.is_silent = self.is_other = False
        self._stamp_s = 0.0

    def __call__(self, now_s: float) -> TimedSetpoint:
        if not self.is_silent:
            self._stamp_s = now_s - now_s % 0.002
        if self.is_other:
            return TimedSetpoint(OTHER_N, self._stamp_s, 0.1, holder=1)
        return TimedSetpoint(FORCE_N + SWING_N * math.sin(math.tau * self._stamp_s), self._stamp_s, 0.1)


class Watch:
    """What the injection brought about, tick by tick."""

    def __init__(self, usual: dict[str, None]) -> None:
        """`usual` are the limits that were held before the injection too: they notice nothing."""
        self._usual = usual
        self._host: dict[str, None] = {}
        self._device: dict[str, None] = {}
        self._limits: dict[str, None] = {}
        self._forces_N: deque[float] = deque(maxlen=LOSS_MS + 1)
        self._loss_N_s = 0.0
        self._noticed_s: float | None = None
        self._below_s: float | None = None
        self._open_s: float | None = None

    def see(self, loop: ClosedLoop, sample: Sample | None) -> None:
        """Takes one tick; `sample` is None while the daemon is dead."""
        truth, firmware = loop.device.truth, loop.device.messages.firmware
        if sample is not None:
            self._host |= dict.fromkeys(map(str, sample.state.safety.faults))
            held = map(str, (*sample.plan.limits, *sample.output.limits))
            self._limits |= dict.fromkeys(limit for limit in held if limit not in self._usual)
        self._device |= dict.fromkeys(fault.name or "" for fault in firmware.faults)
        self._forces_N.append(truth.force_N)
        if len(self._forces_N) > LOSS_MS:
            self._loss_N_s = max(self._loss_N_s, (self._forces_N[0] - truth.force_N) / (LOSS_MS * 1e-3))
        first = _first(loop.now_s)
        if self._host or self._device or self._limits:
            self._noticed_s = first(self._noticed_s)
        # a force that is let go and comes back was not safe
        self._below_s = first(self._below_s) if truth.force_N < SAFE_N else None
        self._open_s = first(self._open_s) if truth.gap_mm > OPEN_MM else None

    def cell(self, name: str, loop: ClosedLoop) -> Cell:
        """The row."""
        state = loop.step_state.safety.operating_state
        mode = loop.device.messages.firmware.mode.name
        return Cell(
            name,
            tuple(self._host),
            tuple(self._device),
            tuple(self._limits),
            f"daemon {state}, device {mode}",
            _since(self._noticed_s),
            _since(self._below_s),
            _since(self._open_s),
            round(self._loss_N_s, 2),
        )


def _first(now_s: float) -> Callable[[float | None], float]:
    return lambda known: now_s if known is None else known


def _since(time_s: float | None) -> float | None:
    return None if time_s is None else round((time_s - INJECTED_S) * 1e3, 1)


def print_table(cells: list[Cell]) -> None:
    """The matrix for a person."""
    print(f"{'injected at 1.8 N':34s}{'noticed':>9s}{'< 1 N':>9s}{'open':>9s}{'loss':>10s}  noticed as; end state")
    for cell in cells:
        times = (cell.noticed_ms, cell.below_1N_ms, cell.open_ms)
        columns = "".join(f"{'-' if time is None else f'{time:.0f} ms':>9s}" for time in times)
        named = [*cell.host_faults, *(f"device:{fault}" for fault in cell.device_faults), *cell.limits]
        columns += f"{cell.loss_N_s:6.1f} N/s"
        print(f"{cell.injected:34s}{columns}  {', '.join(named) or 'nothing'}; {cell.reaction}")


if __name__ == "__main__":
    sys.exit(main())
