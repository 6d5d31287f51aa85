"""Faults that can be put into the simulated device, at once or at a time."""

import math
import re
from typing import NamedTuple

KNOWN = {
    "worn_gearbox": "a quarter of the friction in gearboxes and screws: the carriages no longer hold by themselves",
    "drag_left": "the left guide's drag changes by VALUE percent, as in drag_left=+50%",
    "blocked_left": "the left carriage is jammed in its guide",
    "blocked_right": "the right carriage is",
    "backlash": "that of both screws changes by VALUE percent, as in backlash=+900%",
    "motor_dead_left": "the left motor's bridge stays open",
    "overheated": "the device measures 70 degrees in itself",
    "end_stop_left": "the left closed end stop is reported",
    "switch_stuck_left": "the left open switch is always closed",
    "no_handle": "the handle's position stays what it was",
    "frozen": "the firmware hangs with its last duties; after 100 ms its watchdog resets it",
    "other_schema": "the firmware is of another version of the protocol",
    "encoder_stuck_left": "the left encoder stays at its last count",
    "reset": "the firmware restarts: mode, zero, handshake and clock are lost",
    "commands_vanish": "nothing that the host sends arrives",
    "supply_loss": "the motors' supply fails; the logic goes on",
    "no_state": "no State is sent any more",
    "no_sense": "no Sense is sent any more",
    "no_status": "no Status is sent any more",
    "state_crc": "the CRC-8 of every State is wrong",
    "answers_half": "every other Drive is neither taken nor answered",
    "encoder_jump": "both encoders gain 4 mm at once",
    "encoder_jump_left": "the left encoder does",
    "encoder_reversed_left": "the left encoder counts backwards from now on",
    "motor_reversed_left": "the left motor turns the other way",
    "duties_reversed": "in RUN the firmware takes an opening duty for a closing one",
    "opening": "while the firmware opens, the motors get VALUE percent more volts; -200% is the wrong way",
    "switch_dead_left": "the left open switch never closes",
    "clock": "the device's clock runs fast by VALUE percent, as in clock=+2%",
}
SIZED = ("drag_left", "backlash", "clock", "opening")
_KNOWN = ". ".join(f"{name}: {what}" for name, what in KNOWN.items())
FORMS = f"NAME[=PERCENT%][@SECONDS] with NAME one of these. {_KNOWN}"
_FORM = re.compile(r"(?P<name>\w+)(?:=(?P<percent>[+-]?[\d.]+)%)?(?:@(?P<at_s>[\d.]+))?")


class FaultError(ValueError):
    """A fault specification that is not allowed; the message says what is."""


class Fault(NamedTuple):
    name: str
    at_s: float = 0.0
    percent: float = 0.0


def parse_fault(spec: str) -> Fault:
    """Return the fault that the command-line word `NAME[=PERCENT%][@SECONDS]` stands for."""
    match = _FORM.fullmatch(spec)
    name = match["name"] if match else spec
    if match is None or name not in KNOWN:
        raise FaultError(f"fault {spec!r}: allowed is {FORMS}")
    if (match["percent"] is not None) != (name in SIZED):
        raise FaultError(f"fault {spec!r}: {', '.join(SIZED)} take a size, as in drag_left=+50%, and no other fault")
    try:
        at_s, percent = float(match["at_s"] or 0.0), float(match["percent"] or 0.0)
    except ValueError as error:
        raise FaultError(f"fault {spec!r}: {error}") from error
    least = -200.0 if name == "opening" else -100.0
    if not (at_s < math.inf and least <= percent <= 10_000.0 and (name != "clock" or percent > -100.0)):
        raise FaultError(f"fault {spec!r}: allowed are finite times and {least:.0f}% to +10000%")
    return Fault(name, at_s, percent)
