"""Messages and byte layouts. Generated from tormag.dbc; to change it, see `generate.py`."""

from typing import Final, final

from firmware_protocol.enumerations import (
    DeviceFault,
    DeviceMode,
    DriveMode,
    Switches,
)
from firmware_protocol.schema import Layout, Signal
from firmware_protocol.value import Value

PROTOCOL_VERSION: Final = 1
SCHEMA_HASH: Final = 0x4B3A3191


@final
class Retract(Value):
    """Host -> Device. Open the gap at the device's bounded rate, then switch the drives off."""

    def __init__(
        self,
        nonce: int,
    ) -> None:
        # New for every command, equal in its repetitions: the device acts on a nonce once.
        self.nonce: Final = nonce


@final
class Drive(Value):
    """Host -> Device. Motor duties. Every 1 ms."""

    def __init__(
        self,
        left_duty: float,
        right_duty: float,
        mode: DriveMode,
        counter: int,
    ) -> None:
        # Share of the supply voltage at the left motor; positive opens.
        self.left_duty: Final = left_duty
        # As left_duty, at the right motor.
        self.right_duty: Final = right_duty
        # RUN asks for the duties, OFF for replies alone. OFF after RUN makes the device open the gap.
        self.mode: Final = mode
        # One more for each Drive, modulo 256.
        self.counter: Final = counter


@final
class State(Value):
    """Device -> Host. Where the carriages are. Sent for each accepted Drive."""

    def __init__(
        self,
        left_position_mm: float,
        right_position_mm: float,
        device_time_s: float,
        counter: int,
    ) -> None:
        # Left screw relative to home (8 mm lead, 4480 counts a turn): 0 at the open end, negative towards closed.
        self.left_position_mm: Final = left_position_mm
        # Right screw relative to home, as the left.
        self.right_position_mm: Final = right_position_mm
        # When the positions were latched, on the device's clock.
        self.device_time_s: Final = device_time_s
        # One more for each State, modulo 256.
        self.counter: Final = counter


@final
class Sense(Value):
    """Device -> Host. Currents, force and handle, sampled with the State it follows. Sent for each accepted Drive."""

    def __init__(
        self,
        left_current_A: float,
        right_current_A: float,
        force_N: float,
        handle_position_mm: float,
    ) -> None:
        # Left motor current; positive drives towards open.
        self.left_current_A: Final = left_current_A
        # Right motor current, as the left.
        self.right_current_A: Final = right_current_A
        # Friction force at the roller, positive against a positive motion of the handle.
        self.force_N: Final = force_N
        # Roller surface position: 16384 counts a turn at 20 mm radius.
        self.handle_position_mm: Final = handle_position_mm


@final
class Clear(Value):
    """Host -> Device. Clear latched faults whose cause is gone."""

    def __init__(
        self,
        nonce: int,
    ) -> None:
        # As in Retract.
        self.nonce: Final = nonce


@final
class Home(Value):
    """Host -> Device. Find the open end and zero the encoders there."""

    def __init__(
        self,
        nonce: int,
    ) -> None:
        # As in Retract.
        self.nonce: Final = nonce


@final
class Status(Value):
    """Device -> Host. What the device is doing and what is wrong. Every 20 ms."""

    def __init__(
        self,
        mode: DeviceMode,
        switches: Switches,
        faults: DeviceFault,
        temperature_C: float,
        supply_V: float,
        drive_counter: int,
        command_nonce: int,
    ) -> None:
        # Operating mode of the device.
        self.mode: Final = mode
        # Bit mask: closed end switches, and whether the encoders have a zero.
        self.switches: Final = switches
        # Bit mask: latched faults.
        self.faults: Final = faults
        # Temperature at the elastomer's mount.
        self.temperature_C: Final = temperature_C
        # Supply voltage at the motor bridges.
        self.supply_V: Final = supply_V
        # Counter of the last accepted Drive.
        self.drive_counter: Final = drive_counter
        # Nonce of the last accepted command.
        self.command_nonce: Final = command_nonce


@final
class Hello(Value):
    """Host -> Device. First message of a host; answered by Identity."""

    def __init__(
        self,
        schema_hash: int,
        protocol_version: int,
        nonce: int,
    ) -> None:
        # Beginning of the SHA-256 of the canonical layout, as the host knows it.
        self.schema_hash: Final = schema_hash
        # Version of the rules around the messages: framing, timing, meaning.
        self.protocol_version: Final = protocol_version
        # As in Retract.
        self.nonce: Final = nonce


@final
class Identity(Value):
    """Device -> Host. Answer to Hello."""

    def __init__(
        self,
        schema_hash: int,
        firmware_major: int,
        firmware_minor: int,
        serial_number: int,
    ) -> None:
        # As in Hello, as the device knows it.
        self.schema_hash: Final = schema_hash
        # Firmware version, major.
        self.firmware_major: Final = firmware_major
        # Firmware version, minor.
        self.firmware_minor: Final = firmware_minor
        # Serial number of the device.
        self.serial_number: Final = serial_number


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
