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
from collections.abc import Iterator

from tqdm import tqdm

from firmware_protocol.codec import DeviceMode
from judge.injections import FOLLOWED, HELD, HELD_OR_OPENS, LIMITED, MATRIX, OPENS, SERIAL, STAYS, Injection
from judge.rig import OTHER_N, Rig
from tormag_lab.arrays import Json
from tormag_lab.told import table
from tormagd.control.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.control.safety.operating_state import OperatingState, RefusedError, next_commands
from tormagd.daemon.control_loop import Arming
from tormagd.simulation.__main__ import FIRMWARES
from tormagd.simulation.closed_loop import Sample
from tormagd.simulation.device import FirmwareKind
from tormagd.simulation.firmware import Firmware

SAFE_N = 1.0
OPEN_MM = 94.0
LOSS_MS = 50
"A loss of force is what a hand feels of it: the greatest in this time."
MAX_OFF_N = 0.15
"A held force is off by no more, in the mean of the last second,"
MAX_OVER_N = 0.3
"and too great by no more at any time."
MAX_CLOSED_MM = 3.0
REFUSED_MS = 100.0


class Watch:
    def __init__(self, rig: Rig, usual: dict[str, None], *, is_driven: bool) -> None:
        loop = rig.loop
        self._rig, self._loop = rig, loop
        self._has_run = is_driven
        self._usual, self._from_s = usual, loop.now_s
        self._host: dict[str, None] = {}
        self._device: dict[str, None] = {}
        self._limits: dict[str, None] = {}
        self._refusal = ""
        self._since_s: dict[str, float] = {}
        self._forces_N: list[float] = []
        self._gaps_mm = [loop.simulated.truth.gap_mm]
        self._off_N: list[float] = []

    def see(self, sample: Sample | None) -> None:
        truth, firmware = self._loop.simulated.truth, self._loop.simulated.firmware
        if sample is not None:
            self._host |= dict.fromkeys(map(str, sample.safety.faults))
            if sample.safety.operating_state in (OperatingState.ENABLED, OperatingState.PAUSED):
                held = map(str, (*sample.plan.limits, *sample.output.limits))
                self._limits |= dict.fromkeys(limit for limit in held if limit not in self._usual)
        self._device |= dict.fromkeys(fault.name or "" for fault in firmware.faults)
        has_let_go = self._has_run and firmware.mode is not DeviceMode.RUN
        self._has_run = self._has_run or firmware.mode is DeviceMode.RUN
        self._note("noticed", bool(self._host or self._device or self._limits))
        self._note("let go", has_let_go)
        self._note("opening", has_let_go and firmware.mode is DeviceMode.RETRACTING)
        # a force that is let go and comes back was not safe
        for what, is_so in (
            ("below", truth.force_N < SAFE_N),
            ("open", truth.gap_mm > OPEN_MM),
            ("resting", not firmware.output.enabled),
        ):
            self._note(what, is_so)
            if not is_so:
                self._since_s.pop(what, None)
        self._forces_N.append(truth.force_N)
        self._gaps_mm.append(truth.gap_mm)
        self._off_N.append(self._rig.off_N)

    def _note(self, what: str, is_so: bool) -> None:
        if is_so:
            self._since_s.setdefault(what, self._loop.now_s)

    def refuse(self, error: RefusedError) -> None:
        self._refusal = f"{error.code}: {error.message.partition(': ')[2]}"
        self._note("noticed", True)

    def cell(self, injection: Injection, bus: str) -> Json:
        """Return a row of the matrix. A time is null if it did not come to that within 6 s."""
        loop = self._loop
        state = loop.stepper.safety.operating_state
        mode = loop.simulated.firmware.mode.name
        noticed_ms = self._since("noticed")
        is_safe, safe_ms = self._ended(injection.safe, noticed_ms)
        stated_ms, reacted_ms = self._stated_ms(injection), self._reacted_ms(injection)
        return {
            "bus": bus,
            "fault": injection.name,
            "host_faults": tuple(self._host),
            "device_faults": tuple(self._device),
            "limits": (*self._limits, *filter(None, [self._refusal])),
            "reaction": f"daemon {state}, device {mode}",
            "noticed_ms": noticed_ms,
            "below_1N_ms": self._since("below"),
            "open_ms": self._since("open"),
            "loss_N_s": round(max(self._loss_N_s(), 0.0), 2),
            "expected": injection.safe,
            "named": self._is_named(injection.names),
            "safe": is_safe,
            "seconds": None if safe_ms is None else round(safe_ms * 1e-3, 4),
            "must_be_named": injection.names,
            "stated_ms": stated_ms,
            "reacted_ms": reacted_ms,
            "in_time": stated_ms is None or (reacted_ms is not None and reacted_ms <= stated_ms),
        }

    def _stated_ms(self, injection: Injection) -> float | None:
        """Return when the reaction must have begun, by the table of the code that was told."""
        if injection.within_ms is not None:
            return injection.within_ms
        told = {name: LIMITS[Limit(name)] for name in self._limits} | {name: FAULTS[Fault(name)] for name in self._host}
        for name in injection.names:
            if name in told:
                return told[name].safe_ms
            if name.startswith("device:"):
                return FAULTS[Fault(name.replace("device:", "DEVICE_"))].safe_ms
            if self._refusal.startswith(name):
                return REFUSED_MS
        return None

    def _reacted_ms(self, injection: Injection) -> float | None:
        """Return when the device began to open or let go; if it does not, when it was told so."""
        if self._refusal:
            return self._since("noticed")
        if not self._has_run:
            return self._since("resting")
        began = "let go" if injection.safe == STAYS else "opening"
        return self._since(began if began in self._since_s else "noticed")

    def _is_named(self, names: tuple[str, ...]) -> bool:
        if not names:
            return not self._host
        told = [*self._host, *self._limits, *(f"device:{fault}" for fault in self._device)]
        is_told = any(name in told or (self._refusal and self._refusal.startswith(name)) for name in names)
        first = next(iter(self._host), None)
        # what is latched first is what a person reads first
        return is_told and (first is None or first in names or names[0].startswith("device:"))

    def _ended(self, safe: str, noticed_ms: float | None) -> tuple[bool, float | None]:
        has_opened = {"open", "below"} <= set(self._since_s)
        last_second, is_not_over = self._off_N[-1000:], max(self._off_N) < MAX_OVER_N
        is_held = abs(sum(last_second) / len(last_second)) < MAX_OFF_N and is_not_over
        if safe == STAYS:
            is_still = "resting" in self._since_s and min(self._gaps_mm) > self._gaps_mm[0] - MAX_CLOSED_MM
            return is_still, self._since("resting")
        if safe == LIMITED:
            return not self._host and max(self._forces_N) < self._rig.most_N + MAX_OVER_N, noticed_ms
        if safe == FOLLOWED:
            is_there = abs(self._forces_N[-1] - OTHER_N) < MAX_OFF_N and is_not_over
            return is_there and not self._host, self._since("below")
        if has_opened and safe in (OPENS, HELD_OR_OPENS):
            return True, self._since("open")
        return safe in (HELD, HELD_OR_OPENS) and is_held and not self._host, noticed_ms

    def _loss_N_s(self) -> float:
        over = zip(self._forces_N, self._forces_N[LOSS_MS:], strict=False)
        return max((before - after) / (LOSS_MS * 1e-3) for before, after in over)

    def _since(self, what: str) -> float | None:
        return round((self._since_s[what] - self._from_s) * 1e3, 1) if what in self._since_s else None


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


OPTIONS = {
    "--plant": {"default": "sample_1", "help": "plant file or the name of a committed sample"},
    "--only": {"default": "", "metavar": "TEXT", "help": "faults with this in their name"},
    "--firmware": {"choices": FIRMWARES, "default": "python", "help": "what the device runs"},
}


def measure(options: argparse.Namespace) -> Json:
    todo = [(injection, bus) for injection in MATRIX for bus in injection.buses if options.only in injection.name]
    steps = tqdm(todo, desc="faults", unit="fault", disable=None)
    boot = FIRMWARES[options.firmware]
    cells = [recover(injection, *inject(injection, options.plant, bus, boot=boot)) for injection, bus in steps]
    passed = all(cell[verdict] for cell in cells for verdict in ("named", "safe", "in_time", "recovered"))
    return {"plant": options.plant, "cells": cells, "passed": passed}


def shown(figures: Json) -> Iterator[str]:
    return table({name: cell[name] for name in SHOWN} for cell in figures["cells"])


def inject(
    injection: Injection, plant: str, bus: str = SERIAL, watched_s: float = WATCHED_S, boot: FirmwareKind = Firmware
) -> tuple[Rig, Json]:
    rig, watch = (spoiled if injection.is_driven else _begun)(injection, plant, bus, boot)
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


def _begun(injection: Injection, plant: str, bus: str, boot: FirmwareKind) -> tuple[Rig, Watch]:
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
    return rig, watch


def _is_taken(rig: Rig, watch: Watch, command: str) -> bool:
    try:
        rig.loop.command(command)
    except RefusedError as error:
        watch.refuse(error)
        return False
    return True


def recover(injection: Injection, rig: Rig, cell: Json) -> Json:
    tried, is_held_back = "", True
    if not injection.passes and not rig.is_dead:
        tried, is_held_back = _before(rig, injection)
    rig.mend()
    rig.rest(MENDED_S)
    commands = next_commands(rig.safety, rig.is_homed)
    trouble = armed(rig, PATIENCE_S)
    is_held, told = _follow(rig)
    is_back = not trouble and not rig.safety.faults and is_held and not _named(injection, told)
    return cell | {
        "tried": tried,
        "recovery": tuple(map(str, commands)),
        "recovered": is_held_back and is_back,
    }


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
