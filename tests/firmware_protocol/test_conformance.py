"""The conformance kit passes the simulated device on both carriers, in both languages, and finds what is wrong by name.

Everything runs in virtual time but one live session. A wrong device is the simulated one with one error planted: in its
firmware (`Rogue`), on its wire (`Wire`), or as a fault of the simulator's own.
"""

import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

import firmware_protocol
from firmware_protocol.codec import (
    FUNCTION,
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    crc8,
    encode,
)
from firmware_protocol.conformance import __main__ as command
from firmware_protocol.conformance.check import Check, Result, run
from firmware_protocol.conformance.examination import CHECKS, checks_on
from firmware_protocol.conformance.host import Host
from firmware_protocol.conformance.line import CanLine, Line, SerialLine
from firmware_protocol.conformance.overall import left_open
from firmware_protocol.framing import DELIMITER, FrameDecoder, cobs_decode, cobs_encode, encode_frame
from tormagd.simulation.can_device import DEVICE, CanDevice
from tormagd.simulation.can_frame import CanFrame
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import FirmwareKind, MessageDevice, VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.firmware import Answer, Firmware, Output, Sensors
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

PAGE = Path(firmware_protocol.__file__).parent / "README.md"
SAMPLE = load_plant("sample_1")
NEAR_HOME = msgspec.structs.replace(
    SAMPLE, assumed=msgspec.structs.replace(SAMPLE.assumed, start_left_mm=45.5, start_right_mm=45.0)
)
"""Homing takes less time, and the origin still moves by more than it may."""


# -- ports in virtual time -----------------------------------------------------------------------------------------


class Wire:
    """A serial port of a simulated device, in virtual time: a `BytePort`. Wrong ones spoil what passes."""

    def __init__(self, device: VirtualDevice) -> None:
        self.device = device
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def write(self, data: bytes) -> None:
        self.device.receive(self.time_s, self.down(data))

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        self.time_s = max(self.time_s, until_s)
        return [(self.time_s, self.up(self.device.transmit(self.time_s)))]

    def close(self) -> None:
        pass

    def down(self, data: bytes) -> bytes:
        return data

    def up(self, data: bytes) -> bytes:
        return data


class Bus:
    """The same of a CAN bus: a `FramePort`."""

    def __init__(self, device: CanDevice, *, every_node: bool = False) -> None:
        self.device = device
        self.time_s = 0.0
        self._every_node = every_node

    def now_s(self) -> float:
        return self.time_s

    def write(self, identifier: int, data: bytes) -> None:
        if self._every_node:
            identifier = identifier & ~0xF | 1
        self.device.receive(self.time_s, CanFrame(identifier, data))

    def read(self, until_s: float) -> list[tuple[float, int, bytes]]:
        self.time_s = max(self.time_s, until_s)
        delivered = self.device.transmit(self.time_s)
        return [(self.time_s, frame.identifier, frame.data) for sender, frame in delivered if sender == DEVICE]

    def close(self) -> None:
        pass


def serial_line(
    boot: FirmwareKind = Firmware,
    wire: type[Wire] = Wire,
    faults: Sequence[str] = (),
    plant: PlantParameters = NEAR_HOME,
) -> SerialLine:
    return SerialLine(wire(VirtualDevice(plant, SteadyHand(), [parse_fault(fault) for fault in faults], boot=boot)))


def can_line(boot: FirmwareKind = Firmware, *, every_node: bool = False) -> CanLine:
    device = CanDevice(MessageDevice(NEAR_HOME, SteadyHand(), boot=boot))
    return CanLine(Bus(device, every_node=every_node), 1)


# -- the right device ----------------------------------------------------------------------------------------------


def passed(line: Line) -> Sequence[Result]:
    results = run(Host(line), checks_on(line))
    assert [(result.check.name, result.seen) for result in results if not result.passed] == []
    return results


def test_the_simulated_device_passes_on_a_serial_line() -> None:
    results = passed(serial_line(plant=SAMPLE))
    assert {result.check.name for result in results} == {one.name for one in CHECKS} - {"other_node"}
    assert results[-1].check is left_open


def test_the_simulated_device_passes_on_a_bus() -> None:
    names = {result.check.name for result in passed(can_line())}
    assert "other_node" in names
    assert "frame_crc_16" not in names


def test_the_c_sources_pass(library: object) -> None:
    passed(serial_line(CompiledFirmware))


# -- wrong firmwares -----------------------------------------------------------------------------------------------


class Rogue(CompiledFirmware):
    """The Python firmware behind the interface that a device boots, for one rule to be broken."""

    def __init__(self, plant: PlantParameters) -> None:
        self.plant = plant
        self.real = Firmware(plant)
        self.drive_s = 0.0

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        if isinstance(message, Drive):
            self.drive_s = time_s
        return self.take(time_s, message, sensors)

    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        return self.answered(message, self.real.receive(time_s, self.heard(time_s, message), sensors))

    def heard(self, time_s: float, message: Message) -> Message:
        """What it takes a message for."""
        return message

    def answered(self, message: Message, answer: Answer) -> Answer:
        """What it makes of the right answer."""
        return answer

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        status = self.real.tick(time_s, sensors)
        self.ticked(time_s)
        return status and self.shown(time_s, status)

    def ticked(self, time_s: float) -> None:
        """What it does after each tick."""

    def shown(self, time_s: float, status: Status) -> Status | None:
        """What it makes of a right Status."""
        return status

    def status(self, sensors: Sensors) -> Status:
        return self.real.status(sensors)

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        return self.measured(time_s, *self.real.measurement(time_s, sensors))

    def measured(self, time_s: float, state: State, sense: Sense) -> tuple[State, Sense]:
        """What it makes of a right measurement."""
        return state, sense

    def identity(self) -> Identity:
        return self.real.identity()

    @property
    def mode(self) -> DeviceMode:
        return self.real.mode

    @property
    def faults(self) -> DeviceFault:
        return self.real.faults

    @property
    def homed(self) -> bool:
        return self.real.homed

    @property
    def output(self) -> Output:
        return self.real.output


class OtherHash(Rogue):
    def identity(self) -> Identity:
        return self.real.identity().replaced(schema_hash=SCHEMA_HASH ^ 0x100)


class HashBytesReversed(Rogue):
    def identity(self) -> Identity:
        return self.real.identity().replaced(schema_hash=int.from_bytes(SCHEMA_HASH.to_bytes(4, "little"), "big"))


class AnswersHelloOnce(Rogue):
    said = 0

    def answered(self, message: Message, answer: Answer) -> Answer:
        self.said += isinstance(message, Hello)
        return Answer.NONE if isinstance(message, Hello) and self.said > 1 else answer


class HelloIsNoNonce(Rogue):
    kind: type[Message] = Hello

    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        before = self.real._nonce
        answer = self.real.receive(time_s, message, sensors)
        if isinstance(message, self.kind):
            self.real._nonce = before
        return answer


class NonceNotShown(HelloIsNoNonce):
    kind = Retract


class IgnoresSchema(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        return message.replaced(schema_hash=SCHEMA_HASH) if isinstance(message, Hello) else message


class IgnoresVersion(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        return message.replaced(protocol_version=1) if isinstance(message, Hello) else message


class ClearsMismatch(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        if isinstance(message, Clear):
            self.real._compatible = True
        return message


class ClearIgnored(Rogue):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        return Answer.NONE if isinstance(message, Clear) else self.real.receive(time_s, message, sensors)


class RunsUnhomed(Rogue):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        homed, self.real.homed = self.real.homed, True
        answer = self.real.receive(time_s, message, sensors)
        self.real.homed = homed and self.real.homed
        return answer


class SlowStatus(Rogue):
    count = 0

    def shown(self, time_s: float, status: Status) -> Status | None:
        self.count += 1
        return status if self.count % 2 else None


class StatusOnlyBesideDrives(Rogue):
    def shown(self, time_s: float, status: Status) -> Status | None:
        return status if time_s - self.drive_s < 0.3 else None


class StatusLagsBesideDrives(Rogue):
    count = 0

    def shown(self, time_s: float, status: Status) -> Status | None:
        self.count += 1
        return None if self.count % 4 == 0 and time_s - self.drive_s < 0.01 else status


class StateCounterStuck(Rogue):
    def measured(self, time_s: float, state: State, sense: Sense) -> tuple[State, Sense]:
        return state.replaced(counter=5), sense


class StateCounterRepeated(Rogue):
    def measured(self, time_s: float, state: State, sense: Sense) -> tuple[State, Sense]:
        return state.replaced(counter=state.counter // 2), sense


class ClockInMilliseconds(Rogue):
    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        return self.real.measurement(time_s * 0.01, sensors)


class DriveCounterBehind(Rogue):
    def shown(self, time_s: float, status: Status) -> Status | None:
        return status.replaced(drive_counter=(status.drive_counter - 1) % 256)


class AnswersRepetitions(Rogue):
    def answered(self, message: Message, answer: Answer) -> Answer:
        return Answer.MEASUREMENT if isinstance(message, Drive) else answer


class SupplyInTenths(Rogue):
    def shown(self, time_s: float, status: Status) -> Status | None:
        return status.replaced(supply_V=status.supply_V / 10.0)


class CurrentOffset(Rogue):
    def measured(self, time_s: float, state: State, sense: Sense) -> tuple[State, Sense]:
        return state, sense.replaced(left_current_A=sense.left_current_A + 0.5)


class HomeIgnored(Rogue):
    """Acknowledged all the same."""

    kind: type[Home] | type[Retract] = Home

    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        if isinstance(message, self.kind):
            self.real._nonce = message.nonce
            return Answer.NONE
        return self.real.receive(time_s, message, sensors)


class RetractIgnored(HomeIgnored):
    kind = Retract


class HomeKeepsOrigin(Rogue):
    def measured(self, time_s: float, state: State, sense: Sense) -> tuple[State, Sense]:
        left_mm = state.left_position_mm + self.real._left_zero_mm
        return state.replaced(left_position_mm=left_mm, right_position_mm=left_mm), sense


class HomedBeforeZero(Rogue):
    """HOMED shows 40 ms before State is in the new origin."""

    zeroed_s = -1.0

    def measured(self, time_s: float, state: State, sense: Sense) -> tuple[State, Sense]:
        if self.real.homed and self.zeroed_s < 0.0:
            self.zeroed_s = time_s + 0.04
        if time_s < self.zeroed_s:
            state = state.replaced(left_position_mm=state.left_position_mm + self.real._left_zero_mm)
        return state, sense


class ObeysRepetitions(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        if isinstance(message, Home):
            self.real._nonce = None
        return message


class ClearEndsAnything(Rogue):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        if isinstance(message, Clear) and self.real.output.enabled:
            self.real._nonce = message.nonce
            self.real._rest(time_s, DeviceMode.IDLE)
            return Answer.NONE
        return self.real.receive(time_s, message, sensors)


class HomesFromAnywhere(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        if isinstance(message, Home) and message.nonce != self.real._nonce:
            self.real.mode, self.real.faults = DeviceMode.IDLE, DeviceFault(0)
        return message


class RetractsWhenLatched(Rogue):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        if isinstance(message, Retract) and self.real.mode is DeviceMode.LATCHED:
            self.real._nonce = message.nonce
            return Answer.NONE
        return self.real.receive(time_s, message, sensors)


class NeverRuns(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        return message.replaced(mode=DriveMode.OFF) if isinstance(message, Drive) else message


class ModesMixedUp(Rogue):
    def shown(self, time_s: float, status: Status) -> Status | None:
        swap = {DeviceMode.RUN: DeviceMode.HOMING, DeviceMode.HOMING: DeviceMode.RUN}
        return status.replaced(mode=swap.get(status.mode, status.mode))


class MotorsSwapped(Rogue):
    @property
    def output(self) -> Output:
        output = self.real.output
        if self.real.mode is not DeviceMode.RUN:
            return output
        return Output(output.right_duty, output.left_duty, output.enabled)


class PushesIntoStop(Rogue):
    asked: Drive | None = None

    def heard(self, time_s: float, message: Message) -> Message:
        if isinstance(message, Drive):
            self.asked = message
        return message

    @property
    def output(self) -> Output:
        if self.real.mode is not DeviceMode.RUN or self.asked is None:
            return self.real.output
        return Output(self.asked.left_duty, self.asked.right_duty, enabled=True)


class OffOnlySwitchesOff(Rogue):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        was_running = self.real.mode is DeviceMode.RUN
        answer = self.real.receive(time_s, message, sensors)
        if was_running and isinstance(message, Drive) and message.mode is DriveMode.OFF:
            self.real._rest(time_s, DeviceMode.IDLE)
        return answer


class NeedsNoLettingGo(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        self.real._may_run = True
        return message


class NeedsNoLettingGoAfterFault(Rogue):
    def answered(self, message: Message, answer: Answer) -> Answer:
        if isinstance(message, Clear):
            self.real._may_run = True
        return answer


class NeverOpens(OffOnlySwitchesOff):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        return Answer.NONE if isinstance(message, Retract) else super().take(time_s, message, sensors)


class HelloResets(Rogue):
    def take(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        if isinstance(message, Hello) and self.real.mode is DeviceMode.RUN:
            self.real = Firmware(self.plant)
            return Answer.IDENTITY
        return self.real.receive(time_s, message, sensors)


class MismatchInRunPasses(IgnoresSchema):
    def heard(self, time_s: float, message: Message) -> Message:
        return super().heard(time_s, message) if self.real.mode is DeviceMode.RUN else message


class NoTimeout(Rogue):
    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        self.real._drive_s = time_s
        return self.real.tick(time_s, sensors)


class TimeoutOf65ms(Rogue):
    timeout_s = 0.065

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        self.real._drive_s = time_s if time_s - self.drive_s <= self.timeout_s else time_s - 1.0
        return self.real.tick(time_s, sensors)


class TimeoutOf35ms(TimeoutOf65ms):
    timeout_s = 0.035


class TimeoutWithoutOpening(Rogue):
    def ticked(self, time_s: float) -> None:
        if self.real.mode is DeviceMode.RETRACTING and DeviceFault.COMMAND_TIMEOUT in self.real.faults:
            self.real._rest(time_s, DeviceMode.LATCHED)


class AnyMessageExtends(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        self.real._drive_s = time_s
        return message


class RepetitionExtends(Rogue):
    def heard(self, time_s: float, message: Message) -> Message:
        if isinstance(message, Drive):
            self.real._drive_s = time_s
        return message


class DoesNotLatch(Rogue):
    def ticked(self, time_s: float) -> None:
        if self.real.mode is DeviceMode.LATCHED:
            self.real.faults = DeviceFault(0)
            self.real._rest(time_s, DeviceMode.IDLE)


class LatchedKeepsHomed(Rogue):
    was_homed = False

    def ticked(self, time_s: float) -> None:
        self.was_homed = self.was_homed or self.real.homed
        if self.real.mode is DeviceMode.LATCHED:
            self.real.homed = self.was_homed


class LatchedDoesNotMeasure(Rogue):
    def answered(self, message: Message, answer: Answer) -> Answer:
        return Answer.NONE if self.real.mode is DeviceMode.LATCHED and isinstance(message, Drive) else answer


class ClearHomes(Rogue):
    def answered(self, message: Message, answer: Answer) -> Answer:
        if isinstance(message, Clear) and self.real.mode is DeviceMode.IDLE:
            self.real.homed = True
        return answer


# -- wrong wires ---------------------------------------------------------------------------------------------------


class Reframed(Wire):
    """Takes the device's frames apart and puts them together otherwise."""

    def __init__(self, device: VirtualDevice) -> None:
        super().__init__(device)
        self._decoder = FrameDecoder()
        self._sequence = 0

    def up(self, data: bytes) -> bytes:
        return b"".join(self.frame(frame.function, frame.payload) for frame in self._decoder.feed(data))

    def frame(self, function: int, payload: bytes) -> bytes:
        self._sequence = (self._sequence + 1) % 256
        return encode_frame(function, self._sequence, payload)


class UnfinishedCrc16(Reframed):
    """The final XOR was forgotten."""

    def frame(self, function: int, payload: bytes) -> bytes:
        body = cobs_decode(super().frame(function, payload)[:-1])
        assert body is not None
        return cobs_encode(body[:-2] + bytes(byte ^ 0xFF for byte in body[-2:])) + DELIMITER


class SequenceStuck(Reframed):
    def frame(self, function: int, payload: bytes) -> bytes:
        return encode_frame(function, 7, payload)


class SenseFirst(Reframed):
    """Each pair the other way round."""

    state = b""

    def frame(self, function: int, payload: bytes) -> bytes:
        if function == FUNCTION[State]:
            self.state = payload
            return b""
        frame = super().frame(function, payload)
        return frame + super().frame(FUNCTION[State], self.state) if function == FUNCTION[Sense] else frame


class Streams(Reframed):
    """The newest State again every millisecond, asked or not."""

    state = b""

    def frame(self, function: int, payload: bytes) -> bytes:
        if function == FUNCTION[State]:
            self.state = payload
        return super().frame(function, payload)

    def up(self, data: bytes) -> bytes:
        return super().up(data) + (super().frame(FUNCTION[State], self.state) if self.state else b"")


class Late(Wire):
    """All that the device says is 10 ms on its way."""

    def __init__(self, device: VirtualDevice) -> None:
        super().__init__(device)
        self._waiting: list[tuple[float, bytes]] = []

    def up(self, data: bytes) -> bytes:
        self._waiting.append((self.time_s + 0.01, data))
        due = [late for due_s, late in self._waiting if due_s <= self.time_s]
        del self._waiting[: len(due)]
        return b"".join(due)


class Lenient(Wire):
    """Mends what the device would refuse: so it obeys what it must not."""

    def down(self, data: bytes) -> bytes:
        return b"".join(self.mended(stretch) for stretch in data.split(DELIMITER) if stretch)

    def mended(self, stretch: bytes) -> bytes:
        raise NotImplementedError


def framed(body: bytes) -> bytes:
    """A whole frame of function, sequence and payload."""
    return encode_frame(body[0], body[1], body[2:10])


class NoCrc16(Lenient):
    def mended(self, stretch: bytes) -> bytes:
        body = cobs_decode(stretch)
        return stretch + DELIMITER if body is None or len(body) < 4 else framed(with_crc8(body[:-2]))


class TakesCutOff(Lenient):
    """Takes a frame that lacks its last byte for one."""

    def mended(self, stretch: bytes) -> bytes:
        if cobs_decode(stretch) is None and len(stretch) == 11:
            for missing in (b"\x01", b"\x55"):
                if (body := cobs_decode(stretch + missing)) is not None:
                    return framed(with_crc8(body[:-2]))
        return stretch + DELIMITER


class TakesTooLong(Lenient):
    """Cuts off what is too much."""

    def mended(self, stretch: bytes) -> bytes:
        return stretch[:12] + DELIMITER


class TakesZeroInside(Lenient):
    """Waits for the whole length, whatever comes: two halves make one frame."""

    def down(self, data: bytes) -> bytes:
        first, _, second = data[:-1].partition(DELIMITER)
        return first + second + DELIMITER if second and len(first + second) == 12 else data


class NoiseIsADrive(Lenient):
    count = 0

    def mended(self, stretch: bytes) -> bytes:
        if stretch.startswith(bytes((0x55, 0xAA))):
            self.count += 1
            return encode_frame(FUNCTION[Drive], 0, encode(Drive(0.0, 0.0, DriveMode.OFF, 200 + self.count)))
        return stretch + DELIMITER


class Deafened(Lenient):
    """Noise is ignored, and so is the whole frame behind it."""

    deaf = False

    def mended(self, stretch: bytes) -> bytes:
        if len(stretch) > 13:
            self.deaf = True
        elif self.deaf and len(stretch) == 12:
            self.deaf = False
            return b""
        return stretch + DELIMITER


class MendsPayload(Lenient):
    """Mends the payload of a whole frame."""

    def mended(self, stretch: bytes) -> bytes:
        body = cobs_decode(stretch)
        frames = FrameDecoder().feed(stretch + DELIMITER)
        return framed(self.payload(body[:-2])) if body and frames else stretch + DELIMITER

    def payload(self, body: bytes) -> bytes:
        raise NotImplementedError


def with_crc8(body: bytes) -> bytes:
    """A Drive's body with its CRC-8 made right."""
    return body[:-1] + bytes((crc8(body[:1] + body[2:-1]),)) if body[0] == FUNCTION[Drive] and len(body) == 9 else body


class NoCrc8(MendsPayload):
    def payload(self, body: bytes) -> bytes:
        return with_crc8(body)


class ClampsDuty(MendsPayload):
    def payload(self, body: bytes) -> bytes:
        if body[0] != FUNCTION[Drive] or len(body) != 9:
            return body
        duty = min(max(int.from_bytes(body[2:4], "little", signed=True), -10_000), 10_000)
        return with_crc8(body[:2] + duty.to_bytes(2, "little", signed=True) + body[4:])


class AnyModeIsOff(MendsPayload):
    def payload(self, body: bytes) -> bytes:
        if body[0] != FUNCTION[Drive] or len(body) != 9 or body[6] <= 1:
            return body
        return with_crc8(body[:6] + b"\x00" + body[7:])


class AnyLength(MendsPayload):
    def payload(self, body: bytes) -> bytes:
        lengths = {FUNCTION[Drive]: 7, FUNCTION[Clear]: 1, FUNCTION[Hello]: 6}
        length = 2 + lengths.get(body[0], len(body) - 2)
        return with_crc8(body[:length]) if len(body) > length else body


class OtherFunctionsAreDrives(MendsPayload):
    """Whatever is not known is taken for a Drive."""

    def payload(self, body: bytes) -> bytes:
        known = {FUNCTION[kind] for kind in (Drive, Hello, Home, Clear, Retract)}
        return body if body[0] in known else with_crc8(bytes((FUNCTION[Drive],)) + body[1:9])


# -- what finds them -----------------------------------------------------------------------------------------------


class Planted(NamedTuple):
    """An error, the device that has it, and the check that names it."""

    error: str
    finds: str
    line: Callable[[], Line]
    first: tuple[str, ...] = ()
    "Checks whose traffic the one that finds it judges."


def rogue(kind: type[Rogue], finds: str, *first: str) -> Planted:
    return Planted(kind.__name__, finds, lambda: serial_line(kind), first)


def wire(kind: type[Wire], finds: str, *first: str) -> Planted:
    return Planted(kind.__name__, finds, lambda: serial_line(wire=kind), first)


def fault(name: str, finds: str, *first: str) -> Planted:
    return Planted(name, finds, lambda: serial_line(faults=[name]), first)


PLANTED = (
    fault("commands_vanish", "identity_answers_hello"),
    rogue(AnswersHelloOnce, "identity_answers_hello"),
    wire(UnfinishedCrc16, "identity_answers_hello"),
    rogue(OtherHash, "schema_hash"),
    rogue(HashBytesReversed, "schema_hash"),
    rogue(HelloIsNoNonce, "hello_nonce"),
    rogue(IgnoresSchema, "schema_mismatch"),
    rogue(IgnoresVersion, "version_mismatch"),
    rogue(ClearsMismatch, "mismatch_holds"),
    rogue(ClearIgnored, "clear_clears"),
    rogue(RunsUnhomed, "run_needs_homing"),
    rogue(SlowStatus, "status_without_host"),
    rogue(StatusOnlyBesideDrives, "status_without_host"),
    fault("no_status", "status_without_host"),
    rogue(StatusLagsBesideDrives, "status_with_host"),
    fault("no_state", "state_answers_drive"),
    fault("answers_half", "state_answers_drive"),
    fault("no_sense", "sense_answers_drive"),
    wire(SenseFirst, "state_before_sense"),
    wire(Streams, "no_answer_without_drive", "state_answers_drive"),
    wire(Late, "answer_time"),
    rogue(StateCounterStuck, "state_counter"),
    rogue(StateCounterRepeated, "state_counter"),
    fault("clock=+2%", "device_clock"),
    fault("clock=-2%", "device_clock"),
    rogue(ClockInMilliseconds, "device_clock"),
    rogue(DriveCounterBehind, "drive_counter_shown"),
    rogue(AnswersRepetitions, "repeated_drive"),
    rogue(SupplyInTenths, "status_plausible"),
    fault("supply_loss", "status_plausible"),
    rogue(CurrentOffset, "sense_plausible"),
    wire(NoCrc8, "drive_crc_8"),
    wire(ClampsDuty, "drive_range"),
    wire(AnyModeIsOff, "drive_mode"),
    wire(AnyLength, "drive_length"),
    wire(AnyLength, "command_length"),
    wire(OtherFunctionsAreDrives, "other_functions"),
    wire(NoCrc16, "frame_crc_16"),
    wire(TakesCutOff, "frame_cut_off"),
    wire(TakesTooLong, "frame_too_long"),
    wire(TakesZeroInside, "frame_zero_inside"),
    wire(NoiseIsADrive, "noise"),
    wire(Deafened, "noise"),
    Planted("every node", "other_node", lambda: can_line(every_node=True)),
    rogue(HomeIgnored, "home_homes"),
    fault("motor_reversed_left", "home_homes"),
    fault("encoder_reversed_left", "home_homes"),
    fault("switch_dead_left", "home_homes"),
    rogue(HomeKeepsOrigin, "home_zeroes"),
    rogue(HomedBeforeZero, "homed_is_in_new_origin"),
    rogue(ObeysRepetitions, "repeated_command"),
    rogue(NonceNotShown, "retract_when_idle"),
    rogue(ClearEndsAnything, "homing_takes_only_retract"),
    rogue(HomesFromAnywhere, "retracting_takes_only_retract"),
    rogue(HomesFromAnywhere, "home_refused_in_run"),
    rogue(HomesFromAnywhere, "latched_refuses_home"),
    rogue(ClearEndsAnything, "clear_refused_in_run"),
    rogue(ModesMixedUp, "home_homes"),
    rogue(NeverRuns, "run_is_entered"),
    fault("duties_reversed", "left_duty"),
    rogue(MotorsSwapped, "left_duty"),
    rogue(MotorsSwapped, "right_duty"),
    rogue(PushesIntoStop, "open_switch_stops"),
    rogue(OffOnlySwitchesOff, "off_opens"),
    rogue(RetractIgnored, "retract_opens"),
    rogue(NeedsNoLettingGo, "let_go_after_retract"),
    rogue(HelloResets, "hello_in_run"),
    rogue(MismatchInRunPasses, "mismatch_in_run"),
    rogue(TimeoutOf35ms, "short_silence_is_borne"),
    rogue(TimeoutOf65ms, "silence_is_noticed"),
    rogue(NoTimeout, "silence_is_noticed"),
    rogue(NoTimeout, "silence_opens"),
    rogue(TimeoutWithoutOpening, "silence_opens"),
    rogue(AnyMessageExtends, "only_good_drives_extend"),
    rogue(RepetitionExtends, "only_good_drives_extend"),
    rogue(DoesNotLatch, "silence_latches"),
    rogue(LatchedKeepsHomed, "silence_latches"),
    rogue(LatchedDoesNotMeasure, "latched_refuses_run"),
    rogue(RetractsWhenLatched, "latched_refuses_retract"),
    rogue(ClearHomes, "cleared_is_not_homed"),
    rogue(NeedsNoLettingGoAfterFault, "let_go_after_fault"),
    fault("state_crc", "own_messages", "state_answers_drive"),
    wire(SequenceStuck, "own_frames", "state_answers_drive"),
    rogue(HelloResets, "no_reset", "hello_in_run"),
    rogue(LatchedKeepsHomed, "status_consistent", "silence_latches"),
    rogue(NeverOpens, "left_open", "off_opens"),
)


SAID = {
    "HashBytesReversed": "the wrong way round",
    "TimeoutOf65ms": "58 ms after the last Drive: RUN, no fault",
    "state_crc": "State: CRC-8",
    "encoder_reversed_left": "LATCHED, HOMING_FAILED",
    "NoCrc8": "form 1: 1 State",
    "clock=+2%": "+2.0",
    "NeverOpens": "THE GAP MAY BE SHUT",
    "SenseFirst": "answered otherwise, the last one by Sense State",
}
"""Of some errors: what was seen says enough to find them."""


def named(name: str) -> Check:
    return next(one for one in CHECKS if one.name == name)


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: f"{planted.error}-{planted.finds}")
def test_a_planted_error_is_found_by_name(planted: Planted) -> None:
    checks = [named(name) for name in (*planted.first, planted.finds)]
    result = run(Host(planted.line()), checks)[-1]
    assert (result.check.name, result.passed) == (planted.finds, False), result.seen
    assert SAID.get(planted.error, "") in result.seen


def test_every_check_finds_an_error() -> None:
    assert {planted.finds for planted in PLANTED} == {one.name for one in CHECKS}
    assert len({planted.error for planted in PLANTED}) > 60


def test_a_device_that_cannot_be_met_is_not_moved() -> None:
    line = serial_line(OtherHash)
    results = {result.check.name: result for result in run(Host(line), checks_on(line))}
    assert results["device_clock"].passed
    for one in CHECKS:
        if one.moves:
            assert results[one.name].seen == "not tried, because schema_hash failed"


class Asleep(Wire):
    """This process is not run for 60 ms, once, in the middle of something."""

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        if self.device.messages.firmware.mode is DeviceMode.RUN and not hasattr(self, "slept"):
            self.slept = True
            until_s += 0.06
        return super().read(until_s)


def test_a_check_that_this_computer_spoiled_is_tried_again() -> None:
    assert run(Host(serial_line(wire=Asleep)), [named("short_silence_is_borne")])[0].passed
    seen = run(Host(serial_line(TimeoutOf35ms, Asleep)), [named("short_silence_is_borne")])[0].seen
    assert "ms late meanwhile" not in seen, "the last attempt was not late, and is the one that counts"


# -- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[[Line], None]:
    """Lets the command open a line in virtual time."""

    def use(line: Line) -> None:
        monkeypatch.setattr(command, "open_line", lambda *_: line)

    return use


def test_the_command_prints_json_and_exits_with_0(
    opened: Callable[[Line], None], capsys: pytest.CaptureFixture[str]
) -> None:
    opened(serial_line())
    assert command.main(["virtual", "--yes", "--json", "--only", "schema_hash"]) == 0
    out, err = capsys.readouterr()
    checks = json.loads(out)["checks"]
    assert [check["name"] for check in checks] == ["schema_hash", "left_open"]
    assert set(checks[0]) >= {"name", "passed", "seen", "expected"}
    assert checks[0]["passed"] is True
    assert "ok    schema_hash" in err


def test_a_failed_check_says_what_to_look_at_and_the_exit_code_is_1(
    opened: Callable[[Line], None], capsys: pytest.CaptureFixture[str]
) -> None:
    opened(serial_line(TimeoutOf65ms))
    assert command.main(["virtual", "--yes", "--only", "silence_is_noticed"]) == 1
    out = capsys.readouterr().out
    assert re.search(r"FAIL  silence_is_noticed\n +sent +in RUN.*\n +seen +58 ms .*\n +expected .*\n +page +", out)
    assert "virtual: device 1, firmware 1.0: 1 of 2 checks passed" in out


def test_nothing_is_sent_before_somebody_agrees(
    monkeypatch: pytest.MonkeyPatch, opened: Callable[[Line], None], capsys: pytest.CaptureFixture[str]
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    line = serial_line()
    opened(line)
    for answer in (io.StringIO("yes\n"), Terminal("no\n"), Terminal("")):
        monkeypatch.setattr(sys, "stdin", answer)
        assert command.main(["virtual"]) == 2
    assert "MOTORS WILL MOVE" in capsys.readouterr().err
    assert line.now_s() == 0.0
    monkeypatch.setattr(sys, "stdin", Terminal("Yes\n"))
    assert command.main(["virtual", "--only", "schema_hash"]) == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["/nonexistent/port", "--yes"], "/nonexistent/port"),
        (["telepathy:0", "--yes"], "telepathy"),
        (["tormagsim:/nonexistent/can", "--yes"], "cannot be opened"),
        ([], "PORT|CHANNEL"),
        (["x", "--node", "16"], "16"),
    ],
)
def test_a_wrong_call_says_why_and_exits_with_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code: object = None
    try:
        code = command.main(arguments)
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert said in capsys.readouterr().err


def test_a_check_that_there_is_not_is_refused(
    opened: Callable[[Line], None], capsys: pytest.CaptureFixture[str]
) -> None:
    opened(serial_line())
    with pytest.raises(SystemExit, match="2"):
        command.main(["virtual", "--yes", "--only", "frame_crc_17"])
    assert "frame_crc_16" in capsys.readouterr().err


class Interrupted(Wire):
    """Ctrl-C, or a port that goes, 0.1 s into RUN."""

    error: type[BaseException] = KeyboardInterrupt
    until_s = 0.0

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        if self.device.messages.firmware.mode is DeviceMode.RUN and not self.until_s:
            self.until_s = until_s + 0.1
        if self.until_s and until_s > self.until_s:
            self.until_s = 1e9
            raise self.error("gone")
        return super().read(until_s)


class Unplugged(Interrupted):
    error = OSError


def test_an_interrupted_run_leaves_the_gap_open(
    opened: Callable[[Line], None], capsys: pytest.CaptureFixture[str]
) -> None:
    device = VirtualDevice(NEAR_HOME, SteadyHand())
    opened(SerialLine(Interrupted(device)))
    assert command.main(["virtual", "--yes", "--only", "silence_opens"]) == 1
    assert "ok    left_open" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert device.messages.firmware.mode is DeviceMode.IDLE
    assert device.truth.gap_mm > 94.0


def test_a_line_that_goes_is_told_and_no_success(
    opened: Callable[[Line], None], capsys: pytest.CaptureFixture[str]
) -> None:
    opened(serial_line(wire=Unplugged))
    assert command.main(["virtual", "--yes", "--only", "off_opens"]) == 1
    assert "the line is gone" in capsys.readouterr().err


def test_a_reader_that_goes_does_not_end_the_run(
    monkeypatch: pytest.MonkeyPatch, opened: Callable[[Line], None]
) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    device = VirtualDevice(NEAR_HOME, SteadyHand())
    opened(SerialLine(Wire(device)))
    monkeypatch.setattr(sys, "stdout", Closed())
    assert command.main(["virtual", "--yes", "--only", "run_is_entered"]) == 0
    assert device.messages.firmware.mode is DeviceMode.IDLE


def test_every_check_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == [one.name for one in CHECKS]


def test_every_check_cites_the_page() -> None:
    """By its heading, and the number of the rule below it."""
    text = PAGE.read_text(encoding="utf-8")
    for one in CHECKS:
        heading, _, number = one.page.partition(", ")
        section = re.search(rf"^##+ {re.escape(heading)}$(.*?)(?=^##? |\Z)", text, re.MULTILINE | re.DOTALL)
        assert section is not None, f"{one.name}: {heading!r} is no heading of the page"
        assert not number or re.search(rf"^{number}\. ", section[1], re.MULTILINE), (
            f"{one.name}: no {number}, {heading!r}"
        )


@pytest.mark.live
@pytest.mark.parametrize(("door", "prefix"), [("--pty", ""), ("--slcan", "slcan:")])
def test_real_ports_carry_it(door: str, prefix: str) -> None:
    """What virtual time cannot show: that ports open, and that the command finds the device behind them."""
    names = ("schema_hash", "drive_crc_8", "no_answer_without_drive")
    only = [argument for name in names for argument in ("--only", name)]
    simulator = subprocess.Popen([sys.executable, "-m", "tormagd.simulation", door], stdout=subprocess.PIPE, text=True)
    try:
        assert simulator.stdout is not None
        line = prefix + simulator.stdout.readline().strip()
        done = subprocess.run(
            [sys.executable, "-m", "firmware_protocol.conformance", line, "--yes", "--json", *only],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    finally:
        simulator.kill()
        simulator.communicate()
    results = {check["name"]: check["passed"] for check in json.loads(done.stdout)["checks"]}
    assert [results[name] for name in names] == [True] * len(names), done.stderr
