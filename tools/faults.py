"""The fault matrix: each fault on a serial line and on a CAN bus, in virtual time. It shows its name, how it ends safe,
and what leads out of it.

Driven faults are injected at 1.8 N, and times count from then. The others are there from the beginning, and times count
from the command `home`. What is safe is stated for each, and by when the reaction has to be on its way. It is what the
table of codes says of the code that is named, or what the injection says itself. How fast the force is lost on the way
is measured too: a force that vanishes at once is a hazard of its own.
"""

import argparse
import json
import sys

from fault_matrix.cases import MATRIX, SERIAL, Injection
from fault_matrix.recovery import recover
from fault_matrix.rig import Rig
from fault_matrix.watch import Cell, Watch
from tqdm import tqdm

from tormagd.lab.told import table
from tormagd.safety.operating_state import RefusedError
from tormagd.simulation.__main__ import FIRMWARES
from tormagd.simulation.device import FirmwareKind
from tormagd.simulation.firmware import Firmware

INJECTED_S = 5.0
"Virtual time of the injection: homed, enabled and settled by then."
USUAL_S = 2.0
WATCHED_S = 6.0
CONNECTED_S = 0.5
ARMING_S = 14.0
SHOWN = (
    *("fault", "bus", "host_faults", "device_faults", "limits", "reaction", "named", "safe", "in_time", "recovered"),
    *("noticed_ms", "reacted_ms", "stated_ms", "open_ms", "loss_N_s", "tried", "recovery"),
)
"Of a cell, for a person."


def main() -> int:
    """Prints the matrix; returns 1 where a cell is not named, not safe, too late, or not recovered from."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--only", default="", metavar="TEXT", help="faults with this in their name")
    parser.add_argument("--firmware", choices=FIRMWARES, default="python", help="what the device runs")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    todo = [(injection, bus) for injection in MATRIX for bus in injection.buses if options.only in injection.name]
    boot = FIRMWARES[options.firmware]
    steps = tqdm(todo, desc="faults", unit="fault", disable=not sys.stderr.isatty())
    cells = [recover(injection, *inject(injection, options.plant, bus, boot=boot)) for injection, bus in steps]
    if options.json:
        print(json.dumps({"plant": options.plant, "cells": [cell._asdict() for cell in cells]}))
    else:
        print(*table({name: getattr(cell, name) for name in SHOWN} for cell in cells), sep="\n")
    return 0 if all(cell.named and cell.safe and cell.in_time and cell.recovered for cell in cells) else 1


def inject(
    injection: Injection, plant: str, bus: str = SERIAL, watched_s: float = WATCHED_S, boot: FirmwareKind = Firmware
) -> tuple[Rig, Cell]:
    """Runs one fault; also the rig, where it still lasts."""
    if not injection.is_driven:
        return _begin_with(injection, plant, bus, watched_s, boot)
    rig, watch = spoiled(injection, plant, bus, boot)
    for sample in rig.run(watched_s):
        watch.see(sample)
    return rig, watch.cell(injection, bus)


def spoiled(injection: Injection, plant: str, bus: str, boot: FirmwareKind = Firmware) -> tuple[Rig, Watch]:
    """A rig that renders the force and is spoiled now, and who watches it."""
    rig = Rig(injection, plant, bus, INJECTED_S, boot)
    rig.loop.arm()
    usual: dict[str, None] = {}
    for sample in rig.run(INJECTED_S - rig.loop.now_s):
        if sample is not None and sample.time_s > INJECTED_S - USUAL_S:
            usual |= dict.fromkeys(map(str, (*sample.plan.limits, *sample.output.limits)))
    rig.spoil(injection)
    return rig, Watch(rig, usual, is_driven=True)


def _begin_with(injection: Injection, plant: str, bus: str, watched_s: float, boot: FirmwareKind) -> tuple[Rig, Cell]:
    """Connects, homes and enables as far as the device lets one, and asks for the force then."""
    rig = Rig(injection, plant, bus, 0.0, boot)
    rig.spoil(injection)
    rig.publisher.is_silent = True
    rig.rest(CONNECTED_S)
    watch = Watch(rig, {}, is_driven=False)
    if _is_taken(rig, watch, "home"):
        for sample in rig.run(ARMING_S):
            watch.see(sample)
            if rig.safety.faults:
                break
        rig.publisher.is_silent = bool(rig.safety.faults) or not _is_taken(rig, watch, "enable")
    for sample in rig.run(watched_s):
        watch.see(sample)
    return rig, watch.cell(injection, bus)


def _is_taken(rig: Rig, watch: Watch, command: str) -> bool:
    try:
        rig.loop.command(command)
    except RefusedError as error:
        watch.refuse(error)
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
