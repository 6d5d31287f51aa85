"""The daemon's core and the C firmware, and whatever may happen to them together: what holds in every state.

Operators, lost and damaged frames both ways, stalls of the daemon, faults and resets of the device, and time. Every
example ends with the cause put right and the documented commands, which have to lead to ENABLED.
"""

from functools import cache

import msgspec
import pytest
from bad_lines import BadSerialLine
from hypothesis import event, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from firmware_protocol.codec import (
    FUNCTION,
    Clear,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Home,
    Retract,
    Sense,
    State,
    Status,
)
from firmware_protocol.framing import cobs_decode
from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.operating_state import COMMANDS, OperatingState, RefusedError
from tormagd.daemon.control_loop import Arming
from tormagd.hardware.measurement import DeviceRequest
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import SerialDevice, VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant, standing

UP, DOWN = "to the daemon", "to the device"
SLOWEST = 0.7
TIMEOUT_MS = 51
"A device that hears no Drive has left RUN by then."
SILENT_MS = {FUNCTION[State]: 52, FUNCTION[Status]: 102, FUNCTION[Sense]: 102}
"The daemon stops driving by then without this stream (docs/states.md)."
ASKED_MS = 5
RECONNECTED_MS = 6_000
"A device that was reset has been found, asked to open, and is open by then."
MODE_AT = 6
OPEN_MM, OPENED_MM, UNHOMED_MM_S, TURNED_MS = 95.0, 93.5, 8.0, 300.0
"How slowly a device without a zero opens, and what turning round takes."
FROZEN_MS = 103
PATIENCE_S, SETTLED_MS = 15.0, 110
CLOSING_MS = 300
HINDERING = (
    "blocked_left",
    "motor_dead_left",
    "supply_loss",
    "opening=-100%",
    "motor_reversed_left",
    "switch_stuck_left",
)
"With these nothing can open the gap; they are named all the same."
HELD = DeviceFault.SUPPLY | DeviceFault.HOMING_FAILED | DeviceFault.RETRACT_FAILED
DEAF, RESTS = ("commands_vanish", "other_schema"), (DeviceMode.IDLE, DeviceMode.LATCHED)
ASKED = {DeviceMode.HOMING: DeviceRequest.HOME, (DeviceMode.LATCHED, DeviceMode.IDLE): DeviceRequest.CLEAR}
FAULTS = (
    *("reset", "frozen", "overheated", "end_stop_left", "commands_vanish", "no_state", "no_sense", "no_status"),
    *("encoder_stuck_left", "encoder_jump", "encoder_reversed_left", "duties_reversed", "answers_half", "state_crc"),
    *("clock=-30%", "other_schema", "worn_gearbox", "switch_dead_left", *HINDERING),
)
OPERATED = [name for name in COMMANDS if name != "use-scene"]
STREAMS = [
    *((UP, 0), (DOWN, 0), (UP, 0), (DOWN, 0)),
    *((UP, function) for function in SILENT_MS),
    *((DOWN, FUNCTION[kind]) for kind in (Drive, Retract, Home, Clear)),
]
"What a spell hits: a direction and a function, 0 for all."
FRAMES = st.sampled_from([1, 2, 10, 25, 40, 60, 200])
MS = st.sampled_from([1, 5, 20, 49, 52, 120, 250])


class BadLine(BadSerialLine):
    """A device behind a line that loses or damages the next frames."""

    def __init__(self, device: SerialDevice) -> None:
        super().__init__(device)
        self._up = lambda _, frames: [self._carried(UP, frame) for frame in frames]
        self._down = lambda _, frames: [self._heard(frame) for frame in frames]
        self.spells: dict[tuple[str, int], tuple[int, int]] = {}
        self.period = self.daemons_period = 0
        self.driven = 0
        self.came = dict.fromkeys(SILENT_MS, 0)

    def _heard(self, data: bytes) -> bytes:
        frame = self._carried(DOWN, data)
        if frame is data and data[1] == FUNCTION[Drive]:
            body = cobs_decode(data[:-1])
            if body is not None and body[MODE_AT] == DriveMode.RUN:
                self.driven = self.period
        return frame

    def _carried(self, direction: str, frame: bytes) -> bytes:
        function = frame[1]  # COBS puts a code before it that never equals the function
        for kind in (function, 0) if self.spells else ():
            left, bit = self.spells.pop((direction, kind), (0, 0))
            if left > 1:
                self.spells[direction, kind] = (left - 1, bit)
            if left:
                at = bit // 8 % len(frame)
                return frame[:at] + bytes((frame[at] ^ 1 << bit % 8,)) + frame[at + 1 :] if bit else b""
        if direction == UP and function in self.came:
            self.came[function] = self.daemons_period
        return frame


NEAR_HOME = standing(load_plant("sample_1"), 47.2, 47.0)


@cache
def rare_plans() -> Core:
    """A core that plans as seldom as is allowed, because time here is ticks."""
    config = Config()
    return build_core(msgspec.structs.replace(config, rates=msgspec.structs.replace(config.rates, inference_hz=100)))


class Together(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        core = rare_plans()
        device = VirtualDevice(NEAR_HOME, SteadyHand(), [], 1, boot=CompiledFirmware)
        self.loop = ClosedLoop(core.config, core.stepper(), core.planner(), device)
        self.line = BadLine(device)
        self.loop.port.device = self.line
        self.struck: set[str] = set()
        self.force_N, self.is_armed = 1.1, False
        self.firmware, self.mode = device.messages.firmware, DeviceMode.IDLE
        # in periods: when the daemon last drove, asked for each request, and reset the device
        self.undriven = self.reset = self.hangs_until = 0
        self.asked = dict.fromkeys(DeviceRequest, 0)
        self.open_by, self.was_held = 0.0, False

    @initialize(is_armed=st.sampled_from([True, True, True, False]), force_N=st.sampled_from([0.95, 1.1, 1.3]))
    def begin(self, is_armed: bool, force_N: float) -> None:
        self.force_N = force_N
        if is_armed:
            self.lead_out()
            self.run(CLOSING_MS)

    @rule(ms=MS)
    def go_on(self, ms: int) -> None:
        self.run(ms)

    @rule(name=st.sampled_from(OPERATED), ms=MS)
    def operate(self, name: str, ms: int) -> None:
        self.give(name)
        self.run(ms)

    @rule(
        stream=st.sampled_from(STREAMS),
        count=FRAMES,
        bit=st.sampled_from([0, 0, 1, 37, 62]),
        ms=MS,
    )
    def lose_or_damage(self, stream: tuple[str, int], count: int, bit: int, ms: int) -> None:
        self.line.spells[stream] = (count, bit)
        self.run(ms)

    @precondition(lambda self: self.is_armed)
    @rule(function=st.sampled_from(sorted(SILENT_MS)))
    def fall_silent(self, function: int) -> None:
        self.line.spells[UP, function] = (200, 0)
        self.run(120)

    @precondition(lambda self: self.is_armed)
    @rule(name=st.sampled_from(["pause", "disable", "stop"]), ms=MS)
    def let_go(self, name: str, ms: int) -> None:
        self.give(name)
        self.run(ms)

    @rule(ms=st.sampled_from([5, 45, 49, 60, 120, 1_500]), then_ms=MS)
    def stall(self, ms: int, then_ms: int) -> None:
        self.run(ms, is_away=True)
        self.run(then_ms)

    @rule(fault=st.sampled_from(FAULTS), ms=MS)
    def go_wrong(self, fault: str, ms: int) -> None:
        self.struck.add(fault)
        if fault == "frozen":
            self.hangs_until = self.line.period + FROZEN_MS
        self.loop.simulated._faults.append(parse_fault(f"{fault}@{self.loop.now_s:.6f}"))
        self.run(ms)

    @precondition(lambda self: self.struck)
    @rule(ms=MS)
    def mend(self, ms: int) -> None:
        self.put_right()
        self.run(ms)

    @precondition(lambda self: not self.is_armed)
    @rule()
    def arm(self) -> None:
        self.follow(Arming(self.loop.now_s, self.loop.stepper.safety.faults), self.loop.now_s + 2.0)
        self.run(CLOSING_MS)

    def teardown(self) -> None:
        if self.line.period:
            self.lead_out()

    def put_right(self) -> None:
        self.loop.simulated.mend()
        self.struck.clear()
        self.line.spells.clear()

    def lead_out(self) -> None:
        """Check that the documented commands lead to ENABLED once the cause is gone."""
        self.put_right()
        faults, until_s, said = self.loop.stepper.safety.faults, self.loop.now_s + PATIENCE_S, list[str]()
        while not self.is_armed or not self.stays_armed():
            arming = Arming(self.loop.now_s, self.loop.stepper.safety.faults)
            self.follow(arming, until_s)
            said.append(f"{', '.join(arming.given)}: {arming.refusal or 'taken'}")
            assert self.loop.now_s < until_s, f"no way out of {faults}: {said[-3:]}"

    def stays_armed(self) -> bool:
        if self.loop.stepper.safety.operating_state is OperatingState.PAUSED:
            return False
        self.run(SETTLED_MS)
        return self.is_armed

    def follow(self, arming: Arming, until_s: float) -> None:
        while not arming.is_over and self.loop.now_s < until_s:
            arming.advance(self.loop.now_s, self.loop.stepper.safety, self.loop.conditions(), self.give_strictly)
            self.run(1)

    def give(self, name: str) -> None:
        try:
            self.give_strictly(name)
        except RefusedError as error:
            event(f"{name}: {error.code}")

    def give_strictly(self, name: str) -> None:
        self.loop.command(name)
        self.is_armed = self.is_armed or name == "enable"

    def run(self, ms: int, *, is_away: bool = False) -> None:
        for _ in range(ms):
            if is_away:
                self.loop.skip()
            else:
                now_s = self.loop.now_s
                self.loop.tick(TimedSetpoint(self.force_N, now_s - now_s % 0.01, 0.1))
            self.judge(is_away)

    def judge(self, is_away: bool) -> None:
        safety, firmware, line = self.loop.stepper.safety, self.loop.simulated.firmware, self.line
        before, self.mode = self.mode, firmware.mode
        line.period += 1
        line.daemons_period += not is_away
        if firmware is not self.firmware:
            self.firmware, before, self.reset = firmware, DeviceMode.IDLE, line.period
        if safety.is_driven:
            self.undriven = line.period
        self.asked[safety.request] = line.period
        self.is_armed = self.is_armed and safety.is_driven
        assert safety.is_driven == self.is_armed, f"driven, and not armed: {safety}"
        if line.period > self.hangs_until:
            self.judge_device(before)
            self.judge_gap()
        if self.is_armed and not is_away:
            for function, longest_ms in SILENT_MS.items():
                silent_ms = line.daemons_period - line.came[function]
                assert silent_ms <= longest_ms, f"driven {silent_ms} ms after the last of function {function}"

    def judge_device(self, before: DeviceMode) -> None:
        """It runs, homes or clears a fault only for a daemon that asks for it."""
        now, mode = self.line.period, self.mode
        if mode is DeviceMode.RUN:
            most_ms = TIMEOUT_MS / (SLOWEST if "clock=-30%" in self.struck else 1.0)
            since_ms = now - self.undriven
            assert since_ms <= most_ms, f"RUN {since_ms} ms after the daemon: {self.loop.stepper.safety}"
            assert now - self.line.driven <= most_ms, f"RUN {now - self.line.driven} ms after the last Drive"
        elif mode is not before and (request := ASKED.get(mode if mode is DeviceMode.HOMING else (before, mode))):
            since_ms = now - self.asked[request]
            assert since_ms <= ASKED_MS, f"{before.name} to {mode.name} {since_ms} ms after {request} was asked"

    def judge_gap(self) -> None:
        gap_mm, now = self.loop.simulated.truth.gap_mm, self.line.period
        is_deaf = self.mode in RESTS and not self.struck.isdisjoint(DEAF)
        is_over = self.mode is DeviceMode.RUN or gap_mm > OPENED_MM
        is_held = HELD & self.firmware.faults or not self.struck.isdisjoint(HINDERING)
        self.was_held = not is_over and (self.was_held or bool(is_held))
        if is_over or is_deaf or self.was_held:
            self.open_by = 0.0
            return
        if not self.open_by:
            self.open_by = now + ((OPEN_MM - gap_mm) / 2.0 / UNHOMED_MM_S * 1e3 + TURNED_MS) / SLOWEST
        assert now <= max(self.open_by, self.reset + RECONNECTED_MS), f"{gap_mm:.1f} mm, not open in time: {self.mode}"


@pytest.mark.long
@pytest.mark.usefixtures("library")
def test_whatever_happens_to_both_nothing_moves_unarmed_and_every_fault_has_a_way_out() -> None:
    run_state_machine_as_test(
        Together, settings=settings(max_examples=settings().max_examples // 6, stateful_step_count=25)
    )
