"""Messages, enumerations and byte layouts. Generated from tormag.dbc; to change it, see `generate.py`."""

from enum import STRICT, IntEnum, IntFlag
from typing import Final, NamedTuple

from firmware_protocol.schema import Layout, Signal

PROTOCOL_VERSION: Final = 1
SCHEMA_HASH: Final = 0x4B3A3191


class DriveMode(IntEnum):
    """OFF is a heartbeat that keeps replies coming; RUN asks for the duties. OFF after RUN makes the device open the
    gap.
    """

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
    """Bit mask: end switches that are closed, and whether the zero of the encoders is valid."""

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


class Retract(NamedTuple):
    """Host -> Device. Open the gap at the device's bounded rate, then switch the drives off. Sent on event, repeated
    until Status carries its nonce.
    """

    # New for every command, equal in its repetitions: the device acts on a nonce once.
    nonce: int


class Drive(NamedTuple):
    """Host -> Device. Motor duties. Every 1 ms; each accepted one is answered by State and Sense. In RUN, 50 ms
    without a valid one makes the device open the gap and latch COMMAND_TIMEOUT.
    """

    # Share of the supply voltage at the left motor; positive opens.
    left_duty: float
    # Share of the supply voltage at the right motor; positive opens.
    right_duty: float
    # OFF is a heartbeat that keeps replies coming; RUN asks for the duties. OFF after RUN makes the device open the
    # gap.
    mode: DriveMode
    # One more for each Drive, modulo 256. A Drive whose counter did not change is not accepted.
    counter: int


class State(NamedTuple):
    """Device -> Host. Where the carriages are. Sent at once for each accepted Drive, so every 1 ms."""

    # Left screw relative to home (8 mm lead, 4480 counts a turn): 0 at the open end, negative towards closed.
    # Counts modulo 2^16; the host unwraps.
    left_position_mm: float
    # Right screw relative to home, as the left.
    right_position_mm: float
    # When the positions were latched, on the device's clock, modulo 0.65536 s.
    device_time_s: float
    # One more for each State, modulo 256.
    counter: int


class Sense(NamedTuple):
    """Device -> Host. Currents, force and handle, sampled with the State it follows. Sent at once for each accepted
    Drive, so every 1 ms.
    """

    # Left motor current; positive drives towards open.
    left_current_A: float
    # Right motor current; positive drives towards open.
    right_current_A: float
    # Friction force at the roller, positive against a positive motion of the handle.
    force_N: float
    # Roller surface position: 16384 counts a turn at 20 mm radius, counts modulo 2^16 (four turns); the host
    # unwraps.
    handle_position_mm: float


class Clear(NamedTuple):
    """Host -> Device. Clear latched faults whose cause is gone. Sent on event, repeated until Status carries its
    nonce.
    """

    # As in Retract.
    nonce: int


class Home(NamedTuple):
    """Host -> Device. Find the open end and zero the encoders there. Sent on event, repeated until Status carries
    its nonce.
    """

    # As in Retract.
    nonce: int


class Status(NamedTuple):
    """Device -> Host. What the device is doing and what is wrong. Every 20 ms on the device's own clock, host or no
    host.
    """

    # Operating mode of the device.
    mode: DeviceMode
    # Bit mask: end switches that are closed, and whether the zero of the encoders is valid.
    switches: Switches
    # Bit mask: latched faults.
    faults: DeviceFault
    # Temperature at the elastomer's mount.
    temperature_C: float
    # Supply voltage at the motor bridges.
    supply_V: float
    # Counter of the last accepted Drive.
    drive_counter: int
    # Nonce of the last accepted command.
    command_nonce: int


class Hello(NamedTuple):
    """Host -> Device. First message of a host; answered by Identity. Sent on connecting and after a device reset,
    repeated until answered.
    """

    # First four bytes, big-endian, of the SHA-256 of this file's canonical layout, as the host knows it.
    schema_hash: int
    # Version of the rules around the messages: framing, timing, meaning.
    protocol_version: int
    # As in Retract.
    nonce: int


class Identity(NamedTuple):
    """Device -> Host. Answer to Hello. A device that was compiled from another schema latches SCHEMA_MISMATCH and
    refuses Drive RUN.
    """

    # As in Hello, as the device knows it.
    schema_hash: int
    # Firmware version, major.
    firmware_major: int
    # Firmware version, minor.
    firmware_minor: int
    # Serial number of the device.
    serial_number: int


Message = Retract | Drive | State | Sense | Clear | Home | Status | Hello | Identity

LAYOUTS: Final = (
    Layout(
        message=Retract,
        function=1,
        format="<B",
        protected=False,
        signals=(Signal("nonce", int, 1, 0, 255),),
    ),
    Layout(
        message=Drive,
        function=2,
        format="<hhBBB",
        protected=True,
        signals=(
            Signal("left_duty", float, 0.0001, -1, 1),
            Signal("right_duty", float, 0.0001, -1, 1),
            Signal("mode", DriveMode, 1, 0, 1),
            Signal("counter", int, 1, 0, 255),
        ),
    ),
    Layout(
        message=State,
        function=3,
        format="<hhHBB",
        protected=True,
        signals=(
            Signal("left_position_mm", float, 0.0017857142857142857, -58.51428571428571, 58.5125, wraps=True),
            Signal("right_position_mm", float, 0.0017857142857142857, -58.51428571428571, 58.5125, wraps=True),
            Signal("device_time_s", float, 1e-05, 0, 0.65535, wraps=True),
            Signal("counter", int, 1, 0, 255),
        ),
    ),
    Layout(
        message=Sense,
        function=4,
        format="<hhhH",
        protected=False,
        signals=(
            Signal("left_current_A", float, 0.001, -32.768, 32.767),
            Signal("right_current_A", float, 0.001, -32.768, 32.767),
            Signal("force_N", float, 0.001, -32.768, 32.767),
            Signal("handle_position_mm", float, 0.007669903939428206, 0, 502.6471546704275, wraps=True),
        ),
    ),
    Layout(
        message=Clear,
        function=5,
        format="<B",
        protected=False,
        signals=(Signal("nonce", int, 1, 0, 255),),
    ),
    Layout(
        message=Home,
        function=6,
        format="<B",
        protected=False,
        signals=(Signal("nonce", int, 1, 0, 255),),
    ),
    Layout(
        message=Status,
        function=7,
        format="<BBHbBBB",
        protected=False,
        signals=(
            Signal("mode", DeviceMode, 1, 0, 4),
            Signal("switches", Switches, 1, 0, 31),
            Signal("faults", DeviceFault, 1, 0, 1023),
            Signal("temperature_C", float, 1, -128, 127),
            Signal("supply_V", float, 0.1, 0, 25.5),
            Signal("drive_counter", int, 1, 0, 255),
            Signal("command_nonce", int, 1, 0, 255),
        ),
    ),
    Layout(
        message=Hello,
        function=8,
        format="<IBB",
        protected=False,
        signals=(
            Signal("schema_hash", int, 1, 0, 4294967295),
            Signal("protocol_version", int, 1, 0, 255),
            Signal("nonce", int, 1, 0, 255),
        ),
    ),
    Layout(
        message=Identity,
        function=9,
        format="<IBBH",
        protected=False,
        signals=(
            Signal("schema_hash", int, 1, 0, 4294967295),
            Signal("firmware_major", int, 1, 0, 255),
            Signal("firmware_minor", int, 1, 0, 255),
            Signal("serial_number", int, 1, 0, 65535),
        ),
    ),
)
