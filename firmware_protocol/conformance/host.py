"""The host of one device: it keeps the rhythm, records messages, and brings the device to where a check begins.

A device that does not follow ends the check with `Unmet`.
"""

import math
import random
from array import array
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from itertools import dropwhile
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar, cast

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DecodeError,
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
    decode,
    encode,
)
from firmware_protocol.conformance.line import Line
from firmware_protocol.conformance.rules import NEVER_FOLLOWS

PERIOD_S, STATUS_S, FRESH_S, REPEAT_S = 1e-3, 0.02, 5e-3, 0.05
"A command that is not acknowledged is sent again after REPEAT_S."
ANSWER_S, SEEN_S, ACKNOWLEDGED_S = 0.02, 0.065, 0.5
"""An immediate answer has arrived by ANSWER_S, on any carrier that the position loop can use. Three Status come in
SEEN_S: one of them shows the present state, even where one is lost."""
OPENED_S, HOMED_S, HOMES_S, MOVED_S = 10.0, 12.0, 0.75, 2.0
"HOMED_S is what the daemon allows a homing, none ends before HOMES_S; a motion may take MOVED_S more."
HELLO_NONCE, MAX_NONCE = 255, 254
INSIDE_MM, ARRIVED_MM, DUTY_PER_MM, TRAVEL_MM_S = 2.0, 0.3, 3.0, 8.0
OPENING_MM_S, STROKE_MM, SWITCH_MM = 15.0, 25.25, 0.35
"A switch may close SWITCH_MM from its place, while a carriage passes it at any speed."
BRAKED, LEAP_C, LATE_DRIVES, AHEAD_S = 3, 10.0, 100, 5e-3
"BRAKED Status come in 50 ms of braking; a State may overtake a Status by AHEAD_S."
ENDS: Final = Switches.LEFT_OPEN, Switches.RIGHT_OPEN, Switches.LEFT_CLOSED, Switches.RIGHT_CLOSED
OPEN, CLOSED = ENDS[0] | ENDS[1], ENDS[2] | ENDS[3]
NO_FAULT: Final = DeviceFault(0)
COLUMNS: Final = (
    *("asked_s", "left_duty", "right_duty", "arrived_s", "device_time_s", "counter", "left_mm", "right_mm"),
    *("left_A", "right_A", "force_N", "handle_mm"),
)
"A row of `Host.rows` is a Drive with its State and Sense."
STALLED_S: Final = 0.005
"From this lateness on this process may be to blame for a failed check."

M = TypeVar("M", bound=Message)
Command = type[Retract] | type[Clear] | type[Home]
LEADS_TO: Final = {Retract: DeviceMode.RETRACTING, Clear: DeviceMode.IDLE, Home: DeviceMode.HOMING}
"The mode in the first Status that shows a command."


class Unmet(Exception):  # noqa: N818  (what a device leaves unmet; nothing has gone wrong here)
    """The device does not do what the protocol page says; the text is what was seen."""


class Untested(Exception):  # noqa: N818  (nothing has gone wrong here either)
    """A rule cannot be tested here; the text says why, and what would help."""


def unless(is_wrong: object, seen: str) -> str:
    """Return `seen`, or raise Unmet with it if `is_wrong`."""
    if is_wrong:
        raise Unmet(seen)
    return seen


Beat: TypeAlias = DriveMode | None
"The Drive that is sent every millisecond, or none."


class Heard(NamedTuple):
    time_s: float
    message: Message


class Host:
    def __init__(
        self,
        line: Line,
        *,
        opening_mm_s: float = OPENING_MM_S,
        stroke_mm: float = STROKE_MM,
        reset: Callable[[str], None] | None = None,
        ask: Callable[[str], object] = lambda what: None,
    ) -> None:
        self.line, self.reset, self.ask = line, reset, ask
        self.opening_mm_s, self.stroke_mm = opening_mm_s, stroke_mm
        self.random = random.Random(41)
        self.heard: list[Heard] = []
        self.newest: dict[type[object], Heard] = {}
        self.refused = Counter[str]()
        """What was wrong with whole frames that held no message of a device, and how often."""
        self.contradictions = Counter[str]()
        self.rows = array("d")
        """A row of COLUMNS for each Sense."""
        self.marks = array("d")
        """For each Status the rows before it, and its mode."""
        self._asked = deque[tuple[float, ...]](maxlen=999)
        self.counters = deque[int](maxlen=LATE_DRIVES)
        self.nonces: list[int] = []
        """The one Status showed last, and those sent since."""
        self._unpaired = deque[tuple[float, ...]](maxlen=99)
        self._answers_s = deque[float](maxlen=LATE_DRIVES)
        """When the newest States came."""
        self._opens = 0
        self.drives = self.states = self.senses = 0
        """How many Drives that must be answered were sent, and how many State came."""
        self.drive_s = self._next_s = line.port.now_s()
        self.counter, self.said = 0, Drive(0.0, 0.0, DriveMode.OFF, 0)
        self.stalled_s = self.late_s = 0.0
        """This process's greatest lateness since `begin`, and at all."""

    @property
    def now_s(self) -> float:
        return self.line.port.now_s()

    # -- what is sent ------------------------------------------------------------------------------------------------

    def send(self, message: Message) -> None:
        self.nonces += [message.nonce] if isinstance(message, Retract | Clear | Home | Hello) else []
        self.line.send(FUNCTION[type(message)], encode(message))

    def drive(self, mode: DriveMode, left: float = 0.0, right: float = 0.0) -> None:
        self.counter = (self.counter + 1) % 256
        self.drives += 1
        self.drive_s = self.now_s
        self.said = Drive(left, right, mode, self.counter)
        self._asked.append((self.drive_s, left, right))
        self.counters.append(self.counter)
        self.send(self.said)

    def send_beside(self, message: Message) -> None:
        """Send a message, and the Drive before it again."""
        self.send(message)
        self.send(self.said)

    def hello(
        self,
        schema_hash: int = SCHEMA_HASH,
        version: int = PROTOCOL_VERSION,
        nonce: int = HELLO_NONCE,
        beat: Beat = None,
    ) -> None:
        """Send one Hello, and wait for its answer."""
        self.send(Hello(schema_hash, version, nonce))
        self.pass_time(ANSWER_S, beat)

    def new_nonce(self) -> int:
        return self.random.choice([nonce for nonce in range(1, MAX_NONCE + 1) if nonce != self.status.command_nonce])

    def command(
        self,
        kind: Command,
        beat: Beat = DriveMode.OFF,
        limit_s: float = ACKNOWLEDGED_S,
        nonce: int = 0,
        duty: float = 0.0,
    ) -> bool:
        """Repeat a command until a Status acknowledges it; return whether one did within `limit_s`."""
        nonce = nonce or self.new_nonce()
        start_s = due_s = self._next_s
        while self.status.command_nonce != nonce:
            if self._next_s - start_s >= limit_s:
                return False
            is_due = self._next_s >= due_s
            due_s += REPEAT_S * is_due
            self.beat(beat, duty, duty, besides=partial(self.send_beside, kind(nonce)) if is_due else lambda: None)
        return True

    def obeyed(self, kind: Command, beat: Beat = DriveMode.OFF, nonce: int = 0, duty: float = 0.0) -> None:
        before, is_shown = len(self.all_of(Status)), self.command(kind, beat, REPEAT_S, nonce, duty)
        unless(not is_shown, f"{kind.__name__} not acknowledged before its repetition: {shown(self.status)}")
        to, nonce = LEADS_TO[kind], self.status.command_nonce
        came = next(each for _, each in self.all_of(Status)[before:] if each.command_nonce == nonce or each.mode is to)
        unless(came.mode is not to or came.command_nonce != nonce, f"{kind.__name__} acknowledged with {shown(came)}")

    def beat(
        self,
        beat: Beat,
        left: float = 0.0,
        right: float = 0.0,
        period_s: float = PERIOD_S,
        besides: Callable[[], object] = lambda: None,
    ) -> None:
        """Send a Drive, or none, and another message `besides`; then listen."""
        if beat is not None:
            self.drive(beat, left, right)
        besides()
        times = max(round(period_s / PERIOD_S), 1)
        for _ in range(times):
            self._listen(period_s / times)

    def pass_time(self, seconds: float, beat: Beat = None, period_s: float = PERIOD_S, duty: float = 0.0) -> None:
        """Repeat `beat` for a time, with `duty` for both motors."""
        for _ in range(round(seconds / period_s)):
            self.beat(beat, duty, duty, period_s)

    def until(self, reached: Callable[[], bool], limit_s: float, beat: Beat = DriveMode.OFF) -> bool:
        """Repeat `beat` until `reached()` or for `limit_s`; return whether it was reached."""
        end_s = self._next_s + limit_s
        while not reached():
            if self._next_s >= end_s:
                return False
            self.beat(beat)
        return True

    # -- what came ---------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Let answers arrive, forget what was heard and the lateness, and restart the rhythm."""
        self.pass_time(ANSWER_S)
        for known in (self.heard, self._asked, self._unpaired):
            known.clear()
        self.stalled_s, self._next_s = 0.0, self.now_s

    def all_of(self, kind: type[M]) -> list[tuple[float, M]]:
        return [(heard.time_s, heard.message) for heard in self.heard if isinstance(heard.message, kind)]

    def last(self, kind: type[M]) -> M:
        unless(kind not in self.newest, f"no {kind.__name__} ever came")
        return cast("M", self.newest[kind].message)

    @property
    def status(self) -> Status:
        self.until(lambda: Status in self.newest, 10 * STATUS_S, None)
        return self.last(Status)

    def next_status(self, beat: Beat) -> Status:
        """Wait for a Status that comes from now on."""
        before = self.newest.get(Status)
        unless(
            not self.until(lambda: self.newest.get(Status) is not before, 5 * STATUS_S, beat),
            f"no Status for {5 * STATUS_S * 1e3:.0f} ms",
        )
        return self.last(Status)

    def shows(
        self,
        mode: DeviceMode,
        beat: Beat = DriveMode.OFF,
        *,
        homed: bool | None = None,
        opened: bool | None = None,
        fault: DeviceFault | None = None,
        besides: str = "",
        wrong: object = False,
    ) -> str:
        """Return in words what the next Status shows, after `besides`."""
        status = self.next_status(beat)
        is_right = (
            status.mode is mode
            and homed in (None, is_homed(status))
            and opened in (None, is_open(status))
            and fault in (None, status.faults)
        )
        return unless(wrong or not is_right, f"{besides}, {shown(status)}" if besides else shown(status))

    def _listen(self, period_s: float) -> None:
        """Take what comes in a period, and note this process's lateness."""
        self._next_s += period_s
        for time_s, function, payload in self.line.receive(self._next_s):
            try:
                message = decode(function, payload)
            except DecodeError as error:
                self.refused[f"{error.name or f'function {function}'}: {error.check}"] += 1
                continue
            if isinstance(message, State | Sense | Status | Identity):
                self._take(Heard(time_s, message))
            else:
                self.refused[f"{type(message).__name__}: a host's message"] += 1
        late_s = self.now_s - self._next_s
        if late_s > PERIOD_S:  # missed beats are not made up for by a burst
            self.stalled_s, self.late_s = max(self.stalled_s, late_s), max(self.late_s, late_s)
            self._next_s += late_s

    def _take(self, heard: Heard) -> None:
        """Keep a message, and count the resets and contradictions that a Status shows."""
        message = heard.message
        if isinstance(message, State):
            self.contradictions["a State's counter not one more"] += (
                State in self.newest and (message.counter - self.last(State).counter) % 256 != 1
            )
            self.states += 1
            asked = self._asked.popleft() if self._asked else (self.drive_s, math.nan, math.nan)
            self._answers_s.append(heard.time_s)
            self._unpaired.append((*asked, heard.time_s, message.device_time_s, message.counter, *places(message)))
        self.senses += isinstance(message, Sense)
        if isinstance(message, Sense) and self._unpaired:  # on a bus a later State may have overtaken it
            sensed = message.left_current_A, message.right_current_A, message.force_N, message.handle_position_mm
            self.rows.extend((*self._unpaired.popleft(), *sensed))
        if isinstance(message, Identity):
            self.contradictions["another Identity"] += message != self.newest.get(Identity, heard).message
        if isinstance(message, Status):
            self._compare(self.newest.get(Status, heard).message, message, heard.time_s)
            self.contradictions.update([*contradictions(message), *self._misplaced(heard.time_s, message)])
            self.marks.extend((len(self.rows) / len(COLUMNS), message.mode))
        self.heard.append(heard)
        self.newest[type(message)] = heard

    def _compare(self, before: Any, after: Status, time_s: float) -> None:
        """Count what in a Status cannot follow the one before."""
        self._opens = (self._opens + 1) * is_open(after)
        ahead = sum(answer_s > time_s - AHEAD_S for answer_s in self._answers_s)
        is_same, recent = before.mode is after.mode, [*self.counters][-len(self._asked) - ahead - 1 :]
        found = {
            "at rest without braking": before.mode is DeviceMode.RETRACTING
            and not is_same
            and 0 < self._opens < BRAKED,
            "drive_counter not of the last Drive": len(self.counters) == LATE_DRIVES
            and after.drive_counter not in recent,
            "nonce 0 again: a reset": before.command_nonce > after.command_nonce == 0,
            "a nonce not sent since the one before": Status in self.newest and after.command_nonce not in self.nonces,
            f"{before.mode.name} then {after.mode.name}": after.mode.name in NEVER_FOLLOWS.get(before.mode.name, ()),
            f"HOMED leaps in {after.mode.name}": is_same and is_homed(before) is not is_homed(after),
            f"a fault ends in {after.mode.name}": is_same and before.faults & ~after.faults,
            "the temperature leaps": abs(after.temperature_C - before.temperature_C) > LEAP_C,
        }
        self.contradictions.update(what for what, is_so in found.items() if is_so)
        self.nonces = [*dropwhile(lambda nonce: nonce != after.command_nonce, self.nonces)] or [after.command_nonce]

    def _misplaced(self, time_s: float, status: Status) -> list[str]:
        """Return the end switches in a Status that do not fit the State just before it."""
        is_usable = {State, Status} <= self.newest.keys() and is_homed(self.last(Status)) and is_homed(status)
        if not is_usable or time_s - self.newest[State].time_s > FRESH_S:
            return []
        left_mm, right_mm = places(self.last(State))
        beyond_mm = (left_mm, right_mm, -self.stroke_mm - left_mm, -self.stroke_mm - right_mm)
        signs = [-1.0 if each in status.switches else 1.0 for each in ENDS]
        return [
            f"{each.name} {'not closed' if sign > 0.0 else 'closed'} at {mm:+.1f} mm beyond it"
            for each, sign, mm in zip(ENDS, signs, beyond_mm, strict=True)
            if sign * mm > SWITCH_MM
        ]

    # -- where a check begins ----------------------------------------------------------------------------------------

    def idle(self) -> None:
        self.pass_time(SEEN_S, DriveMode.OFF)
        if Identity not in self.newest or DeviceFault.SCHEMA_MISMATCH in self.status.faults:
            self.hello()
        unless(not self.until(self.is_resting, HOMED_S), f"not at rest after {HOMED_S:g} s: {shown(self.status)}")
        if self.status.mode is DeviceMode.LATCHED:
            self.obeyed(Clear)
        self.shows(DeviceMode.IDLE, fault=NO_FAULT, besides="after Hello, Drive OFF and Clear")

    def without_zero(self) -> None:
        """Take the device's zero away by a mismatched Hello, and bring it to IDLE."""
        self.hello(SCHEMA_HASH ^ 1)
        self.idle()

    def homed(self) -> None:
        self.idle()
        if not is_homed(self.status):
            self.home()
        if not is_open(self.status):
            self.obeyed(Retract)
            self.until(self.is_resting, OPENED_S)
        self.shows(DeviceMode.IDLE, homed=True, opened=True, besides="after Home and Retract")

    def home(self, beat: Beat = DriveMode.OFF) -> float:
        """Home an idle device; return how long it took."""
        start_s = self._next_s
        self.obeyed(Home, beat)
        self.until(lambda: self.status.mode is not DeviceMode.HOMING, HOMED_S, beat)
        seconds = self._next_s - start_s
        self.pass_time(SEEN_S, beat)
        return seconds

    def running(self, inside_mm: float = 0.0, askew_mm: float = 0.0) -> None:
        self.homed()
        self.pass_time(2 * PERIOD_S, DriveMode.OFF)
        unless(
            not self.until(lambda: self.status.mode is DeviceMode.RUN, SEEN_S, DriveMode.RUN),
            f"Drive RUN does not lead to RUN: {shown(self.status)}",
        )
        if inside_mm > 0.0:
            self.bring(-inside_mm, askew_mm - inside_mm)
            self.pass_time(SEEN_S, DriveMode.RUN)

    def bring(
        self, left_mm: float, right_mm: float, *, mm_s: float = TRAVEL_MM_S, ends: Callable[[], bool] = lambda: False
    ) -> None:
        goals = left_mm, right_mm
        targets: tuple[float, ...] = places(self.last(State))
        end_s = self._next_s + max(map(abs, ways_mm(self.last(State), goals))) / mm_s + MOVED_S
        step_mm = mm_s * PERIOD_S
        while not ends():
            at_mm = places(self.last(State))
            if max(map(abs, ways_mm(self.last(State), goals))) < ARRIVED_MM:
                return
            targets = tuple(at + clamped(goal - at, step_mm) for at, goal in zip(targets, goals, strict=True))
            left, right = (clamped(DUTY_PER_MM * (to - at), 1.0) for to, at in zip(targets, at_mm, strict=True))
            self.beat(DriveMode.RUN, left, right)
            is_off = not ends() and (self.status.mode is not DeviceMode.RUN or self._next_s > end_s)
            unless(is_off, f"on the way to {goals} mm: {positions(self.last(State))}, {shown(self.status)}")

    def answered(self, beat: Beat, left: float = 0.0, right: float = 0.0) -> State:
        """Send a Drive, and return its State."""
        before = self.newest.get(State)
        self.beat(beat, left, right)
        unless(
            not self.until(lambda: self.newest.get(State) is not before, ANSWER_S, None),
            f"no State: {shown(self.status)}",
        )
        return self.last(State)

    def timed_out(self, inside_mm: float = INSIDE_MM) -> None:
        self.running(inside_mm)
        self.pass_time(0.1)

    def latched(self) -> None:
        """Bring the device to LATCHED with COMMAND_TIMEOUT."""
        self.timed_out()
        self.until(self.is_resting, OPENED_S, None)
        self.shows(DeviceMode.LATCHED, None, fault=DeviceFault.COMMAND_TIMEOUT, besides="after silence")

    def is_resting(self) -> bool:
        """Whether the newest Status shows the drives off."""
        return self.status.mode in (DeviceMode.IDLE, DeviceMode.LATCHED)


def is_homed(status: Status) -> bool:
    return Switches.HOMED in status.switches


def is_open(status: Status) -> bool:
    return OPEN in status.switches


def shown(status: Status) -> str:
    faults = "|".join(fault.name or "" for fault in DeviceFault if fault in status.faults) or "no fault"
    switches = "|".join(switch.name or "" for switch in Switches if switch in status.switches) or "no switch"
    return f"{status.mode.name}, {faults}, {switches}, nonce {status.command_nonce}"


def places(state: State) -> tuple[float, float]:
    return state.left_position_mm, state.right_position_mm


def ways_mm(state: State, since: tuple[float, float]) -> list[float]:
    return [at - began for at, began in zip(places(state), since, strict=True)]


def clamped(value: float, most: float) -> float:
    return min(max(value, -most), most)


def positions(state: State) -> str:
    return f"left {state.left_position_mm:+.2f} mm, right {state.right_position_mm:+.2f} mm"


def contradictions(status: Status) -> list[str]:
    """Return in words what in one Status cannot be true together."""
    mode, switches = status.mode, status.switches
    unwatched = {DeviceMode.RETRACTING: DeviceFault.SUPPLY | DeviceFault.TEMPERATURE}.get(
        mode, NO_FAULT
    ) | status.faults
    found = {
        f"{status.supply_V:.1f} V while {mode.name}": not (9.0 <= status.supply_V <= 15.0)
        and DeviceFault.SUPPLY not in unwatched,
        f"{status.temperature_C:.0f} degC while {mode.name}": not (-20.0 <= status.temperature_C <= 60.0)
        and DeviceFault.TEMPERATURE not in unwatched,
        "LEFT_OPEN with LEFT_CLOSED": (Switches.LEFT_OPEN | Switches.LEFT_CLOSED) in switches,
        "RIGHT_OPEN with RIGHT_CLOSED": (Switches.RIGHT_OPEN | Switches.RIGHT_CLOSED) in switches,
        f"HOMED while {mode.name}": is_homed(status) and mode in (DeviceMode.HOMING, DeviceMode.LATCHED),
        "RUN at a closed switch": mode is DeviceMode.RUN and bool(switches & CLOSED),
        "LATCHED without a fault": mode is DeviceMode.LATCHED and not status.faults,
        "HOMED in IDLE and not open": mode is DeviceMode.IDLE and is_homed(status) and not is_open(status),
        f"a fault while {mode.name}": status.faults and mode in (DeviceMode.IDLE, DeviceMode.RUN),
    }
    return [what for what, is_so in found.items() if is_so]
