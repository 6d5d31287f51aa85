"""Faults and limits by their codes. A *fault* is latched and needs a clear. A *limit* says: running, but held back."""

from enum import StrEnum
from typing import Literal, NamedTuple

from firmware_protocol.codec import DeviceFault


class Reaction(StrEnum):
    OPENING = "opening"
    "The gap opens at a bounded speed, and the drives go off there."
    LIMITED = "limited"
    "The force is held away from what is asked, and the device stays driven."
    HELD = "held"
    "The gap stays where it is, or the force goes on as asked: nothing closes the gap."


class Position(StrEnum):
    KEPT = "kept"
    LOST_HERE = "lost"
    LOST_THERE = "given up by the device"
    "A device that has latched, or was reset, does not call itself homed."


class Explanation(NamedTuple):
    cause: str
    remedy: str
    reaction: Reaction = Reaction.HELD
    safe_ms: float = 100.0
    "From when the cause shows to when the reaction begins."
    shows: str = "at once"
    "Many faults hide from a device at rest."
    position: Position = Position.KEPT
    hazard: Literal["SHUT", "CLOSES", "OPENS", "MISLED", "WORN", "NONE", ""] = ""
    "The `Hazard` that the code controls; NONE: it tells what the device can do."

    @property
    def clears(self) -> str:
        return "clear-fault" if self.position is Position.KEPT else "clear-fault, then home"


class Fault(StrEnum):
    """Why the gap was opened. A fault is latched until `clear-fault`."""

    STOPPED = "STOPPED"
    HOST_STALL = "HOST_STALL"
    LINK_LOST = "LINK_LOST"
    PLAN_FAILED = "PLAN_FAILED"
    NOT_FINITE = "NOT_FINITE"
    WRONG_DIRECTION = "WRONG_DIRECTION"
    DEVICE_SCHEMA_MISMATCH = "DEVICE_SCHEMA_MISMATCH"
    DEVICE_SUPPLY = "DEVICE_SUPPLY"
    DEVICE_TEMPERATURE = "DEVICE_TEMPERATURE"
    DEVICE_COMMAND_TIMEOUT = "DEVICE_COMMAND_TIMEOUT"
    DEVICE_OVERCURRENT = "DEVICE_OVERCURRENT"
    DEVICE_END_STOP = "DEVICE_END_STOP"
    DEVICE_SKEW = "DEVICE_SKEW"
    DEVICE_UNCOMMANDED_MOTION = "DEVICE_UNCOMMANDED_MOTION"
    DEVICE_HOMING_FAILED = "DEVICE_HOMING_FAILED"
    DEVICE_RETRACT_FAILED = "DEVICE_RETRACT_FAILED"
    HOMING = "HOMING"
    ENCODER = "ENCODER"
    OUT_OF_STROKE = "OUT_OF_STROKE"
    MEASUREMENT_STALE = "MEASUREMENT_STALE"
    SENSE_STALE = "SENSE_STALE"
    STATUS_STALE = "STATUS_STALE"
    LINK_DEGRADED = "LINK_DEGRADED"
    CLOCK = "CLOCK"
    SKEW = "SKEW"
    FOLLOWING_ERROR = "FOLLOWING_ERROR"
    OVER_FORCE = "OVER_FORCE"
    SENSOR = "SENSOR"
    NO_MOTION = "NO_MOTION"
    NOT_OPENING = "NOT_OPENING"
    DEVICE_NOT_RUNNING = "DEVICE_NOT_RUNNING"


class Limit(StrEnum):
    """What holds the rendered force away from the force asked for. A limit comes and goes by itself."""

    NO_SETPOINT = "NO_SETPOINT"
    STALE = "STALE"
    OTHER_SOURCE = "OTHER_SOURCE"
    SOURCE_LOSS = "SOURCE_LOSS"
    SOURCE_SELDOM = "SOURCE_SELDOM"
    SOURCE_LATE = "SOURCE_LATE"
    SOURCE_JITTER = "SOURCE_JITTER"
    TAKEOVER = "TAKEOVER"
    RANGE = "RANGE"
    STANDBY = "STANDBY"
    F_MIN = "F_MIN"
    F_MAX = "F_MAX"
    RATE = "RATE"
    LOW_CONFIDENCE = "LOW_CONFIDENCE"
    TRIM = "TRIM"
    MODEL_RANGE = "MODEL_RANGE"
    CEILING = "CEILING"
    OVER_FORCE = "OVER_FORCE"
    SENSOR = "SENSOR"
    DEVICE_OR_SENSOR = "DEVICE_OR_SENSOR"
    SENSOR_ZERO = "SENSOR_ZERO"
    OFFSET_UNKNOWN = "OFFSET_UNKNOWN"
    HANDLE_LOST = "HANDLE_LOST"
    SATURATED = "SATURATED"
    SKEW = "SKEW"
    HOST_STALL = "HOST_STALL"
    DEVICE_SILENT = "DEVICE_SILENT"
    SENSE_STALE = "SENSE_STALE"
    ENCODER = "ENCODER"
    LINK_DEGRADED = "LINK_DEGRADED"
    CLOCK = "CLOCK"
    NO_BLACK_BOX = "NO_BLACK_BOX"


FAULTS: dict[Fault, Explanation] = {
    Fault.STOPPED: Explanation(
        "somebody gave the stop command", "tormagctl arm when it is safe to go on", Reaction.OPENING, hazard="SHUT"
    ),
    Fault.HOST_STALL: Explanation(
        "the control loop stopped for more than the device's 50 ms timeout, so the device opened the gap",
        "run `tormagctl doctor`; look for load on this machine; then `tormagctl arm`",
        Reaction.OPENING,
        51.0,
        "once the loop runs again; the device opens before that",
        Position.LOST_THERE,
        hazard="SHUT",
    ),
    Fault.LINK_LOST: Explanation(
        "the device stopped answering, or its port disappeared",
        "check cable and supply, then `tormagctl arm`",
        Reaction.OPENING,
        51.0,
        "at once; the device opens by itself, the daemon knows after 80 ms",
        Position.LOST_THERE,
        hazard="SHUT",
    ),
    Fault.PLAN_FAILED: Explanation(
        "no gap could be planned: the model or the search refused a number, or the search was too slow",
        "report the daemon's log or choose a faster solver, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        hazard="SHUT",
    ),
    Fault.NOT_FINITE: Explanation(
        "the loop computed a number that is not finite",
        "keep and report the recording, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        hazard="CLOSES",
    ),
    Fault.WRONG_DIRECTION: Explanation(
        "a carriage moved against its drive for 0.1 s, or for 3 mm while homing",
        "swap the motor's two wires or the encoder's two phases; do not enable before homing opens the gap",
        Reaction.OPENING,
        200.0,
        "while a carriage moves",
        Position.LOST_HERE,
        hazard="CLOSES",
    ),
    Fault.DEVICE_SCHEMA_MISMATCH: Explanation(
        "daemon and firmware use different protocol versions",
        "install the firmware that fits this daemon",
        Reaction.OPENING,
        100.0,
        "at the first Hello",
        Position.LOST_THERE,
        hazard="MISLED",
    ),
    Fault.DEVICE_SUPPLY: Explanation(
        "the supply voltage is out of range",
        "check the power supply",
        Reaction.HELD,
        100.0,
        "at once",
        Position.LOST_THERE,
        hazard="SHUT",
    ),
    Fault.DEVICE_TEMPERATURE: Explanation(
        "the device is too hot",
        "let it cool down, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        Position.LOST_THERE,
        hazard="WORN",
    ),
    Fault.DEVICE_COMMAND_TIMEOUT: Explanation(
        "the device received no valid drive command for 50 ms and opened the gap",
        "tormagctl arm",
        Reaction.OPENING,
        51.0,
        "at once",
        Position.LOST_THERE,
        hazard="SHUT",
    ),
    Fault.DEVICE_OVERCURRENT: Explanation(
        "a motor drew too much current",
        "look for a blocked carriage or, while homing, a dead or swapped open switch; then `tormagctl arm`",
        Reaction.OPENING,
        500.0,
        "while a blocked carriage is driven",
        Position.LOST_THERE,
        hazard="WORN",
    ),
    Fault.DEVICE_END_STOP: Explanation(
        "a carriage reached its closed end stop",
        "if none was near it, check switch and encoder; then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        Position.LOST_THERE,
        hazard="WORN",
    ),
    Fault.DEVICE_SKEW: Explanation(
        "the device measured its carriages over 2 mm apart",
        "look for a blocked carriage, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        Position.LOST_THERE,
        hazard="WORN",
    ),
    Fault.DEVICE_UNCOMMANDED_MOTION: Explanation(
        "a carriage moved with its drive off",
        "do not use it: a worn gearbox may let the magnets pull shut",
        Reaction.OPENING,
        300.0,
        "while drives are off, or open",
        Position.LOST_THERE,
        hazard="CLOSES",
    ),
    Fault.DEVICE_HOMING_FAILED: Explanation(
        "a home switch was not found in time",
        "check switches and screws, then `tormagctl arm`",
        Reaction.HELD,
        12000.0,
        "while it homes",
        Position.LOST_THERE,
        hazard="MISLED",
    ),
    Fault.DEVICE_RETRACT_FAILED: Explanation(
        "the device could not open the gap",
        "remove the insert by hand; check motors, open switches and supply",
        Reaction.HELD,
        6000.0,
        "while it opens",
        Position.LOST_THERE,
        hazard="SHUT",
    ),
    Fault.HOMING: Explanation(
        "homing took over 12 s, missed a switch, or backed off from one that stays closed",
        "check open switches and screws, then `tormagctl arm`",
        Reaction.OPENING,
        12100.0,
        "while it homes",
        Position.LOST_HERE,
        hazard="MISLED",
    ),
    Fault.ENCODER: Explanation(
        "an encoder moved three times faster than any motor can: it lost or added counts",
        "check the encoder's cable and screen, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        Position.LOST_HERE,
        hazard="MISLED",
    ),
    Fault.OUT_OF_STROKE: Explanation(
        "a homed carriage reads over 2.5 mm outside its stroke or over 0.4 mm from its switch: counts are lost, "
        "the zero is wrong, or a switch is stuck, dead or swapped",
        "check switches and encoders, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        Position.LOST_HERE,
        hazard="MISLED",
    ),
    Fault.MEASUREMENT_STALE: Explanation(
        "no State came for `device.measurement_timeout_ms`, 50 ms, or too late to close the loop",
        "check cable, supply, the round trip in `tormagctl firmware`, and `tormagctl doctor`; then `tormagctl arm`",
        Reaction.OPENING,
        52.0,
        "at once; 50 ms of nothing, which begin with a tick, and a tick to tell the device",
        hazard="MISLED",
    ),
    Fault.SENSE_STALE: Explanation(
        "the device sent no Sense for 100 ms, so the force and the handle that the scene needs are unknown",
        "check the firmware, and `refused` in `tormagctl firmware`; then `tormagctl arm`",
        Reaction.OPENING,
        102.0,
        "at once; 100 ms of nothing, which begin with a tick, and a tick to tell the device",
        hazard="MISLED",
    ),
    Fault.STATUS_STALE: Explanation(
        "the device sent no Status for 100 ms, so its faults, switches and supply are unknown",
        "check the firmware, and `refused` in `tormagctl firmware`; then `tormagctl arm`",
        Reaction.OPENING,
        102.0,
        "at once; 100 ms of nothing, which begin with a tick, and a tick to tell the device",
        hazard="MISLED",
    ),
    Fault.LINK_DEGRADED: Explanation(
        "the device answers too late: over 0.8 of the delay that makes the position loop swing, 11 ms at 1 kHz",
        "check the round trip in `tormagctl firmware`: latency timer (`tormagctl doctor`), hub or full bus; then "
        "`tormagctl arm`",
        Reaction.OPENING,
        500.0,
        "over some round trips",
        hazard="CLOSES",
    ),
    Fault.CLOCK: Explanation(
        "the device's clock is over 10 % off or stopped, so its speeds and timeouts are wrong",
        "check the firmware's timer and clock source, then `tormagctl arm`",
        Reaction.OPENING,
        4000.0,
        "over some seconds",
        hazard="MISLED",
    ),
    Fault.SKEW: Explanation(
        "the carriages are over `limits.skew_fault_mm` apart, 1 mm",
        "look for dirt or wear on the slower screw, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "while a carriage moves",
        Position.LOST_HERE,
        hazard="WORN",
    ),
    Fault.FOLLOWING_ERROR: Explanation(
        "the gap did not follow its reference for `limits.following_time_s`, 0.25 s",
        "look for a blocked carriage, then `tormagctl arm`",
        Reaction.OPENING,
        1000.0,
        "while the gap is to move",
        Position.LOST_HERE,
        hazard="SHUT",
    ),
    Fault.OVER_FORCE: Explanation(
        "on a brake the measured force exceeded 1.25 times the scene's most_N, and 0.1 N, for 100 ms or often",
        "compare force sensor and gap; check that insert and model are the scene's; then `tormagctl arm`",
        Reaction.OPENING,
        150.0,
        "while the handle moves",
        hazard="CLOSES",
    ),
    Fault.SENSOR: Explanation(
        "for over 2 s of sliding the force sensor, which the scene needs, read what no device gives",
        "check sensor, cable, zero and insert, then `tormagctl arm`",
        Reaction.OPENING,
        3000.0,
        "over 2 s of sliding",
        hazard="MISLED",
    ),
    Fault.NO_MOTION: Explanation(
        "a carriage away from its open switch was driven for `limits.no_motion_time_s`, 60 ms, and its encoder "
        "did not move",
        "look for a blocked carriage or a loose encoder, then `tormagctl arm`",
        Reaction.OPENING,
        250.0,
        "while a carriage is driven: 60 ms of a duty that moves one, which takes a following error to come about",
        Position.LOST_HERE,
        hazard="SHUT",
    ),
    Fault.NOT_OPENING: Explanation(
        "the gap should be open, but a carriage that stopped, reversed or was too slow is 0.35 s late",
        "remove the insert by hand, as it still brakes; check screws, motors and supply, then `tormagctl arm`",
        Reaction.HELD,
        500.0,
        "while it is to be open",
        Position.LOST_HERE,
        hazard="SHUT",
    ),
    Fault.DEVICE_NOT_RUNNING: Explanation(
        "the device stopped taking drive commands, as after a reset",
        "check its supply, then `tormagctl arm`",
        Reaction.OPENING,
        100.0,
        "at once",
        Position.LOST_THERE,
        hazard="SHUT",
    ),
}

LIMITS: dict[Limit, Explanation] = {
    Limit.NO_SETPOINT: Explanation(
        "no publisher has sent a setpoint",
        "start the patient-side robot's publisher",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="NONE",
    ),
    Limit.STALE: Explanation(
        "the newest setpoint is older than its valid_for_ms; the force decays to F_min",
        "check the publisher",
        Reaction.LIMITED,
        110.0,
        "after `valid_for_ms`, 100 ms in the matrix",
        hazard="OPENS",
    ),
    Limit.OTHER_SOURCE: Explanation(
        "another source also sends setpoints, but does not hold the brake",
        "end it, or give it the brake: tormagctl take SOURCE",
        Reaction.HELD,
        100.0,
        "at once",
        hazard="CLOSES",
    ),
    Limit.SOURCE_LOSS: Explanation(
        "over 5 % of the setpoints are lost on the way",
        "find the lossy part of the network",
        Reaction.HELD,
        2000.0,
        "over a second",
        hazard="MISLED",
    ),
    Limit.SOURCE_SELDOM: Explanation(
        "setpoints are rarer than the scene states, or than 20 a second",
        "send more often, or a preview_N that reaches the next one",
        Reaction.HELD,
        2000.0,
        "over a second",
        hazard="MISLED",
    ),
    Limit.SOURCE_LATE: Explanation(
        "setpoints arrive older than the scene's budget.delay_ms",
        "shorten the way, or send a preview_N of that length",
        Reaction.HELD,
        2000.0,
        "over a second",
        hazard="MISLED",
    ),
    Limit.SOURCE_JITTER: Explanation(
        "setpoint delays vary by over 20 ms",
        "set sources.playout_ms to the longest, send a longer preview_N, or take a steadier way",
        Reaction.HELD,
        2000.0,
        "over a second",
        hazard="MISLED",
    ),
    Limit.TAKEOVER: Explanation(
        "the force ramps to the setpoint, because it followed nobody or another publisher before",
        "wait a moment",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="OPENS",
    ),
    Limit.RANGE: Explanation(
        "the setpoint is outside the scene's range",
        "ask within the range, or change the scene",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="CLOSES",
    ),
    Limit.STANDBY: Explanation(
        "the setpoint is below the force at which the scene waits, force.standby_N",
        "none is needed",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="NONE",
    ),
    Limit.F_MIN: Explanation(
        "the setpoint is below what the open gap gives",
        "use an insert with less iron",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="NONE",
    ),
    Limit.F_MAX: Explanation(
        "the setpoint is above what the closed gap gives",
        "use an insert with more iron",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="NONE",
    ),
    Limit.RATE: Explanation(
        "the setpoint changes faster than the carriages travel",
        "ask for slower changes",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="NONE",
    ),
    Limit.LOW_CONFIDENCE: Explanation(
        "the model was asked outside its training",
        "calibrate with this insert and these motions",
        Reaction.HELD,
        100.0,
        "at once",
        hazard="MISLED",
    ),
    Limit.TRIM: Explanation(
        "the measured force is further from the model than the trim may correct",
        "calibrate this insert",
        Reaction.LIMITED,
        1000.0,
        "while the handle slides",
        hazard="MISLED",
    ),
    Limit.MODEL_RANGE: Explanation(
        "the model would have been asked outside what it knows, so it was asked the nearest that it knows",
        "move or ask within its range, or calibrate with these motions",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="MISLED",
    ),
    Limit.CEILING: Explanation(
        "the gap is held where this device, as far as known, cannot exceed the scene's greatest force",
        "turn the handle so that the device shows its force, or ask for less",
        Reaction.LIMITED,
        100.0,
        "at once",
        hazard="CLOSES",
    ),
    Limit.OVER_FORCE: Explanation(
        "the measured force is over what the scene allows; the gap opens",
        "check force sensor and insert",
        Reaction.OPENING,
        100.0,
        "while the handle moves",
        hazard="CLOSES",
    ),
    Limit.SENSOR: Explanation(
        "the force sensor is stuck or reads what no device gives at this gap; nothing is learned from it",
        "check sensor, cable, zero and insert",
        Reaction.HELD,
        1000.0,
        "while the handle slides",
        hazard="MISLED",
    ),
    Limit.DEVICE_OR_SENSOR: Explanation(
        "the readings differ from what the device first showed by more than trim.leash: the device changed or the "
        "sensor is wrong; a fall is followed only so far",
        "turn the handle back and forth once; then tormagctl confirm device, or tormagctl confirm sensor",
        Reaction.HELD,
        500.0,
        "while the handle slides",
        hazard="MISLED",
    ),
    Limit.SENSOR_ZERO: Explanation(
        "the handle's reversals show that the force sensor is far off its zero; its readings are corrected",
        "tare the sensor when the handle is free",
        Reaction.HELD,
        5000.0,
        "at reversals of the handle",
        hazard="MISLED",
    ),
    Limit.OFFSET_UNKNOWN: Explanation(
        "the handle has not reversed for so long that the sensor's zero may have drifted; only what that does not "
        "explain is learned",
        "turn the handle back and forth once, by 10 mm",
        Reaction.HELD,
        480100.0,
        "while the handle turns one way",
        hazard="MISLED",
    ),
    Limit.HANDLE_LOST: Explanation(
        "the handle's encoder does not move although the force shows that the shaft does; nothing is learned",
        "check the handle's encoder and cable and turn the handle; then check the force sensor",
        Reaction.HELD,
        2000.0,
        "while the force rises by 0.15 N or more",
        hazard="MISLED",
    ),
    Limit.SATURATED: Explanation(
        "a motor has no more voltage to give",
        "expect lag while it lasts",
        Reaction.HELD,
        100.0,
        "while a carriage is driven",
        hazard="NONE",
    ),
    Limit.SKEW: Explanation(
        "the carriages are over `limits.skew_warning_mm` apart",
        "look at the slower screw",
        Reaction.HELD,
        100.0,
        "while a carriage moves",
        hazard="WORN",
    ),
    Limit.HOST_STALL: Explanation(
        "the control loop stopped for 5 to 50 ms; the gap was held until the device answered",
        "run `tormagctl doctor`; look for load on this machine",
        Reaction.HELD,
        51.0,
        "once the loop runs again",
        hazard="OPENS",
    ),
    Limit.DEVICE_SILENT: Explanation(
        "the device has sent no new state for 5 to 50 ms; the gap is held until it does",
        "check the round trip in `tormagctl firmware`",
        Reaction.HELD,
        51.0,
        "at once",
        hazard="OPENS",
    ),
    Limit.SENSE_STALE: Explanation(
        "the device sent no Sense for 20 ms: force and handle are unknown, and nothing is learned",
        "check the firmware, and `refused` in `tormagctl firmware`",
        Reaction.HELD,
        51.0,
        "at once",
        hazard="MISLED",
    ),
    Limit.ENCODER: Explanation(
        "an encoder jumped; the gap is held until the device says whether it was reset",
        "check the encoder's cable and screen",
        Reaction.HELD,
        100.0,
        "at once",
        hazard="OPENS",
    ),
    Limit.LINK_DEGRADED: Explanation(
        "the link loses or damages over 2 % of the messages, or is slower than 0.4 of what the loop bears, 6 ms "
        "at 1 kHz",
        "check cable, termination and adapter; see the link in `tormagctl firmware`",
        Reaction.HELD,
        1000.0,
        "over some hundred messages",
        hazard="MISLED",
    ),
    Limit.CLOCK: Explanation(
        "the device's clock is over 1 % off, and so are all speeds and its timeouts",
        "check the firmware's timer and clock source",
        Reaction.HELD,
        4000.0,
        "over some seconds",
        hazard="MISLED",
    ),
    Limit.NO_BLACK_BOX: Explanation(
        "the process that writes black boxes has ended, and another one begins; nothing is held back",
        "see the daemon's log if it stays",
        Reaction.HELD,
        200.0,
        hazard="NONE",
    ),
}

_BY_DEVICE_FAULT: dict[DeviceFault, Fault] = {bit: Fault(f"DEVICE_{bit.name}") for bit in DeviceFault}


def device_faults(bits: DeviceFault, *, is_host_stall: bool = False) -> tuple[Fault, ...]:
    """Return the faults for the firmware's fault bits."""
    names = _BY_DEVICE_FAULT | ({DeviceFault.COMMAND_TIMEOUT: Fault.HOST_STALL} if is_host_stall else {})
    return tuple(fault for bit, fault in names.items() if bit in bits)
