"""The fault matrix: each fault on a serial line and on a CAN bus, in virtual time: its name, and how it ends safe.

Driven faults are injected at 1.8 N, and times count from then; the others are there from the beginning, and times count
from the command `home`. What is safe is stated for each, and by when the reaction has to be on its way: what the table
of codes says of the code that is named, or what the injection says itself. How fast the force is lost on the way is
measured too: a force that vanishes at once is a hazard of its own.
"""

import argparse
import json
import math
import sys
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import msgpack
import msgspec
from bad_lines import BadBus, BadSerialLine, Damaging, Delaying, Doubling, Losing, MakeWay, Reordering
from tqdm import tqdm

from firmware_protocol.codec import DeviceMode
from tormagd.closed_loop import ClosedLoop, Sample, VirtualBus
from tormagd.config import Config, load_config
from tormagd.control.core import Core, build_core
from tormagd.control.governor import TimedSetpoint
from tormagd.daemon.inbox import SetpointInbox
from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.safety.operating_state import OperatingState, RefusedError
from tormagd.simulation.can_device import CanDevice
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd.simulation.plant import Sensor

FORCE_N = 1.8
SWING_N = 0.1
SAFE_N = 1.0
OPEN_MM = 94.0
INJECTED_S = 5.0
"Virtual time of the injection: homed, enabled and settled by then."
USUAL_S = 2.0
WATCHED_S = 6.0
LOSS_MS = 50
"A loss of force is what a hand feels of it: the greatest over so long."
OFFSET_N = 0.8
SATURATED_N = 20.0
"Of a broken force sensor."
HOGGED_MS = 12
HOGGED_EVERY_MS = 100
OTHER_N = 0.6
"What the source asks for that takes over."
REPLAYED_MESSAGES = 500
CLOCK_STEP_S = 3_600
REALTIME_S = 1_700_000_000
"What the computers' clocks show at the beginning."
CONNECTED_S = 0.5
ARMING_S = 14.0
MOST_OFF_N = 0.15
"A force that is held is off by no more, in the mean of the last second,"
MOST_OVER_N = 0.3
"and never too great by more."
MOST_CLOSED_MM = 3.0
"What is not driven, or homed, closes by no more than a few mm."

OPENS = "opens"
"The gap is open and the force below 1 N."
HELD = "held"
"The force goes on as asked, and no fault opens the gap."
FOLLOWED = "followed"
"The force goes to what is asked now, and no fault opens the gap."
LIMITED = "limited"
"The force stays within the scene's range, and no fault opens the gap."
HELD_OR_OPENS = "held or opens"
STAYS = "stays"
"Nothing can open the gap, or nothing has been driven: it closes by no more than MOST_CLOSED_MM."

SERIAL, CAN = "serial", "can"
DRIVEN = "1.8 ± 0.1 N at 1 Hz, handle at 42 mm/s"
HOMING = "homing"
ARMING = "homing for 14 s, then enable"
CONNECTING = "the command home"
REFUSED_MS = 100.0
"A command is refused by then: at once."


class Injection(NamedTuple):
    """A fault: of the simulated device (a `--fault` word), of the host, of the publisher, or of the line.

    `names` are the codes of which one has to be told, `safe` is how it has to end. One that is not driven is there from
    the beginning, and the device is homed and enabled with it, as far as that goes.
    """

    name: str
    names: tuple[str, ...]
    safe: str = OPENS
    device: str | None = None
    host: str | None = None
    stall_ms: int = 0
    way: MakeWay | None = None
    fill_frames_ms: float = 0.0
    sensor: str | None = None
    publisher: str | None = None
    within_ms: float | None = None
    "By when the reaction has to be on its way, where that is not what the table of codes says."
    excitation: str = DRIVEN
    is_driven: bool = True
    buses: tuple[str, ...] = (SERIAL, CAN)


MATRIX = (
    Injection("daemon killed or cable cut", ("device:COMMAND_TIMEOUT",), host="silent"),
    Injection("daemon stalls for 45 ms", ("HOST_STALL",), HELD, stall_ms=45),
    Injection("daemon stalls for 83 ms", ("HOST_STALL",), stall_ms=83),
    Injection("device hears nothing", ("MEASUREMENT_STALE",), device="commands_vanish"),
    Injection("device resets", ("DEVICE_NOT_RUNNING",), device="reset"),
    Injection("motor supply fails", ("DEVICE_SUPPLY",), STAYS, device="supply_loss"),
    Injection("left encoder stuck", ("NO_MOTION",), device="encoder_stuck_left"),
    Injection("left drag +50%", (), HELD, device="drag_left=+50%"),
    Injection("worn gearbox", (), HELD, device="worn_gearbox"),
    Injection("worn gearbox, then daemon killed", ("device:COMMAND_TIMEOUT",), device="worn_gearbox", host="silent"),
    Injection("publisher silent", ("STALE",), host="stale"),
    Injection("another source takes over", (), FOLLOWED, host="other"),
    Injection("operator: stop", ("STOPPED",), host="stop"),
    Injection("operator: disable", (), host="disable"),
    # one of its streams stops
    Injection("no State any more", ("MEASUREMENT_STALE",), device="no_state"),
    Injection("no Sense any more", ("SENSE_STALE",), device="no_sense"),
    Injection("no Status any more", ("STATUS_STALE",), device="no_status"),
    Injection("wrong CRC-8 in State", ("MEASUREMENT_STALE",), device="state_crc"),
    # measurements against physics
    Injection("both encoders jump by 4 mm", ("ENCODER",), device="encoder_jump"),
    Injection("left encoder jumps by 4 mm", ("ENCODER", "DEVICE_SKEW"), device="encoder_jump_left"),
    Injection("left encoder turns round", ("WRONG_DIRECTION",), device="encoder_reversed_left"),
    Injection("duties taken the other way", ("WRONG_DIRECTION",), device="duties_reversed"),
    Injection("device clock 2% fast", ("CLOCK",), HELD, device="clock=+2%"),
    Injection("device clock 30% slow", ("CLOCK",), device="clock=-30%"),
    # the line
    Injection("5% of the frames lost", ("LINK_DEGRADED",), HELD, way=partial(Losing, 0.05)),
    Injection(
        "5% of the frames damaged",
        ("LINK_DEGRADED", "LINK_LOST"),
        HELD_OR_OPENS,
        way=partial(Damaging, 0.05),
        within_ms=1_000.0,
        excitation=f"{DRIVEN}; it depends on which frame is hit",
    ),
    Injection("every frame twice", (), HELD, way=Doubling),
    Injection("20% of the frames overtaken", (), HELD, way=partial(Reordering, 0.2)),
    Injection("round trip of 7 ms", ("LINK_DEGRADED",), HELD, way=partial(Delaying, 0.003)),
    Injection("round trip of 15 ms", ("LINK_DEGRADED",), way=partial(Delaying, 0.007)),
    Injection("every other Drive answered", ("LINK_DEGRADED",), HELD, device="answers_half"),
    Injection("bus full", ("LINK_DEGRADED", "STATUS_STALE"), HELD_OR_OPENS, fill_frames_ms=6.5, buses=(CAN,)),
    Injection("cable pulled: nothing goes either way", ("LINK_LOST", "MEASUREMENT_STALE"), way=partial(Losing, 1.0)),
    Injection("daemon stalls for 12 ms, ten times a second", ("HOST_STALL",), HELD, host="hogged"),
    Injection("firmware hangs, its watchdog resets it", ("MEASUREMENT_STALE",), device="frozen", within_ms=151.0),
    # the force sensor and the handle
    Injection("force sensor stuck", ("SENSOR",), sensor="stuck"),
    Injection("force sensor 0.8 N too high", ("SENSOR", "OVER_FORCE"), sensor="high"),
    Injection("force sensor 0.8 N too low", ("SENSOR",), sensor="low"),
    Injection("force sensor at its end", ("OVER_FORCE",), sensor="saturated"),
    Injection("force sensor reads nothing", ("SENSOR",), sensor="dead"),
    Injection("handle's encoder lost", (), HELD, device="no_handle"),
    # motors, screws, switches, temperature
    Injection("left carriage blocked", ("NO_MOTION", "SKEW", "FOLLOWING_ERROR"), STAYS, device="blocked_left"),
    Injection(
        "both carriages blocked",
        ("NO_MOTION", "FOLLOWING_ERROR"),
        STAYS,
        device="blocked_left blocked_right",
    ),
    Injection("left motor without current", ("NO_MOTION", "SKEW", "FOLLOWING_ERROR"), STAYS, device="motor_dead_left"),
    Injection("backlash of the screws x10", (), HELD, device="backlash=+900%"),
    Injection("device too hot", ("DEVICE_TEMPERATURE",), device="overheated"),
    Injection("left closed end stop reported", ("DEVICE_END_STOP",), device="end_stop_left"),
    Injection("left open switch stuck", ("OUT_OF_STROKE",), STAYS, device="switch_stuck_left"),
    # setpoints, through the daemon's own border
    Injection("setpoints of NaN", ("STALE",), publisher="nan"),
    Injection("setpoints below 0", ("STALE",), publisher="negative"),
    Injection("setpoints far over the range", ("RANGE",), LIMITED, publisher="huge"),
    Injection("setpoints out of order", ("OTHER_SOURCE",), HELD, publisher="disordered"),
    Injection(
        "setpoints of a second ago, played again beside the new ones", ("OTHER_SOURCE",), HELD, publisher="replayed"
    ),
    Injection("a second source that does not hold the brake", ("OTHER_SOURCE",), HELD, publisher="second"),
    Injection("publisher's clock set forward by an hour", (), HELD, publisher="clock"),
    Injection("publisher started again", (), HELD, publisher="restarted"),
    # there from the beginning
    Injection(
        "homing: left motor wired the wrong way",
        ("WRONG_DIRECTION",),
        STAYS,
        "motor_reversed_left",
        excitation=HOMING,
        is_driven=False,
    ),
    Injection(
        "homing: left encoder counts backwards",
        ("WRONG_DIRECTION",),
        STAYS,
        "encoder_reversed_left",
        excitation=HOMING,
        is_driven=False,
    ),
    Injection(
        "homing: left switch never closes",
        ("DEVICE_OVERCURRENT",),
        STAYS,
        "switch_dead_left",
        within_ms=6_000.0,
        excitation="homing, from the closed end",
        is_driven=False,
    ),
    Injection(
        "first motion the wrong way",
        ("WRONG_DIRECTION",),
        OPENS,
        "duties_reversed",
        within_ms=15_000.0,
        excitation=ARMING,
        is_driven=False,
    ),
    Injection(
        "from the start: no Sense",
        ("not_connected: no Sense yet",),
        STAYS,
        "no_sense",
        excitation=CONNECTING,
        is_driven=False,
    ),
    Injection(
        "from the start: no Status",
        ("not_connected: no Status yet",),
        STAYS,
        "no_status",
        excitation=CONNECTING,
        is_driven=False,
    ),
    Injection(
        "from the start: wrong CRC-8 in State",
        ("not_connected: State refused: CRC-8",),
        STAYS,
        "state_crc",
        excitation=CONNECTING,
        is_driven=False,
    ),
    Injection(
        "from the start: round trip of 15 ms",
        ("link_degraded",),
        STAYS,
        way=partial(Delaying, 0.007),
        within_ms=14_100.0,
        excitation=ARMING,
        is_driven=False,
    ),
    Injection(
        "from the start: device clock 30% slow",
        ("clock",),
        STAYS,
        "clock=-30%",
        within_ms=14_100.0,
        excitation=ARMING,
        is_driven=False,
    ),
    Injection(
        "from the start: firmware of another protocol",
        ("not_connected: the firmware's protocol schema",),
        STAYS,
        "other_schema",
        excitation=CONNECTING,
        is_driven=False,
    ),
)


UNLIKE_LOSSES = (
    "frozen",
    "no_handle",
    "blocked_left",
    "blocked_left blocked_right",
    "motor_dead_left",
    "backlash=+900%",
    "overheated",
    "end_stop_left",
    "switch_stuck_left",
)
"""Devices that lose the force as others do that are tried on all samples: of these the evidence on one is enough."""
LEFT_OUT = {
    "motor that turns round in the middle of a run": "it is named (WRONG_DIRECTION after 31 ms), but is not safe: the "
    "device opens by its own routine, which then presses that side shut. Only the wiring can see to that",
    "bus-off of either node": "in virtual time it is a cable that is pulled; the real one is held by tests/hardware",
    "NaN from a sensor": "the wire carries integers, and has none; that step takes none is held by tests/control",
    "position that wraps": "it does every 117 mm, modulo 2^16 counts, and carriages travel 25; held by tests/hardware",
    "sensor's zero that drifts slowly": "it takes minutes and reversals; held by tests/closed_loop",
    "flood of setpoints or requests": "what is not read is decided by sockets; tools/fuzz_traffic.py and tests/daemon",
    "SIGKILL, SIGSTOP, SIGTERM, CPU hogs": "as far as a device can see they are silence, stalls and `disable`; with "
    "real processes in tools/stalls.py, tools/soak.py and tests/end_to_end",
    "disk full or slow": "nothing that controls writes to one; held by tests/recording",
    "clock of the host set": "the daemon's own clock is monotonic; of a publisher's there is a row",
}
"""What else may fail, and why it is no row of the matrix."""


class Cell(NamedTuple):
    """One row of the matrix. A time is null where it did not come to that within 6 s.

    `named`: one of the codes that it should have was told, and no other fault before. `safe`: it ended as stated, and
    `seconds` is when that began; for a force that is held, when it was named. `reacted_ms` is when the reaction was on
    its way: the device began to open or let go, the limit was told, or the command was refused. `in_time`: that was by
    `stated_ms`, which is null where nothing is to be told.
    """

    bus: str
    fault: str
    injected: str
    host_faults: tuple[str, ...]
    device_faults: tuple[str, ...]
    limits: tuple[str, ...]
    reaction: str
    noticed_ms: float | None
    below_1N_ms: float | None
    open_ms: float | None
    loss_N_s: float
    expected: str
    named: bool
    safe: bool
    seconds: float | None
    excitation: str
    must_be_named: tuple[str, ...]
    stated_ms: float | None
    reacted_ms: float | None
    in_time: bool


def main() -> int:
    """Prints the matrix; returns 1 where a cell is not named, not safe, or too late."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--bus", choices=(SERIAL, CAN), help="only this one")
    parser.add_argument("--only", default="", metavar="TEXT", help="faults with this in their name")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    todo = [
        (injection, bus)
        for injection in MATRIX
        for bus in injection.buses
        if options.bus in (None, bus) and options.only in injection.name
    ]
    steps = tqdm(todo, desc="faults", unit="fault", disable=not sys.stderr.isatty())
    cells = [inject(injection, options.plant, bus) for injection, bus in steps]
    if options.json:
        print(json.dumps({"plant": options.plant, "cells": [cell._asdict() for cell in cells]}))
    else:
        print_table(cells)
    return 0 if all(cell.named and cell.safe and cell.in_time for cell in cells) else 1


class Rig:
    """A daemon's core and a device, with a line between them that may go bad."""

    def __init__(self, injection: Injection, plant: str, bus: str, injected_s: float) -> None:
        self.config: Config = msgspec.structs.replace(load_config(None), scene="coronary")
        core: Core = build_core(self.config)
        self.most_N = core.scene.force.most_N
        faults = [parse_fault(f"{fault}@{injected_s}") for fault in (injection.device or "").split()]
        device = VirtualDevice(load_plant(plant), SteadyHand(), faults, seed=1)
        self.line: BadSerialLine | BadBus
        if bus == SERIAL:
            self.line = serial = BadSerialLine(device)
            self.loop = ClosedLoop(self.config, core.stepper, core.planner, serial)
        else:
            self.line = can = BadBus(CanDevice(device.messages))
            self.loop = ClosedLoop(self.config, core.stepper, core.planner, VirtualBus(can))

    def spoil(self, injection: Injection) -> None:
        """The line goes bad now."""
        if injection.way is not None:
            self.line.spoil(injection.way)
        if isinstance(self.line, BadBus):
            self.line.fill(injection.fill_frames_ms)
        if injection.sensor is not None:
            plant = self.loop.simulated.plant
            plant.force_sensor = BadSensor(plant.force_sensor, injection.sensor)


class BadSensor:
    """A force sensor that is broken from now on, one way or another."""

    def __init__(self, sensor: Sensor, how: str) -> None:
        self._sensor, self._how, self._last_N = sensor, how, sensor.reading_N

    @property
    def reading_N(self) -> float:
        """What is shown now; the handle turns forwards, and so readings are positive."""
        true_N = self._sensor.reading_N
        shown = {
            "stuck": self._last_N,
            "high": true_N + OFFSET_N,
            "low": true_N - OFFSET_N,
            "saturated": SATURATED_N,
            "dead": 0.0,
        }
        return shown[self._how]

    def advance(self, time_s: float, force_N: float) -> None:
        """As the sensor itself."""
        self._sensor.advance(time_s, force_N)


def inject(injection: Injection, plant: str, bus: str = SERIAL) -> Cell:
    """Runs one fault."""
    return _inject_driven(injection, plant, bus) if injection.is_driven else _begin_with(injection, plant, bus)


def _inject_driven(injection: Injection, plant: str, bus: str) -> Cell:
    rig = Rig(injection, plant, bus, INJECTED_S)
    loop = rig.loop
    loop.arm()
    setpoint = Publisher() if injection.publisher is None else DaemonsBorder(injection.publisher)
    usual: dict[str, None] = {}
    for sample in loop.run(INJECTED_S - loop.now_s, setpoint):
        if sample.time_s > INJECTED_S - USUAL_S:
            usual |= dict.fromkeys(map(str, (*sample.plan.limits, *sample.output.limits)))
    rig.spoil(injection)
    if injection.host in ("stop", "disable"):
        loop.command(injection.host)
    setpoint.is_silent, setpoint.is_other = injection.host == "stale", injection.host == "other"
    watch = Watch(usual, INJECTED_S, loop.simulated.truth.gap_mm, rig.most_N, injection.is_driven)
    for tick in range(round(WATCHED_S * rig.config.rates.control_hz)):
        is_hogged = injection.host == "hogged" and tick % HOGGED_EVERY_MS < HOGGED_MS
        if injection.host == "silent" or tick < injection.stall_ms or is_hogged:
            loop.skip()
            watch.see(loop, None)
        else:
            watch.see(loop, loop.tick(setpoint(loop.now_s)))
    return watch.cell(injection, bus, loop)


def _begin_with(injection: Injection, plant: str, bus: str) -> Cell:
    """Connects, homes and enables as far as the device lets one, and asks for the force then."""
    rig = Rig(injection, plant, bus, 0.0)
    loop = rig.loop
    rig.spoil(injection)
    for _ in loop.run(CONNECTED_S):
        pass
    setpoint = Publisher()
    setpoint.is_silent = True
    watch = Watch({}, loop.now_s, loop.simulated.truth.gap_mm, rig.most_N, injection.is_driven)
    is_enabled = _is_taken(loop, watch, "home")
    if is_enabled:
        for sample in loop.run(ARMING_S):
            watch.see(loop, sample)
            if sample.state.safety.faults:
                break
        is_enabled = not loop.step_state.safety.faults and _is_taken(loop, watch, "enable")
    setpoint.is_silent = not is_enabled
    for sample in loop.run(WATCHED_S, setpoint if is_enabled else lambda now_s: None):
        watch.see(loop, sample)
    return watch.cell(injection, bus, loop)


def _is_taken(loop: ClosedLoop, watch: "Watch", command: str) -> bool:
    try:
        loop.command(command)
    except RefusedError as error:
        watch.refuse(loop, error)
        return False
    return True


class Publisher:
    """A force setpoint every 2 ms, until it falls silent; it swings a little, because a fault may hide from a rest."""

    def __init__(self) -> None:
        self.is_silent = self.is_other = False
        self._stamp_s = 0.0

    def __call__(self, now_s: float) -> TimedSetpoint:
        if not self.is_silent:
            self._stamp_s = now_s - now_s % 0.002
        if self.is_other:
            return TimedSetpoint(OTHER_N, self._stamp_s, 0.1, holder=1)
        return TimedSetpoint(FORCE_N + SWING_N * math.sin(math.tau * self._stamp_s), self._stamp_s, 0.1)


class DaemonsBorder:
    """A publisher whose messages go through the daemon's inbox, as bytes; after the injection something is wrong."""

    is_silent = False

    def __init__(self, wrong: str) -> None:
        self._inbox, self._wrong = SetpointInbox(), wrong
        self._ticks, self._seq, self._session = 0, 0, 1
        self._earlier: deque[bytes] = deque(maxlen=REPLAYED_MESSAGES)
        self._kept: bytes | None = None
        self.is_other = False

    def __call__(self, now_s: float) -> TimedSetpoint | None:
        self._ticks += 1
        if self._ticks % 2:
            realtime_ns = round((REALTIME_S + now_s) * 1e9)
            for data in self._messages(now_s, realtime_ns):
                self._inbox.take(data, now_s, realtime_ns)
        return self._inbox.newest

    def _messages(self, now_s: float, realtime_ns: int) -> list[bytes]:
        wrong = self._wrong if now_s >= INJECTED_S else ""
        if wrong == "restarted" and self._session == 1:
            self._session, self._seq = 2, 0
        self._seq += 1
        force_N = FORCE_N + SWING_N * math.sin(math.tau * now_s)
        force_N = {"nan": math.nan, "negative": -1.0, "huge": 1e3}.get(wrong, force_N)
        stamp_ns = realtime_ns + (CLOCK_STEP_S * 10**9 if wrong == "clock" else 0)
        data = self._message("robot", force_N, stamp_ns, self._seq, self._session)
        self._earlier.append(data)
        if wrong == "disordered":
            if self._kept is None:
                self._kept = data
                return []
            data, self._kept = self._kept, None
            return [self._earlier[-1], data]
        if wrong == "replayed":
            return [data, self._earlier[0]]
        if wrong == "second":
            return [data, self._message("bystander", OTHER_N, realtime_ns, self._seq, 1)]
        return [data]

    @staticmethod
    def _message(source: str, force_N: float, stamp_ns: int, seq: int, session: int) -> bytes:
        packed: bytes = msgpack.packb(
            {
                "v": 1,
                "source": source,
                "seq": seq,
                "session": session,
                "stamp_ns": stamp_ns,
                "servo_cf": force_N,
                "valid_for_ms": 100.0,
            }
        )
        return packed


class Watch:
    """What the injection brought about, tick by tick."""

    def __init__(self, usual: dict[str, None], from_s: float, gap_mm: float, most_N: float, is_driven: bool) -> None:
        """`usual` are the limits that were held before the injection too: they notice nothing. `most_N` is the scene's
        greatest force."""
        self._range_N, self._most_N = most_N, 0.0
        self._has_run = is_driven
        self._opening_s: float | None = None
        self._let_go_s: float | None = None
        self._usual, self._from_s, self._from_mm = usual, from_s, gap_mm
        self._host: dict[str, None] = {}
        self._device: dict[str, None] = {}
        self._limits: dict[str, None] = {}
        self._refusal = ""
        self._forces_N: deque[float] = deque(maxlen=LOSS_MS + 1)
        self._loss_N_s = 0.0
        self._noticed_s: float | None = None
        self._below_s: float | None = None
        self._open_s: float | None = None
        self._resting_s: float | None = None
        self._least_mm = gap_mm
        self._over_N = 0.0
        self._off_N: list[float] = []

    def see(self, loop: ClosedLoop, sample: Sample | None) -> None:
        """Takes one tick; `sample` is None while the daemon is dead."""
        truth, firmware = loop.simulated.truth, loop.simulated.firmware
        if sample is not None:
            self._host |= dict.fromkeys(map(str, sample.state.safety.faults))
            if sample.state.safety.operating_state in (OperatingState.ENABLED, OperatingState.PAUSED):
                held = map(str, (*sample.plan.limits, *sample.output.limits))
                self._limits |= dict.fromkeys(limit for limit in held if limit not in self._usual)
        self._device |= dict.fromkeys(fault.name or "" for fault in firmware.faults)
        self._forces_N.append(truth.force_N)
        if len(self._forces_N) > LOSS_MS:
            self._loss_N_s = max(self._loss_N_s, (self._forces_N[0] - truth.force_N) / (LOSS_MS * 1e-3))
        first = _first(loop.now_s)
        if self._host or self._device or self._limits:
            self._noticed_s = first(self._noticed_s)
        # a force that is let go and comes back was not safe
        self._below_s = first(self._below_s) if truth.force_N < SAFE_N else None
        self._open_s = first(self._open_s) if truth.gap_mm > OPEN_MM else None
        self._resting_s = None if firmware.output.enabled else first(self._resting_s)
        if firmware.mode is DeviceMode.RUN:
            self._has_run = True
        elif self._has_run:
            self._let_go_s = first(self._let_go_s)
            if firmware.mode is DeviceMode.RETRACTING:
                self._opening_s = first(self._opening_s)
        self._most_N = max(self._most_N, truth.force_N)
        self._least_mm = min(self._least_mm, truth.gap_mm)
        off_N = truth.force_N - FORCE_N - SWING_N * math.sin(math.tau * loop.now_s)
        self._over_N = max(self._over_N, off_N)
        self._off_N.append(off_N)

    def refuse(self, loop: ClosedLoop, error: RefusedError) -> None:
        """A command was refused."""
        self._refusal = f"{error.code}: {error.message.partition(': ')[2]}"
        self._noticed_s = _first(loop.now_s)(self._noticed_s)

    def cell(self, injection: Injection, bus: str, loop: ClosedLoop) -> Cell:
        """The row."""
        state = loop.step_state.safety.operating_state
        mode = loop.simulated.firmware.mode.name
        noticed_ms = self._since(self._noticed_s)
        is_safe, safe_ms = self._ended(injection.safe, noticed_ms)
        stated_ms, reacted_ms = self._stated_ms(injection), self._reacted_ms(injection)
        return Cell(
            bus,
            injection.name,
            injection.name,
            tuple(self._host),
            tuple(self._device),
            (*self._limits, *([self._refusal] if self._refusal else [])),
            f"daemon {state}, device {mode}",
            noticed_ms,
            self._since(self._below_s),
            self._since(self._open_s),
            round(self._loss_N_s, 2),
            injection.safe,
            self._is_named(injection.names),
            is_safe,
            None if safe_ms is None else round(safe_ms * 1e-3, 4),
            injection.excitation,
            injection.names,
            stated_ms,
            reacted_ms,
            stated_ms is None or (reacted_ms is not None and reacted_ms <= stated_ms),
        )

    def _stated_ms(self, injection: Injection) -> float | None:
        """By when the reaction has to be on its way, by the table of the code that was told."""
        if injection.within_ms is not None:
            return injection.within_ms
        for name in injection.names:
            if name in self._host:
                return FAULTS[Fault(name)].safe_ms
            if name in self._limits:
                return LIMITS[Limit(name)].safe_ms
            if name.startswith("device:"):
                return FAULTS[Fault(name.replace("device:", "DEVICE_"))].safe_ms
            if self._refusal.startswith(name):
                return REFUSED_MS
        return None

    def _reacted_ms(self, injection: Injection) -> float | None:
        """When the device began to open, where it does, or let go; when it was told otherwise."""
        if self._refusal:
            return self._since(self._noticed_s)
        if not self._has_run:
            return self._since(self._resting_s)
        began_s = self._let_go_s if injection.safe == STAYS else self._opening_s
        return self._since(self._noticed_s if began_s is None else began_s)

    def _is_named(self, names: tuple[str, ...]) -> bool:
        if not names:
            return not self._host
        told = [*self._host, *self._limits, *(f"device:{fault}" for fault in self._device)]
        is_told = any(name in told or (self._refusal and self._refusal.startswith(name)) for name in names)
        first = next(iter(self._host), None)
        # what is latched first is what a person reads first
        return is_told and (first is None or first in names or names[0].startswith("device:"))

    def _ended(self, safe: str, noticed_ms: float | None) -> tuple[bool, float | None]:
        """Whether it ended as stated, and since when."""
        has_opened = self._open_s is not None and self._below_s is not None
        last_second = self._off_N[-1000:]
        is_held = abs(sum(last_second) / len(last_second)) < MOST_OFF_N and self._over_N < MOST_OVER_N
        if safe == STAYS:
            is_still = self._resting_s is not None and self._least_mm > self._from_mm - MOST_CLOSED_MM
            return is_still, self._since(self._resting_s)
        if safe == LIMITED:
            return not self._host and self._most_N < self._range_N + MOST_OVER_N, noticed_ms
        if safe == FOLLOWED:
            is_there = abs(self._forces_N[-1] - OTHER_N) < MOST_OFF_N and self._over_N < MOST_OVER_N
            return is_there and not self._host, self._since(self._below_s)
        if has_opened and safe in (OPENS, HELD_OR_OPENS):
            return True, self._since(self._open_s)
        return safe in (HELD, HELD_OR_OPENS) and is_held and not self._host, noticed_ms

    def _since(self, time_s: float | None) -> float | None:
        return None if time_s is None else round((time_s - self._from_s) * 1e3, 1)


def _first(now_s: float) -> Callable[[float | None], float]:
    return lambda known: now_s if known is None else known


WIDTH = 62


def print_table(cells: list[Cell]) -> None:
    """The matrix for a person."""
    times_heads = "".join(f"{head:>9s}" for head in ("noticed", "< 1 N", "open"))
    times_heads += f"{'reacted':>10s}{'stated':>10s}"
    print(f"{'injected':{WIDTH}s}{'bus':7s}{times_heads}{'loss':>10s}  {'must be':14s}noticed as; end state")
    for cell in cells:
        times = (cell.noticed_ms, cell.below_1N_ms, cell.open_ms)
        columns = "".join(f"{'-' if time is None else f'{time:.0f} ms':>9s}" for time in times)
        for time in (cell.reacted_ms, cell.stated_ms):
            columns += f"{'-' if time is None else f'{time:.0f} ms':>10s}"
        columns += f"{cell.loss_N_s:6.1f} N/s"
        named = [*cell.host_faults, *(f"device:{fault}" for fault in cell.device_faults), *cell.limits]
        failed = {"UNNAMED": not cell.named, "UNSAFE": not cell.safe, "LATE": not cell.in_time}
        verdict = "".join(f" {word}" for word, is_so in failed.items() if is_so)
        print(
            f"{cell.fault:{WIDTH}s}{cell.bus:7s}{columns}  {cell.expected:14s}{', '.join(named) or 'nothing'}; "
            f"{cell.reaction}{verdict}"
        )


if __name__ == "__main__":
    sys.exit(main())
