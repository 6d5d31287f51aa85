"""Faults that can be put into the simulated device, at once or at a time."""

import math
import re
from typing import NamedTuple

KNOWN = {
    "worn_gearbox": "gearboxes and screws keep a quarter of their friction; carriages no longer hold",
    "drag_left": "drag of the left guide, changed by VALUE percent, as in drag_left=+50%",
    "blocked_left": "left carriage jammed",
    "blocked_right": "right carriage jammed",
    "backlash": "of both screws, changed by VALUE percent, as in backlash=+900%",
    "motor_dead_left": "bridge of the left motor stays open",
    "overheated": "the device measures 70 degrees",
    "end_stop_left": "left closed end stop reported",
    "switch_stuck_left": "left open switch always closed",
    "no_handle": "handle position frozen",
    "frozen": "firmware hangs with its last duties; its watchdog resets it after 100 ms",
    "other_schema": "another protocol version",
    "encoder_stuck_left": "left encoder frozen",
    "reset": "firmware restarts; mode, zero, handshake and clock are lost",
    "commands_vanish": "the host's messages are lost",
    "supply_loss": "motor supply fails; logic goes on",
    "no_state": "no State sent",
    "no_sense": "no Sense sent",
    "no_status": "no Status sent",
    "state_crc": "wrong CRC-8 in every State",
    "answers_half": "every other Drive ignored",
    "encoder_jump": "both encoders jump by 4 mm",
    "encoder_jump_left": "left encoder jumps by 4 mm",
    "encoder_reversed_left": "left encoder counts backwards",
    "motor_reversed_left": "left motor turns the wrong way",
    "duties_reversed": "in RUN the firmware takes opening duties for closing ones",
    "opening": "motors get VALUE percent more volts while the firmware opens; -200% reverses them",
    "switch_dead_left": "left open switch never closes",
    "clock": "clock fast by VALUE percent, as in clock=+2%",
}
SIZED = ("drag_left", "backlash", "clock", "opening")
_KNOWN = ". ".join(f"{name}: {what}" for name, what in KNOWN.items())
FORMS = f"NAME[=PERCENT%][@SECONDS]. {_KNOWN}"
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
