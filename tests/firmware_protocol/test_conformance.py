"""The conformance kit passes the simulated device on both carriers, in both languages, and finds what is wrong by name.

A wrong device is the simulated one with one error planted: in its firmware (`Rogue`), on its wire (`Wire`), or as a
fault of the simulator's own.
"""

import io
import json
import math
import random
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard, TypeVar

import msgspec
import pytest
from virtual_port import VirtualPort

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
    Switches,
    crc8,
)
from firmware_protocol.conformance import __main__ as command, examination, moving, telling
from firmware_protocol.conformance.check import Check, run
from firmware_protocol.conformance.examination import BY_HAND, CHECKS, left_open
from firmware_protocol.conformance.host import Host
from firmware_protocol.conformance.line import CanLine, Line, SerialLine
from firmware_protocol.conformance.rules import MODES, RULES, TAKES
from firmware_protocol.framing import DELIMITER, FrameDecoder, cobs_decode, encode_frame
from tormagd.simulation.can_device import DEVICE, CanDevice, CanFrame
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import MessageDevice, VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.firmware import Answer, Firmware, Output, Sensors
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

PAGE = (Path(__file__).parents[2] / "firmware_protocol" / "README.md").read_text(encoding="utf-8")
Measured = tuple[State, Sense]
SAMPLE = load_plant("sample_1")
NEAR_HOME = msgspec.structs.replace(
    SAMPLE, assumed=msgspec.structs.replace(SAMPLE.assumed, start_left_mm=46.2, start_right_mm=45.8)
)
"""Shorter, with an origin that still moves too far."""
LATE = msgspec.structs.replace(NEAR_HOME, firmware=msgspec.structs.replace(SAMPLE.firmware, reply_jitter_us=8000.0))


# -- ports in virtual time -----------------------------------------------------------------------------------------


def as_it_is(_device: object, *said: Any) -> Any:
    return said[-1]


def nothing(_device: object, *_what: object) -> None:
    """A hook that does nothing."""


class Wire(VirtualPort):
    def write(self, data: bytes) -> None:
        super().write(self.down(data))

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        return [(time_s, self.up(data)) for time_s, data in super().read(until_s)]

    down = up = as_it_is


class Bus(VirtualPort):
    def write(self, identifier: int, data: bytes) -> None:  # type: ignore[override]
        self.device.receive(self.time_s, CanFrame(self.down(identifier), data))

    def read(self, until_s: float) -> list[tuple[float, int, bytes]]:  # type: ignore[override]
        delivered: Any = super().read(until_s)[0][1]
        return [(self.time_s, frame.identifier, frame.data) for sender, frame, _ in delivered if sender == DEVICE]

    down = as_it_is


class WindingHand:
    """A hand that turns the handle by over a turn, and back."""

    def position_mm(self, time_s: float) -> float:
        return 80.0 * math.sin(0.5 * time_s)


def serial_line(
    boot: Callable[[PlantParameters], Any] = Firmware,
    wire: type[Wire] = Wire,
    faults: Sequence[str] = (),
    plant: PlantParameters = NEAR_HOME,
) -> SerialLine:
    return SerialLine(wire(VirtualDevice(plant, WindingHand(), [parse_fault(fault) for fault in faults], boot=boot)))


def can_line(bus: type[Bus] = Bus, plant: PlantParameters = NEAR_HOME) -> CanLine:
    return CanLine(bus(CanDevice(MessageDevice(plant, WindingHand()), node=3)), 3)


# -- the right device ----------------------------------------------------------------------------------------------


UNTESTED = {one.name for one in BY_HAND}


def passed(line: Line, checks: Sequence[Check] = CHECKS) -> set[str]:
    results = list(run(hosted(line), checks))
    assert {result.check.name for result in results if result.passed is None} <= UNTESTED
    assert [(result.check.name, result.seen) for result in results if result.passed is False] == []
    assert results[-1].check is left_open
    return {result.check.name for result in results}


LONG = (
    *moving.CHECKS,
    telling.positions_run_on,
    telling.force_follows_gap,
    *examination.RESETS,
    *BY_HAND,
    left_open,
)
"""These take long, and are the same on every carrier and in either language."""
SHORT = [one for one in CHECKS if one not in LONG or one is left_open]


def test_the_simulated_device_passes_on_a_bus() -> None:
    passed(can_line(), [one for one in SHORT if one is not telling.frames_as_they_come])


def test_the_simulated_device_passes_the_rest_on_a_serial_line() -> None:
    assert passed(serial_line(plant=SAMPLE), LONG) == {one.name for one in LONG}


def test_the_c_sources_pass(library: object) -> None:
    assert passed(serial_line(CompiledFirmware), SHORT) == {one.name for one in SHORT}


# -- wrong firmwares -----------------------------------------------------------------------------------------------


class Rogue:
    """The Python firmware, with hooks; what has none is its own."""

    def __init__(self, plant: PlantParameters) -> None:
        self.plant = plant
        self.real = Firmware(plant)
        self.count: Counter[type[Message]] = Counter()
        self.asked = Drive(0.0, 0.0, DriveMode.OFF, 0)
        self.drive_s = 0.0
        self.zeroed_s = -1.0
        self.since_s = self.now_s = 0.0
        self.ends: list[Switches] = []
        self.nonces: list[int] = []
        self.counter = 0
        self.state: State | None = None
        self.boots()

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        self.count[type(message)] += 1
        time_s += self.up_s
        self.before(time_s, message)
        if isinstance(message, Drive):
            self.asked, self.drive_s = message, time_s
        heard = self.hears(message)
        answer = Answer.NONE if heard is None else self.real.receive(time_s, heard, self.senses(sensors))
        self.after(time_s, message)
        return self.answers(message, answer)

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        time_s += self.up_s
        self.ticks(time_s)
        status = self.real.tick(time_s, self.senses(sensors))
        self.ticked(time_s)
        self.count[Status] += status is not None
        return status and self.shows(time_s, status)

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        time_s += self.up_s
        return self.measures(time_s, self.real.measurement(time_s, self.senses(sensors)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    @property
    def output(self) -> Output:
        return self.drives(self.real.output)

    # the hooks

    up_s = 0.0
    boots = nothing
    before = after = nothing
    hears = answers = as_it_is
    ticks = ticked = nothing
    senses = shows = measures = drives = as_it_is


def in_mode(mode: DeviceMode) -> Callable[..., bool]:
    return lambda device, *_message: device.mode is mode


is_running, is_latched = in_mode(DeviceMode.RUN), in_mode(DeviceMode.LATCHED)
HASH_REVERSED = int.from_bytes(SCHEMA_HASH.to_bytes(4, "little"), "big")


RIGHT = {"schema_hash": SCHEMA_HASH, "protocol_version": 1}


def fitting(message: Message, **right: int) -> Message:
    return message.replaced(**right) if isinstance(message, Hello) else message


def mends_misfits_in(mode: DeviceMode) -> Callable[[Rogue, Message], Message]:
    return lambda device, message: fitting(message, **RIGHT) if device.mode is mode else message


def drives_in(mode: DeviceMode) -> Callable[[Rogue, Output], Output]:
    """Return a hook by which the duties of a Drive RUN act in another mode, too."""
    return lambda device, output: (
        Output(device.asked.left_duty, device.asked.right_duty, enabled=True)
        if device.mode is mode and device.asked.mode is DriveMode.RUN
        else output
    )


def keeps_nonce_at(kind: type[Message]) -> dict[str, Callable[..., None]]:
    return {
        "before": lambda device, *_: setattr(device, "nonce", device.real._nonce),
        "after": lambda device, _, message: (
            setattr(device.real, "_nonce", device.nonce) if isinstance(message, kind) else None
        ),
    }


def only_acknowledges(
    kind: type[Home] | type[Retract], when: Callable[[Rogue], bool] = lambda device: True
) -> Callable[[Rogue, Message], Message | None]:
    def hears(device: Rogue, message: Message) -> Message | None:
        if not isinstance(message, kind) or not when(device):
            return message
        device.real._nonce = message.nonce
        return None

    return hears


def sets(
    kind: type[object],
    when: Callable[[Rogue, Message], bool] = lambda device, message: True,
    **state: object,
) -> Callable[[Rogue, float, Message], None]:

    def hook(device: Rogue, time_s: float, message: Message) -> None:
        if isinstance(message, kind) and when(device, message):
            for name, value in state.items():
                setattr(device.real, name, value)

    return hook


HOMES_FROM_ANYWHERE = sets(
    Home, lambda device, message: message.nonce != device.real._nonce, mode=DeviceMode.IDLE, faults=DeviceFault(0)
)


def rests(when: Callable[..., bool], mode: DeviceMode = DeviceMode.IDLE) -> Callable[..., None]:
    def hook(device: Rogue, time_s: float, *message: Message) -> None:
        if when(device, *message):
            device.real._rest(time_s, mode)

    return hook


CLEAR_ENDS_ANYTHING = rests(lambda device, message: isinstance(message, Clear) and device.real.output.enabled)
OFF_ONLY_SWITCHES_OFF = rests(lambda device, message: is_running(device) and is_off(message))


def is_off(message: Message) -> TypeGuard[Drive]:
    return isinstance(message, Drive) and message.mode is DriveMode.OFF


def extends(device: Rogue, time_s: float, *_message: Message) -> None:
    device.real._drive_s = time_s


def timeout_of(timeout_s: float) -> Callable[[Rogue, float], None]:
    return lambda device, time_s: setattr(
        device.real, "_drive_s", time_s if time_s - device.drive_s <= timeout_s else time_s - 1.0
    )


def times_out_opening(device: Rogue) -> bool:
    return device.real.mode is DeviceMode.RETRACTING and DeviceFault.COMMAND_TIMEOUT in device.real.faults


def homed_before_zero(device: Rogue, time_s: float, measured: Measured) -> Measured:
    if device.real.homed and device.zeroed_s < 0.0:
        device.zeroed_s = time_s + 0.04
    state, sense = measured
    if time_s < device.zeroed_s:
        state = state.replaced(left_position_mm=state.left_position_mm + device.real._left_zero_mm)
    return state, sense


def opens_with(share: float) -> Callable[[Rogue, Output], Output]:
    return lambda device, output: (
        Output(share * output.left_duty, share * output.right_duty, output.enabled)
        if device.real.mode is DeviceMode.RETRACTING
        else output
    )


def stops_after(seconds: float) -> Callable[[Rogue, float], None]:
    def ticked(device: Rogue, time_s: float) -> None:
        if device.real.mode is not DeviceMode.RETRACTING:
            device.since_s = time_s
        if time_s - device.since_s > seconds:
            device.real._rest(time_s, DeviceMode.IDLE)

    return ticked


def blind_while(blind: Callable[[Rogue, float], bool]) -> Callable[[Rogue, float], None]:
    return lambda device, time_s: setattr(device.real, "_drive_s", time_s if blind(device, time_s) else device.drive_s)


def unwatched(fault: DeviceFault) -> Callable[[Rogue, float], None]:
    def ticked(device: Rogue, time_s: float) -> None:
        if fault in device.real.faults:
            device.real.faults = DeviceFault(0)
            device.real.mode, device.real._motion = DeviceMode.RUN, None

    return ticked


def with_switches(switches: Callable[[Rogue, Switches], Switches]) -> Callable[[Rogue, Sensors], Sensors]:
    return lambda device, sensors: sensors.replaced(switches=switches(device, sensors.switches))


BOTH_OPEN = Switches.LEFT_OPEN | Switches.RIGHT_OPEN


def swapped(_device: Rogue, switches: Switches) -> Switches:
    return Switches((switches.value & 5) << 1 | (switches.value & 10) >> 1)


def moved(scale: float, off_mm: float) -> Callable[..., Measured]:
    return lambda _device, _time_s, measured: (
        measured[0].replaced(
            left_position_mm=scale * measured[0].left_position_mm + off_mm,
            right_position_mm=scale * measured[0].right_position_mm + off_mm,
        ),
        measured[1],
    )


def clipped(duty: float) -> float:
    return min(max(duty, -0.5), 0.5)


def sensed(change: Callable[[Sense], Sense], mode: DeviceMode | None = None) -> Callable[..., Measured]:
    return lambda device, _time_s, measured: (
        measured[0],
        change(measured[1]) if mode in (None, device.real.mode) else measured[1],
    )


def placed(change: Callable[[State], dict[str, float]], mode: DeviceMode) -> Callable[..., Measured]:
    return lambda device, _time_s, measured: (
        measured[0].replaced(**(change(measured[0]) if device.real.mode is mode else {})),
        measured[1],
    )


def drive_before(device: Rogue, _time_s: float, status: Status) -> Status:
    before, device.counter = device.counter, status.drive_counter
    return status.replaced(drive_counter=before)


def nonce_of_before(device: Rogue, _time_s: float, status: Status) -> Status:
    device.nonces = [*device.nonces, status.command_nonce][-6:]
    return status.replaced(command_nonce=device.nonces[0]) if device.count[Status] % 50 == 0 else status


def place_old(device: Rogue, time_s: float, measured: Measured) -> Measured:
    before, device.state = device.state or measured[0], measured[0]
    return before.replaced(counter=measured[0].counter, device_time_s=measured[0].device_time_s), measured[1]


RUNS = bytes((DriveMode.RUN.value,))


def only_one_a_tick(device: Rogue, message: Message) -> Message | None:
    before, device.since_s = device.since_s, device.drive_s
    return None if isinstance(message, Drive) and 0.0 < device.drive_s - before < 0.9e-3 else message


def pushes(kind: type[Message], mode: DeviceMode, lasts_s: float) -> dict[str, Callable[..., Any]]:
    """Return hooks by which a message, or a Drive OFF, closes for a while."""

    def before(device: Rogue, time_s: float, message: Message) -> None:
        is_one = isinstance(message, kind) and (is_off(message) or not isinstance(message, Drive))
        device.since_s = time_s + lasts_s if is_one and device.real.mode is mode else device.since_s

    def drives(device: Rogue, output: Output) -> Output:
        return Output(-0.5, -0.5, enabled=True) if device.now_s < device.since_s else output

    return {"before": before, "drives": drives, "ticks": lambda device, time_s: setattr(device, "now_s", time_s)}


def with_duties(left: Callable[..., float], right: Callable[..., float]) -> Callable[[Rogue, Message], Message]:
    return lambda _device, message: (
        message.replaced(
            left_duty=left(message.left_duty, message.right_duty),
            right_duty=right(message.right_duty, message.left_duty),
        )
        if isinstance(message, Drive)
        else message
    )


def shows_late(device: Rogue, time_s: float, status: Status) -> Status:
    device.ends = [*device.ends, status.switches & ~Switches.HOMED][-4:]
    return status.replaced(switches=device.ends[0] | status.switches & Switches.HOMED)


def handle_of_10_ms(device: Any, time_s: float, measured: Measured) -> Measured:
    if time_s - device.since_s > 0.01:
        device.since_s, device.stands_mm = time_s, measured[1].handle_position_mm
    return measured[0], measured[1].replaced(handle_position_mm=device.stands_mm)


SWAPPED = {DeviceMode.RUN: DeviceMode.HOMING, DeviceMode.HOMING: DeviceMode.RUN}


# -- wrong wires ---------------------------------------------------------------------------------------------------


class Lenient(Wire):
    """Repairs what the device would refuse, so that it obeys what it must not."""

    mended: Callable[..., bytes]
    count = 0
    is_deaf = False

    def down(self, data: bytes) -> bytes:
        return b"".join(self.mended(stretch) for stretch in data.split(DELIMITER) if stretch)


def framed(body: bytes) -> bytes:
    return encode_frame(body[0], body[1], body[2:10])


def with_crc8(body: bytes) -> bytes:
    return body[:-1] + bytes((crc8(body[:1] + body[2:-1]),)) if body[0] == FUNCTION[Drive] and len(body) == 9 else body


def without_crc_16(wire: Lenient, stretch: bytes) -> bytes:
    body = cobs_decode(stretch)
    return stretch + DELIMITER if body is None or len(body) < 4 else framed(with_crc8(body[:-2]))


def thrice(wire: Any, stretch: bytes) -> bytes:
    older, last = wire.olds
    wire.olds = last, stretch
    return b"" if stretch == older else stretch + DELIMITER


def mending(payload: Callable[[bytes], bytes]) -> Callable[[Lenient, bytes], bytes]:

    def mended(wire: Lenient, stretch: bytes) -> bytes:
        body = cobs_decode(stretch)
        is_whole = body and FrameDecoder().feed(stretch + DELIMITER)
        return framed(payload(body[:-2])) if body and is_whole else stretch + DELIMITER

    return mended


def clamped(body: bytes) -> bytes:
    if body[0] != FUNCTION[Drive] or len(body) != 9:
        return body
    duty = min(max(int.from_bytes(body[2:4], "little", signed=True), -10_000), 10_000)
    return with_crc8(body[:2] + duty.to_bytes(2, "little", signed=True) + body[4:])


def cut_to_length(body: bytes) -> bytes:
    length = {FUNCTION[Drive]: 9, FUNCTION[Clear]: 3, FUNCTION[Hello]: 8}.get(body[0], len(body))
    return with_crc8(body[:length]) if len(body) > length else body


def other_functions_are_drives(body: bytes) -> bytes:
    known = {FUNCTION[kind] for kind in (Drive, Hello, Home, Clear, Retract)}
    return body if body[0] in known else with_crc8(bytes((FUNCTION[Drive],)) + body[1:9])


# -- what finds them -----------------------------------------------------------------------------------------------


class Planted(NamedTuple):
    """An error, the device that has it, and the check that names it."""

    error: str
    finds: str
    line: Callable[[], Line]
    first: tuple[str, ...] = ()


K = TypeVar("K")


def wrong(kind: type[K], **hooks: object) -> type[K]:
    return type(kind.__name__, (kind,), hooks)


def rogue(error: str, finds: str, *first: str, **hooks: Callable[..., object]) -> Planted:
    return Planted(error, finds, lambda: serial_line(wrong(Rogue, **hooks)), first)


def wire(error: str, finds: str, *first: str, of: type[Wire] = Lenient, **hooks: Callable[..., object]) -> Planted:
    return Planted(error, finds, lambda: serial_line(wire=wrong(of, **hooks)), first)


def fault(name: str, finds: str, *first: str) -> Planted:
    return Planted(name, finds, lambda: serial_line(faults=[name]), first)


MOTIONS = ("home_homes", "run_drive_off", "skew_opens")
PLANTED = (
    fault("commands_vanish", "identity_answers_hello"),
    rogue(
        "answers one Hello",
        "identity_answers_hello",
        answers=lambda device, message, answer: (
            Answer.NONE if isinstance(message, Hello) and device.count[Hello] > 1 else answer
        ),
    ),
    rogue("another hash", "identity_answers_hello", identity=lambda device: Identity(SCHEMA_HASH ^ 0x100, 1, 0, 1)),
    rogue("hash reversed", "identity_answers_hello", identity=lambda device: Identity(HASH_REVERSED, 1, 0, 1)),
    rogue("Hello is no nonce", "idle_without_zero_stays", **keeps_nonce_at(Hello)),
    rogue("ignores the schema", "misfitting_hello", hears=lambda _, message: fitting(message, schema_hash=SCHEMA_HASH)),
    rogue("ignores the version", "misfitting_hello", hears=lambda _, message: fitting(message, protocol_version=1)),
    rogue("Clear mends a mismatch", "misfitting_hello", before=sets(Clear, _compatible=True)),
    rogue("Clear mends a mismatch", "latched_by_a_mismatch_stays", before=sets(Clear, _compatible=True)),
    rogue(
        "Clear is ignored",
        "misfitting_hello",
        hears=lambda _, message: None if isinstance(message, Clear) else message,
    ),
    rogue("runs unhomed", "idle_without_zero_stays", before=sets(Drive, homed=True)),
    rogue(
        "every other Status",
        "reports_in_time",
        "every_drive_answered",
        shows=lambda device, _, status: status if device.count[Status] % 2 else None,
    ),
    rogue(
        "Status only beside Drives",
        "reports_in_time",
        "every_drive_answered",
        shows=lambda device, time_s, status: status if time_s - device.drive_s < 0.3 else None,
    ),
    fault("no_status", "every_nonce"),
    rogue(
        "Status lags beside Drives",
        "reports_in_time",
        "every_drive_answered",
        shows=lambda device, time_s, status: (
            None if device.count[Status] % 4 == 0 and time_s - device.drive_s < 0.01 else status
        ),
    ),
    fault("no_state", "every_drive_answered"),
    fault("answers_half", "every_drive_answered"),
    fault("no_sense", "every_drive_answered"),
    rogue(
        "State's counter stuck",
        "status_consistent",
        "every_drive_answered",
        measures=lambda _, time_s, measured: (measured[0].replaced(counter=5), measured[1]),
    ),
    rogue(
        "State's counter repeated",
        "status_consistent",
        "every_drive_answered",
        measures=lambda _, time_s, measured: (measured[0].replaced(counter=measured[0].counter // 2), measured[1]),
    ),
    Planted(
        "late",
        "reports_in_time",
        lambda: serial_line(plant=LATE),
        ("every_drive_answered",),
    ),
    fault("clock=+2%", "clock_runs_on", "every_drive_answered"),
    fault("clock=-2%", "clock_runs_on", "every_drive_answered"),
    rogue(
        "clock in milliseconds",
        "clock_runs_on",
        "every_drive_answered",
        measurement=lambda device, time_s, sensors: device.real.measurement(time_s * 0.01, sensors),
    ),
    rogue(
        "Drive's counter behind",
        "status_consistent",
        "every_counter",
        shows=lambda _, time_s, status: status.replaced(drive_counter=(status.drive_counter - 1) % 256),
    ),
    rogue(
        "answers repetitions",
        "every_drive_answered",
        "idle_without_zero_stays",
        answers=lambda _, message, answer: Answer.MEASUREMENT if isinstance(message, Drive) else answer,
    ),
    rogue(
        "supply in tenths",
        "status_consistent",
        "every_counter",
        shows=lambda _, time_s, status: status.replaced(supply_V=status.supply_V / 10.0),
    ),
    fault("supply_loss", "every_nonce"),
    rogue(
        "current with an offset",
        "plausible_in_each_mode",
        "every_drive_answered",
        measures=lambda _, time_s, measured: (
            measured[0],
            measured[1].replaced(left_current_A=measured[1].left_current_A + 0.5),
        ),
    ),
    wire("no CRC-8", "idle_without_zero_stays", mended=mending(with_crc8)),
    wire("clamps duties", "idle_without_zero_stays", mended=mending(clamped)),
    wire("any length", "idle_without_zero_stays", mended=mending(cut_to_length)),
    wire("other functions are Drives", "idle_without_zero_stays", mended=mending(other_functions_are_drives)),
    wire("no CRC-16", "idle_stays", mended=without_crc_16),
    wire("takes what is too long", "idle_stays", mended=lambda _, stretch: stretch[:12] + DELIMITER),
    Planted("every node", "idle_stays", lambda: can_line(wrong(Bus, down=lambda _, identifier: identifier & ~0xF | 3))),
    rogue("Home is ignored", "home_homes", hears=only_acknowledges(Home)),
    fault("motor_reversed_left", "home_homes"),
    fault("encoder_reversed_left", "home_homes"),
    fault("switch_dead_left", "home_homes"),
    rogue(
        "homes only once",
        "idle_home",
        hears=lambda device, message: None if isinstance(message, Home) and device.homed else message,
    ),
    rogue("homing is not to be ended", "homing_retract", hears=only_acknowledges(Retract, in_mode(DeviceMode.HOMING))),
    rogue("homed before zero", "home_homes", measures=homed_before_zero),
    rogue("obeys repetitions", "idle_stays", before=sets(Home, _nonce=-1)),
    rogue("Retract's nonce not shown", "idle_retract", **keeps_nonce_at(Retract)),
    rogue("Clear ends anything", "homing_stays", before=CLEAR_ENDS_ANYTHING),
    rogue("homes from anywhere", "retracting_stays", before=HOMES_FROM_ANYWHERE),
    rogue("homes from anywhere", "run_stays", before=HOMES_FROM_ANYWHERE),
    rogue("homes from anywhere", "latched_stays", before=HOMES_FROM_ANYWHERE),
    rogue("Clear ends anything", "run_stays", before=CLEAR_ENDS_ANYTHING),
    rogue(
        "modes mixed up",
        "home_homes",
        shows=lambda _, time_s, status: status.replaced(mode=SWAPPED.get(status.mode, status.mode)),
    ),
    rogue(
        "never runs",
        "run_drive_off",
        hears=lambda _, message: message.replaced(mode=DriveMode.OFF) if isinstance(message, Drive) else message,
    ),
    fault("duties_reversed", "left_duty"),
    *(
        rogue(
            "motors swapped",
            duty,
            drives=lambda device, output: (
                Output(output.right_duty, output.left_duty, output.enabled) if is_running(device) else output
            ),
        )
        for duty in ("left_duty", "right_duty")
    ),
    rogue(
        "pushes into the stop",
        "open_switch_stops",
        drives=lambda device, output: (
            Output(device.asked.left_duty, device.asked.right_duty, enabled=True) if is_running(device) else output
        ),
    ),
    rogue("OFF only switches off", "run_drive_off", before=OFF_ONLY_SWITCHES_OFF),
    rogue("does not begin to open", "run_drive_off", drives=opens_with(0.0)),
    rogue("presses shut", "run_drive_off", drives=opens_with(-1.0)),
    rogue("opens too slowly", "run_retract", drives=opens_with(0.2)),
    rogue("stops half way", "run_drive_off", ticked=stops_after(0.08)),
    rogue("Retract is ignored", "run_retract", hears=only_acknowledges(Retract)),
    rogue("needs no letting go", "let_go_after_all", before=sets(object, _may_run=True)),
    rogue("Hello takes the zero", "run_stays", after=sets(Hello, is_running, homed=False)),
    *(
        rogue(f"a mismatch in {mode.name} passes", finds, hears=mends_misfits_in(mode))
        for mode, finds in {
            DeviceMode.IDLE: "idle_hello_misfit",
            DeviceMode.HOMING: "homing_hello_misfit",
            DeviceMode.RETRACTING: "retracting_hello_misfit",
            DeviceMode.LATCHED: "latched_hello_misfit",
        }.items()
    ),
    rogue("timeout of 35 ms", "silence_is_noticed", ticks=timeout_of(0.035)),
    rogue("timeout of 65 ms", "silence_is_noticed", ticks=timeout_of(0.065)),
    rogue("no timeout", "silence_is_noticed", ticks=extends),
    rogue("latches without opening", "silence_is_noticed", ticked=rests(times_out_opening, DeviceMode.LATCHED)),
    rogue("any message extends", "run_silence", before=extends),
    rogue(
        "a repetition extends",
        "run_silence",
        before=lambda device, time_s, message: extends(device, time_s) if isinstance(message, Drive) else None,
    ),
    rogue("does not latch", "run_silence", ticked=rests(is_latched)),
    rogue(
        "latched does not measure",
        "every_drive_answered",
        "run_silence",
        answers=lambda device, message, answer: (
            Answer.NONE if is_latched(device) and isinstance(message, Drive) else answer
        ),
    ),
    rogue("retracts when latched", "latched_stays", hears=only_acknowledges(Retract, is_latched)),
    rogue(
        "Clear homes",
        "latched_clear",
        after=sets(Clear, in_mode(DeviceMode.IDLE), homed=True),
    ),
    rogue("Clear lets go", "let_go_after_all", after=sets(Clear, _may_run=True)),
    fault("state_crc", "own_messages", "every_drive_answered"),
    wire(
        "a byte lost",
        "own_messages",
        "every_drive_answered",
        of=Wire,
        up=lambda wire, data: data[1:] if round(wire.time_s * 1e3) % 50 == 0 else data,
    ),
    # errors that an earlier kit did not see
    rogue(
        "runs without a Hello",
        "warm_reset",
        before=sets(Drive, lambda device, message: device.count[Hello] == 0, _compatible=True),
    ),
    rogue("timeout blind by its sign", "any_uptime", ticks=blind_while(lambda _, time_s: time_s % 65.536 > 32.768)),
    rogue(
        "timeout judged with Status",
        "silence_is_noticed",
        ticks=blind_while(lambda device, _: (device.real._ticks + 1) % 20 != 0),
    ),
    rogue("opens half the way", "run_drive_off", ticked=stops_after(0.8)),
    rogue("opens at 5 mm/s", "run_drive_off", before=sets(object, _retract_mm_s=5.0)),
    rogue(
        "opens at full duty",
        "run_retract",
        drives=lambda device, output: (
            Output(math.ceil(output.left_duty), math.ceil(output.right_duty), output.enabled)
            if device.real.mode is DeviceMode.RETRACTING
            else output
        ),
    ),
    rogue("opens half the way", "run_silence", ticked=stops_after(0.8)),
    rogue("a mismatch unwatched", "run_hello_misfit", ticked=unwatched(DeviceFault.SCHEMA_MISMATCH)),
    rogue("skew unwatched", "skew_opens", ticked=unwatched(DeviceFault.SKEW)),
    rogue("end stops unwatched", "end_stop_opens", ticked=unwatched(DeviceFault.END_STOP)),
    rogue(
        "left end stop alone watched",
        "end_stop_opens",
        senses=with_switches(
            lambda device, switches: switches if Switches.LEFT_CLOSED in switches else switches & ~Switches.RIGHT_CLOSED
        ),
    ),
    rogue("switches swapped", "open_switch_stops", senses=with_switches(swapped)),
    rogue(
        "open switches stuck once homed",
        "status_consistent",
        "open_switch_stops",
        senses=with_switches(lambda device, switches: switches | BOTH_OPEN if device.real.homed else switches),
    ),
    rogue(
        "left switch for both",
        "open_switch_stops",
        senses=with_switches(
            lambda _, switches: switches | BOTH_OPEN if Switches.LEFT_OPEN in switches else switches & ~BOTH_OPEN
        ),
    ),
    rogue(
        "duties clipped",
        "duties_make_currents",
        drives=lambda device, output: Output(clipped(output.left_duty), clipped(output.right_duty), output.enabled),
    ),
    rogue("positions scaled", "end_stop_opens", measures=moved(1.09, 0.0)),
    rogue("zero off", "status_consistent", "open_switch_stops", measures=moved(1.0, 0.6)),
    rogue("zero off the other way", "status_consistent", "open_switch_stops", measures=moved(1.0, -0.6)),
    rogue(
        "currents in tenths",
        "duties_make_currents",
        measures=sensed(
            lambda sense: sense.replaced(
                left_current_A=0.1 * sense.left_current_A, right_current_A=0.1 * sense.right_current_A
            )
        ),
    ),
    rogue(
        "time in milliseconds",
        "clock_runs_on",
        "every_drive_answered",
        measures=lambda _, time_s, measured: (
            measured[0].replaced(device_time_s=math.floor(time_s * 1e3) % 655 * 1e-3),
            measured[1],
        ),
    ),
    rogue(
        "a fault beside",
        "silence_is_noticed",
        shows=lambda _, time_s, status: (
            status.replaced(faults=status.faults | DeviceFault.OVERCURRENT)
            if DeviceFault.COMMAND_TIMEOUT in status.faults
            else status
        ),
    ),
    rogue(
        "no Status at high duty",
        "reports_in_time",
        "open_switch_stops",
        "every_drive_answered",
        shows=lambda device, _, status: (
            None if is_running(device) and abs(device.real.output.left_duty) > 0.8 else status
        ),
    ),
    rogue("a Hello lets go", "idle_not_let_go_stays", before=sets(Hello, _may_run=True)),
    rogue(
        "currents swapped",
        "plausible_in_each_mode",
        "home_homes",
        "skew_opens",
        measures=sensed(
            lambda sense: sense.replaced(left_current_A=sense.right_current_A, right_current_A=sense.left_current_A)
        ),
    ),
    rogue(
        "equal counters with other duties",
        "idle_stays",
        before=sets(Drive, lambda device, message: message.left_duty != device.asked.left_duty, _drive_counter=None),
    ),
    rogue(
        "force reversed",
        "force_follows_gap",
        "handle_runs_on",
        measures=sensed(lambda sense: sense.replaced(force_N=-sense.force_N)),
    ),
    rogue("positions one Drive old", "duties_make_currents", measures=place_old),
    rogue(
        "commands run out",
        "every_nonce",
        hears=lambda device, message: None if isinstance(message, Clear) and device.count[Clear] > 255 else message,
    ),
    rogue(
        "OFF with a duty is RUN",
        "run_drive_off",
        hears=lambda device, message: (
            message.replaced(mode=DriveMode.RUN)
            if isinstance(message, Drive) and is_running(device) and message.left_duty
            else message
        ),
    ),
    wire(
        "clamps duties in RUN",
        "idle_without_zero_stays",
        mended=mending(lambda body: clamped(body) if body[6:7] == RUNS else body),
    ),
    rogue("one Drive a tick", "every_drive_answered", "run_drive_off", hears=only_one_a_tick),
    rogue(
        "nonce of 7 bits",
        "every_nonce",
        hears=lambda _, message: (
            message.replaced(nonce=message.nonce % 128) if isinstance(message, Home | Clear | Retract) else message
        ),
    ),
    rogue(
        "every 100th Drive dropped",
        "every_drive_answered",
        hears=lambda device, message: (
            None if isinstance(message, Drive) and device.count[Drive] % 100 == 0 else message
        ),
    ),
    Planted(
        "microseconds run over",
        "any_uptime",
        lambda: serial_line(wrong(Rogue, up_s=2120.0, ticks=blind_while(lambda _, time_s: time_s > 2.0**31 * 1e-6))),
    ),
    rogue(
        "counter of 7 bits",
        "every_counter",
        hears=lambda _, message: (
            message.replaced(counter=message.counter % 128) if isinstance(message, Drive) else message
        ),
    ),
    rogue("duties act while homing", "homing_beside_run_stays", drives=drives_in(DeviceMode.HOMING)),
    rogue("duties act while opening", "retracting_after_silence_stays", drives=drives_in(DeviceMode.RETRACTING)),
    rogue(
        "never opens",
        "left_open",
        "left_duty",
        before=OFF_ONLY_SWITCHES_OFF,
        hears=lambda _, message: None if isinstance(message, Retract) else message,
    ),
    # errors that two later kits did not see
    rogue("Clear with any nonce", "latched_stays", before=sets(Clear, _nonce=-1)),
    rogue("OFF's duties move an idle device", "idle_stays", **pushes(Drive, DeviceMode.IDLE, 0.02)),
    rogue("OFF's duties go on for 40 ms", "run_drive_off", **pushes(Drive, DeviceMode.RUN, 0.04)),
    rogue(
        "handle of 14 bits",
        "handle_runs_on",
        measures=sensed(lambda sense: sense.replaced(handle_position_mm=sense.handle_position_mm % (40.0 * math.pi))),
    ),
    rogue(
        "force clipped",
        "force_follows_gap",
        "skew_opens",
        "end_stop_opens",
        measures=sensed(lambda sense: sense.replaced(force_N=min(sense.force_N, 2.047))),
    ),
    rogue(
        "a clock of 65000 steps",
        "clock_runs_on",
        "every_drive_answered",
        measures=lambda _, time_s, measured: (measured[0].replaced(device_time_s=time_s % 0.65), measured[1]),
    ),
    rogue(
        "every 256th position off",
        "positions_run_on",
        *MOTIONS,
        measures=placed(
            lambda state: {"left_position_mm": state.left_position_mm - 0.01 * (state.counter == 99)}, DeviceMode.RUN
        ),
    ),
    rogue(
        "duties of 5 bits",
        "duties_make_currents",
        hears=with_duties(*2 * [lambda own, _: round(own * 16.0) / 16.0]),
    ),
    rogue(
        "duties with a dead band",
        "duties_make_currents",
        hears=with_duties(*2 * [lambda own, _: own * (abs(own) > 0.03)]),
    ),
    rogue(
        "left duty for both above 0.8",
        "duties_make_currents",
        hears=with_duties(lambda own, _: own, lambda own, other: other if abs(own) > 0.8 else own),
    ),
    rogue(
        "currents without sign",
        "duties_make_currents",
        measures=sensed(
            lambda sense: sense.replaced(
                left_current_A=abs(sense.left_current_A), right_current_A=abs(sense.right_current_A)
            )
        ),
    ),
    rogue("switches 60 ms late", "status_consistent", "open_switch_stops", shows=shows_late),
    rogue(
        "another serial number each time",
        "status_consistent",
        "identity_answers_hello",
        identity=lambda device: Identity(SCHEMA_HASH, 1, 0, device.count[Hello]),
    ),
    rogue(
        "no Status as a fault latches",
        "misfitting_hello",
        shows=lambda device, _, status: status if device.mode is DeviceMode.IDLE else None,
    ),
    rogue(
        "not braked",
        "status_consistent",
        "run_drive_off",
        shows=lambda _, time_s, status: (
            status.replaced(switches=status.switches & ~Switches.LEFT_OPEN)
            if status.mode is DeviceMode.RETRACTING
            else status
        ),
    ),
    rogue(
        "a Hello ends the duties",
        "duties_make_currents",
        drives=lambda device, output: Output(0.0, 0.0, output.enabled) if device.ended else output,
        before=lambda device, _, message: setattr(
            device,
            "ended",
            isinstance(message, Hello)
            or (device.ended and getattr(message, "counter", device.asked.counter) == device.asked.counter),
        ),
        ended=False,
    ),
    rogue(
        "a lone Drive runs on",
        "silence_is_noticed",
        before=lambda device, time_s, message: setattr(device, "lone", not is_running(device)),
        ticks=lambda device, time_s: setattr(device.real, "_drive_s", time_s) if device.lone else None,
        lone=False,
    ),
    rogue(
        "runs from standing only",
        "let_go_after_all",
        hears=lambda device, message: (
            message.replaced(left_duty=0.0, right_duty=0.0)
            if isinstance(message, Drive) and not is_running(device)
            else message
        ),
    ),
    rogue(
        "15.6 V in one Status of 50",
        "status_consistent",
        "every_drive_answered",
        shows=lambda device, _, status: status.replaced(supply_V=15.6) if device.count[Status] % 50 == 0 else status,
    ),
    rogue(
        "a clock that leaps once",
        "clock_runs_on",
        "every_counter",
        "every_drive_answered",
        measures=lambda _, time_s, measured: (
            measured[0].replaced(device_time_s=(time_s + 0.02 * (time_s > 1.0)) % 0.65536),
            measured[1],
        ),
    ),
    rogue(
        "no Status after a while alone",
        "reports_in_time",
        "every_drive_answered",
        shows=lambda device, time_s, status: status if time_s - device.drive_s < 1.5 else None,
    ),
    rogue(
        "a current without sign while opening",
        "plausible_in_each_mode",
        "home_homes",
        "skew_opens",
        "end_stop_opens",
        measures=lambda device, _, measured: (
            measured[0],
            measured[1].replaced(left_current_A=-abs(measured[1].left_current_A))
            if device.real.mode is DeviceMode.RETRACTING
            else measured[1],
        ),
    ),
    rogue(
        "a force that stands while opening",
        "force_follows_gap",
        "run_drive_off",
        measures=lambda device, _, measured: (
            measured[0],
            measured[1].replaced(force_N=0.25) if device.real.mode is DeviceMode.RETRACTING else measured[1],
        ),
    ),
    rogue(
        "remembers its zero",
        "cold_reset",
        after=lambda device, *_: device.kept.update(homed=device.real.homed),
        boots=lambda device: setattr(device.real, "homed", device.kept.get("homed", False)),
        kept={},
    ),
    rogue(
        "a reset keeps Drive's counter",
        "warm_reset",
        after=lambda device, *_: device.kept.update(counter=device.real._drive_counter),
        boots=lambda device: setattr(device.real, "_drive_counter", device.kept.get("counter")),
        kept={},
    ),
    rogue(
        "Home ignores small nonces",
        "let_go_after_all",
        hears=lambda _, message: None if isinstance(message, Home) and message.nonce < 100 else message,
    ),
    # kinds of error that a later kit did not see
    rogue(
        "the left position stands while homing",
        "plausible_in_each_mode",
        "home_homes",
        "run_drive_off",
        measures=placed(lambda _: {"left_position_mm": 0.0}, DeviceMode.HOMING),
    ),
    rogue(
        "currents of the other side while opening",
        "plausible_in_each_mode",
        "home_homes",
        "skew_opens",
        measures=sensed(
            lambda sense: sense.replaced(left_current_A=sense.right_current_A, right_current_A=sense.left_current_A),
            DeviceMode.RETRACTING,
        ),
    ),
    rogue(
        "currents without sign while homing",
        "plausible_in_each_mode",
        *(3 * ("home_homes",)),
        "run_drive_off",
        measures=sensed(lambda sense: sense.replaced(left_current_A=abs(sense.left_current_A)), DeviceMode.HOMING),
    ),
    rogue("handle read at 100 Hz", "handle_runs_on", measures=handle_of_10_ms, stands_mm=0.0),
    rogue(
        "every 500th force 0",
        "plausible_in_each_mode",
        "home_homes",
        "run_drive_off",
        measures=lambda device, _, measured: (
            measured[0],
            measured[1].replaced(force_N=measured[1].force_N * (measured[0].counter != 99)),
        ),
    ),
    rogue(
        "a misfit is not answered in RUN",
        "run_hello_misfit",
        answers=lambda device, message, answer: (
            Answer.NONE
            if isinstance(message, Hello)
            and fitting(message, **RIGHT) != message
            and device.mode is DeviceMode.RETRACTING
            else answer
        ),
    ),
    rogue(
        "a Retract clears what opens",
        "retracting_after_silence_stays",
        before=lambda device, _, message: (
            setattr(device.real, "faults", DeviceFault(0))
            if isinstance(message, Retract) and device.mode is DeviceMode.RETRACTING
            else None
        ),
    ),
    rogue(
        "one zero for both",
        "cold_reset",
        ticked=lambda device, _: setattr(device.real, "_right_zero_mm", device.real._left_zero_mm),
    ),
    # kinds of error that the kit after it did not see
    rogue(
        "a current clipped while homing",
        "plausible_in_each_mode",
        *MOTIONS,
        measures=sensed(
            lambda sense: sense.replaced(left_current_A=min(max(sense.left_current_A, -0.3), 0.3)), DeviceMode.HOMING
        ),
    ),
    rogue(
        "a current with an offset while opening",
        "plausible_in_each_mode",
        *MOTIONS,
        measures=sensed(lambda sense: sense.replaced(left_current_A=sense.left_current_A + 0.1), DeviceMode.RETRACTING),
    ),
    rogue(
        "the left position scaled while homing",
        "plausible_in_each_mode",
        *MOTIONS,
        measures=placed(lambda state: {"left_position_mm": 1.3 * state.left_position_mm}, DeviceMode.HOMING),
    ),
    rogue(
        "one position for both while homing",
        "plausible_in_each_mode",
        *MOTIONS,
        measures=placed(lambda state: {"left_position_mm": state.right_position_mm}, DeviceMode.HOMING),
    ),
    rogue(
        "a coarse clock in RUN",
        "clock_runs_on",
        *MOTIONS,
        measures=placed(lambda state: {"device_time_s": round(state.device_time_s, 3)}, DeviceMode.RUN),
    ),
    rogue(
        "a force that stands while latched",
        "force_follows_gap",
        "every_drive_answered",
        "run_silence",
        "latched_stays",
        measures=sensed(lambda sense: sense.replaced(force_N=0.9), DeviceMode.LATCHED),
    ),
    rogue("the Drive before the last Status", "status_consistent", *MOTIONS, shows=drive_before),
    rogue("every 50th nonce old", "status_consistent", "every_nonce", shows=nonce_of_before),
    rogue("a misfit pushes while opening", "retracting_hello_misfit", **pushes(Hello, DeviceMode.RETRACTING, 0.02)),
    wire("a frame of the one before the last is dropped", "frames_as_they_come", mended=thrice, olds=(b"", b"")),
    wire(
        "whole frames only",
        "frames_as_they_come",
        of=Wire,
        down=lambda _, data: data if data.endswith(DELIMITER) else b"",
    ),
)


SAID = {
    "timeout of 65 ms": "ms on the device's clock: RUN, no fault",
    "state_crc": "State: CRC-8",
    "encoder_reversed_left": "LATCHED, HOMING_FAILED",
    "no CRC-8": "a Drive with a wrong CRC-8",
    "clock=+2%": "+2.0",
    "never opens": "THE GAP MAY BE SHUT",
}
"""What must be seen of some errors."""


def hosted(line: Any) -> Host:
    messages = line.port.device.messages
    return Host(line, reset=lambda how: messages._reset(messages._time_s))


def named(name: str) -> Check:
    return next(one for one in CHECKS if one.name == name)


def by_error(error: str) -> Line:
    return next(planted.line() for planted in PLANTED if planted.error == error)


def test_what_the_kit_damages_is_no_frame() -> None:
    damages = SerialLine(Wire(VirtualDevice(NEAR_HOME, WindingHand()))).damages(FUNCTION[Clear], b"\x07")
    assert {what for what, forms in damages.items() if FrameDecoder().feed(b"".join(forms))} == set()
    assert sum(map(len, damages.values())) > 80


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: f"{planted.error}-{planted.finds}")
def test_a_planted_error_is_found_by_name(planted: Planted) -> None:
    *_, result = run(hosted(planted.line()), [named(name) for name in (*planted.first, planted.finds)])
    assert (result.check.name, result.passed) == (planted.finds, False), result.seen
    assert SAID.get(planted.error, "") in result.seen


def test_every_check_finds_an_error() -> None:
    assert {planted.finds for planted in PLANTED} == {one.name for one in CHECKS} - UNTESTED


def test_a_device_that_cannot_be_met_is_not_moved() -> None:
    results = {result.check.name: result for result in run(Host(by_error("another hash")), CHECKS)}
    assert results["clock_runs_on"].passed
    assert {results[one.name].seen for one in CHECKS if one.moves} == {
        "not tried, because identity_answers_hello failed"
    }


class Asleep(Wire):
    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        if self.device.messages.firmware.mode is DeviceMode.RUN and not hasattr(self, "slept"):
            self.slept = True
            until_s += 0.06
        return super().read(until_s)


class Pausing(Wire):
    held = b""

    def down(self, data: bytes) -> bytes:
        data = self.held + data
        self.held = data if 0.5 < self.time_s < 1.0 else b""
        return b"" if self.held else data


class Uneven(Wire):
    """Drives come unevenly; and now and then this computer stands still, and the simulated device's clock with it."""

    chance = random.Random(5)
    stood_s = 0.0

    def write(self, data: bytes) -> None:
        self.device.receive(self.time_s - self.stood_s, data)

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        stands_s = 0.012 * (self.chance.random() < 5e-4)
        self.stood_s += stands_s
        self.time_s = max(self.time_s, until_s) + stands_s + 0.9e-3 * self.chance.random()
        return [(self.time_s, self.device.transmit(self.time_s - self.stood_s))]


class Napping(Uneven):
    """And for 3 ms in the first six long silences."""

    chance = random.Random(7)
    naps = 6
    wrote_s = 0.0

    def write(self, data: bytes) -> None:
        super().write(data)
        self.wrote_s = self.time_s

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        naps = until_s > self.wrote_s + 0.05 and self.naps > 0
        self.naps -= naps
        self.stood_s += 3e-3 * naps
        return super().read(until_s + 3e-3 * naps)


SILENCE, DRIVES, CLOCK = "silence_is_noticed", "every_drive_answered", "clock_runs_on"
MOVING = (*3 * ("home_homes",), "left_duty", "run_retract", "duties_make_currents")


@pytest.mark.parametrize(
    ("line", "names", "passed", "says_late"),
    [
        # a check that this computer spoiled is tried again, and the last attempt, which was not late, counts
        (lambda: serial_line(wire=Asleep), (SILENCE,), True, False),
        (lambda: serial_line(wrong(Rogue, ticks=timeout_of(0.035)), Asleep), (SILENCE,), False, False),
        (lambda: serial_line(wire=Napping), (SILENCE,), True, False),
        # what is judged by all that was heard says how late this computer ever was
        (lambda: serial_line(wire=Asleep, faults=["clock=+2%"]), (SILENCE, DRIVES, CLOCK), False, True),
        # a pause does not move the clock
        (lambda: serial_line(wire=Pausing), (DRIVES, "every_nonce", DRIVES, CLOCK), True, False),
        *(
            (lambda: serial_line(wire=Uneven), (*MOVING, name), True, False)
            for name in (CLOCK, "plausible_in_each_mode", "positions_run_on", "handle_runs_on", "status_consistent")
        ),
        # what a carrier has not is not judged, nor a handle that turns one way only
        (can_line, ("frames_as_they_come",), None, False),
        (lambda: SerialLine(Wire(VirtualDevice(NEAR_HOME, SteadyHand()))), (DRIVES, "handle_runs_on"), None, False),
    ],
)
def test_what_this_computer_or_the_hand_spoiled_is_not_the_devices(
    line: Callable[[], Line], names: tuple[str, ...], passed: bool | None, says_late: bool
) -> None:
    *_, result = run(Host(line()), [named(name) for name in names])
    assert (result.passed, "ms late meanwhile" in result.seen) == (passed, says_late), result.seen


# -- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:

    def run_on(line: Line, *arguments: str) -> int:
        monkeypatch.setattr(command, "open_line", lambda *_: line)
        return command.main(["virtual", *arguments])

    return run_on


def test_the_command_prints_json_and_exits_with_0(ran: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    assert ran(serial_line(), "--yes", "--json", "--only", "identity_answers_hello") == 0
    out, err = capsys.readouterr()
    checks = json.loads(out)["checks"]
    assert [(check["name"], check["passed"]) for check in checks] == [
        ("identity_answers_hello", True),
        ("left_open", True),
    ]
    assert set(checks[0]) >= {"name", "passed", "seen", "expected"}
    assert "ok    identity_answers_hello" in err


def test_a_failed_check_says_what_to_look_at_and_the_exit_code_is_1(
    ran: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert ran(by_error("timeout of 65 ms"), "--yes", "--only", "silence_is_noticed") == 1
    out = capsys.readouterr().out
    assert re.search(r"FAIL  silence_is_noticed\n +sent +in RUN.*\n +seen +after 5[23].*\n +expected .*\n +page +", out)
    assert "virtual: device 1, firmware 1.0: 1 of 2 checks passed" in out


@pytest.mark.parametrize("reset", ["false", "/nonexistent/tool", "'"])
def test_a_reset_that_fails_is_told_and_the_gap_is_opened(
    ran: Callable[..., int], capsys: pytest.CaptureFixture[str], reset: str
) -> None:
    assert ran(serial_line(), "--yes", "--only", "warm_reset", "--reset", reset) == 1
    out = capsys.readouterr().out
    assert "seen      --reset: " in out
    assert "ok    left_open" in out


def test_nothing_is_sent_before_somebody_agrees(
    monkeypatch: pytest.MonkeyPatch, ran: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    line = serial_line()
    for answer in (io.StringIO("yes\n"), Terminal("no\n"), Terminal("")):
        monkeypatch.setattr(sys, "stdin", answer)
        with pytest.raises(SystemExit, match="2"):
            ran(line)
    assert "MOTORS WILL MOVE" in capsys.readouterr().err
    assert line.port.now_s() == 0.0
    monkeypatch.setattr(sys, "stdin", Terminal("Yes\n"))
    assert ran(line, "--only", "identity_answers_hello") == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["/nonexistent/port", "--yes"], "/nonexistent/port"),
        (["/dev/null", "--yes"], "/dev/null: allowed is a serial port; this is none"),
        (["slcan:/dev/null", "--yes"], "slcan:/dev/null: cannot be opened: allowed is a serial port; this is none"),
        (["telepathy:0", "--yes"], "telepathy"),
        (["tormagsim:/nonexistent/can", "--yes"], "cannot be opened"),
        ([], "PORT|CHANNEL"),
        (["x", "--node", "16"], "16"),
        (["x", "--only", "clock_runs_off"], "clock_runs_on"),
        (["x", "--opening-mm-s", "nan"], "opening_mm_s = nan: allowed is 1..1000"),
        (["x", "--baud", "-5"], "baud = -5: allowed is 300.."),
    ],
)
def test_a_wrong_call_says_why_and_exits_with_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        sys.exit(command.main(arguments))
    assert said in capsys.readouterr().err


class Interrupted(Wire):
    error: type[BaseException] = KeyboardInterrupt
    until_s = 0.0

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        if self.device.messages.firmware.mode is DeviceMode.RUN and not self.until_s:
            self.until_s = until_s + 0.1
        if self.until_s and until_s > self.until_s:
            self.until_s = 1e9
            raise self.error("gone")
        return super().read(until_s)


def test_an_interrupted_run_leaves_the_gap_open(ran: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    device = VirtualDevice(NEAR_HOME, SteadyHand())
    try:
        assert ran(SerialLine(Interrupted(device)), "--yes", "--only", "duties_make_currents") == 1
        assert {signal.getsignal(number) for number in kept} == {signal.SIG_IGN}
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
    assert "ok    left_open" in capsys.readouterr().out
    assert device.messages.firmware.mode is DeviceMode.IDLE
    assert device.messages.truth.gap_mm > 94.0


def test_a_line_that_goes_is_told_and_no_success(ran: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        ran(
            serial_line(wire=wrong(Interrupted, error=OSError)),
            "--yes",
            "--json",
            "--only",
            "every_counter",
            "--only",
            "run_drive_off",
        )
        == 1
    )
    out, err = capsys.readouterr()
    assert "the line is gone (gone): by the page" in err
    names = {kind: [one["name"] for one in found] for kind, found in json.loads(out).items()}
    assert names == {"checks": ["every_counter"], "untested": ["run_drive_off", "left_open"]}


class Unread(io.StringIO):
    def write(self, text: str) -> int:
        raise BrokenPipeError


@pytest.mark.parametrize(
    ("options", "out", "code"),
    [((), Unread(), 0), (("--json",), Unread(), 1), ((), None, 1), (("--json",), None, 1)],
    ids=["text", "the report is lost", "closed", "closed to the report"],
)
def test_a_reader_that_goes_does_not_end_the_run(
    monkeypatch: pytest.MonkeyPatch, ran: Callable[..., int], options: tuple[str, ...], out: Unread | None, code: int
) -> None:
    device = VirtualDevice(NEAR_HOME, SteadyHand())
    monkeypatch.setattr(sys, "stdout", out)
    assert ran(SerialLine(Wire(device)), "--yes", "--only", "run_drive_off", *options) == code
    assert device.messages.firmware.mode is DeviceMode.IDLE


def test_every_check_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        command.main(["--list"])
    lines = capsys.readouterr().out.splitlines()
    unchecked = sum(finds.startswith("-") for finds in RULES.values())
    assert [line.partition(":")[0] for line in lines[:-unchecked]] == [one.name for one in CHECKS]


def test_every_check_cites_the_page() -> None:
    for one in CHECKS:
        heading, _, number = one.page.partition(", ")
        section = re.search(rf"^##+ {re.escape(heading)}$(.*?)(?=^##? |\Z)", PAGE, re.MULTILINE | re.DOTALL)
        assert section is not None, f"{one.name}: {heading!r} is no heading of the page"
        assert not number or re.search(rf"^{number}\. ", section[1], re.MULTILINE), (
            f"{one.name}: no {number}, {heading!r}"
        )


def test_the_rules_are_the_pages() -> None:
    flat = " ".join(re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", PAGE).split())
    assert [rule for rule in RULES if rule not in flat.replace("**", "")] == []
    held = " ".join(finds for finds in RULES.values() if not finds.startswith("-")).split()
    assert set(held) == {one.name for one in CHECKS}
    rows = [re.split(r" *\| *", line.strip("| ")) for line in PAGE.splitlines() if line.startswith("| ")]
    assert {name: tuple(cells) for name, *cells in rows if name in TAKES} == TAKES
    assert ["", *MODES] in [["", *cells] for cells in rows] or list(MODES) in rows


@pytest.mark.live
@pytest.mark.parametrize(("door", "prefix"), [("--pty", ""), ("--slcan", "slcan:")])
def test_real_ports_carry_it(door: str, prefix: str) -> None:
    names = ("identity_answers_hello", "idle_without_zero_stays", "every_drive_answered")
    only = [argument for name in names for argument in ("--only", name)]
    simulator = subprocess.Popen([sys.executable, "-m", "tormagd.simulation", door], stdout=subprocess.PIPE, text=True)
    try:
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
