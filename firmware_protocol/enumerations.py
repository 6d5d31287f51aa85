"""Enumerations of the wire. Generated from tormag.dbc; to change it, see `generate.py`."""

from enum import STRICT, IntEnum, IntFlag


class DriveMode(IntEnum):
    """RUN asks for the duties, OFF for replies alone. OFF after RUN makes the device open the gap."""

    OFF = 0
    RUN = 1


class DeviceMode(IntEnum):
    """Operating mode of the device."""

    IDLE = 0
    RUN = 1
    HOMING = 2
    RETRACTING = 3
    LATCHED = 4


class Switches(IntFlag, boundary=STRICT):
    """Bit mask: closed end switches, and whether the encoders have a zero."""

    LEFT_OPEN = 1
    RIGHT_OPEN = 2
    LEFT_CLOSED = 4
    RIGHT_CLOSED = 8
    HOMED = 16


class DeviceFault(IntFlag, boundary=STRICT):
    """Bit mask: latched faults."""

    COMMAND_TIMEOUT = 1
    UNCOMMANDED_MOTION = 2
    OVERCURRENT = 4
    END_STOP = 8
    HOMING_FAILED = 16
    SUPPLY = 32
    TEMPERATURE = 64
    SCHEMA_MISMATCH = 128
    SKEW = 256
    RETRACT_FAILED = 512
