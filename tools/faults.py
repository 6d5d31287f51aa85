"""The fault matrix: each fault on a serial line and on a CAN bus, in virtual time.

For each fault it shows the name, how it ends safe, and which of the daemon's commands lead out of it, before its cause
has gone and after. Driven faults are injected at 1.8 N, and times count from then; the others are there from the
beginning, and times count from the command `home`. What is safe, and by when the reaction must begin, is stated by the
table of codes or by the injection itself. How fast the force is lost is measured too, because a force that vanishes at
once is a hazard of its own.

To recover, an operator only says `arm`, beside a publisher that goes on. Before the cause has gone that must fail, or
the fault be named all the while. Afterwards the force must be followed again.
"""

import argparse
import json
import sys

from fault_matrix.cases import MATRIX, SERIAL, Injection
from fault_matrix.rig import Rig
from fault_matrix.watch import MAX_OFF_N, MAX_OVER_N, Cell, Watch
from tqdm import tqdm

from tormagd.control.safety.operating_state import OperatingState, RefusedError, next_commands
from tormagd.daemon.arming import Arming
from tormagd.lab.told import table
from tormagd.simulation.__main__ import FIRMWARES
from tormagd.simulation.device import FirmwareKind
from tormagd.simulation.firmware import Firmware

INJECTED_S = 5.0
USUAL_S = 2.0
WATCHED_S = 6.0
CONNECTED_S = 0.5
ARMING_S = 14.0
MENDED_S = 1.5
"A silent device is asked once a second who it is, and a reset one is told so."
PATIENCE_S = 12.0
"`arm` is repeated for so long: a clock is judged over some seconds."
FOLLOWED_S = 4.0
JUDGED_S = 1.0
SHOWN = (
    *("fault", "bus", "host_faults", "device_faults", "limits", "reaction", "named", "safe", "in_time", "recovered"),
    *("noticed_ms", "reacted_ms", "stated_ms", "open_ms", "loss_N_s", "tried", "recovery"),
)


def main() -> int:
    """Print the matrix; return 1 if a cell is not named, not safe, too late, or not recovered from."""
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
    if not injection.is_driven:
        return _begin_with(injection, plant, bus, watched_s, boot)
    rig, watch = spoiled(injection, plant, bus, boot)
    for sample in rig.run(watched_s):
        watch.see(sample)
    return rig, watch.cell(injection, bus)


def spoiled(injection: Injection, plant: str, bus: str, boot: FirmwareKind = Firmware) -> tuple[Rig, Watch]:
    rig = Rig(injection, plant, bus, INJECTED_S, boot)
    rig.loop.arm()
    usual: dict[str, None] = {}
    for sample in rig.run(INJECTED_S - rig.loop.now_s):
        if sample is not None and sample.time_s > INJECTED_S - USUAL_S:
            usual |= dict.fromkeys(map(str, (*sample.plan.limits, *sample.output.limits)))
    rig.spoil(injection)
    return rig, Watch(rig, usual, is_driven=True)


def _begin_with(injection: Injection, plant: str, bus: str, watched_s: float, boot: FirmwareKind) -> tuple[Rig, Cell]:
    """Connect, home and enable as far as the device allows, and then ask for the force."""
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


def recover(injection: Injection, rig: Rig, cell: Cell) -> Cell:
    tried, is_held_back = "", True
    if not injection.passes and not rig.is_dead:
        tried, is_held_back = _before(rig, injection)
    rig.mend()
    rig.rest(MENDED_S)
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = armed(rig, PATIENCE_S)
    is_held, told = _follow(rig)
    is_back = not trouble and not rig.safety.faults and is_held and not _named(injection, told)
    return cell._replace(
        tried=tried,
        recovery=tuple(map(str, commands)),
        recovered=is_held_back and is_back,
    )


def _before(rig: Rig, injection: Injection) -> tuple[str, bool]:
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = armed(rig, 0.0)
    if trouble:
        return trouble, True
    _, told = _follow(rig)
    if rig.safety.faults:
        return ", ".join((*commands, f"{rig.safety.faults[0]} again")), True
    if not injection.names:
        return "", True
    named = _named(injection, told)
    return (f"{named} still told", True) if named else ("goes on, unnamed", False)


def _follow(rig: Rig) -> tuple[bool, set[str]]:
    off_N: list[float] = []
    told: set[str] = set()
    for _ in rig.run(FOLLOWED_S - JUDGED_S):
        if rig.safety.faults:
            return False, told
    for sample in rig.run(JUDGED_S):
        off_N.append(rig.off_N)
        if sample is not None:
            told.update(map(str, (*sample.plan.limits, *sample.output.limits)))
    is_held = abs(sum(off_N) / len(off_N)) < MAX_OFF_N and max(off_N) < MAX_OVER_N
    return rig.safety.operating_state is OperatingState.ENABLED and is_held, told


def armed(rig: Rig, patience_s: float) -> str:
    until_s = rig.loop.now_s + patience_s
    while True:
        commands, arming = next_commands(rig.safety, rig.is_homed), Arming(rig.loop.now_s, rig.safety.faults)
        while not arming.is_over:
            arming.advance(rig.loop.now_s, rig.safety, rig.loop.conditions(), rig.loop.command)
            rig.tick()
        why = arming.refusal
        if why is None:
            return ""
        if why.code == "fault":
            return ", ".join((*arming.given, f"{rig.safety.faults[0]} again"))
        if rig.loop.now_s >= until_s:
            return ", ".join((*arming.given, f"{commands[len(arming.given)]} refused: {why.code}"))


def _named(injection: Injection, told: set[str]) -> str:
    return next((name for name in injection.names if name in told), "")


if __name__ == "__main__":
    sys.exit(main())
