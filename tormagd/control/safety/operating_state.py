"""The operating state: armed on purpose, opened on every fault, never re-armed by itself.

One table, TRANSITIONS, says where each event leads, what guards it and what the device is then asked for; nothing else
changes the state. The safe state is *gap open*: friction holds the force when power goes, and the magnets pull shut.
Opening is the device's own routine, because it must also work when this process is gone. All functions are pure.
"""

import math
from collections.abc import Callable
from enum import StrEnum
from typing import Final, NamedTuple, final

from firmware_protocol.value import Value
from tormagd.control.safety.codes import FAULTS, Fault, Position
from tormagd.hardware.measurement import DeviceRequest

CLEARING_S = 0.5
"How long the device may take to report that a cleared fault is gone."
LOST_POSITION = frozenset({fault for fault, row in FAULTS.items() if row.position is Position.LOST_HERE})
"The device goes on calling itself homed, but an encoder's counts are not believed any more."


class OperatingState(StrEnum):
    DISABLED = "DISABLED"
    "The gap is open or on its way there, and nothing is driven from here."
    ENABLED = "ENABLED"
    PAUSED = "PAUSED"
    "The gap is held where it is; a force over the ceiling opens it."
    FAULT = "FAULT"
    "As DISABLED, with one fault or more latched."


class Event(StrEnum):
    ENABLE = "enable"
    DISABLE = "disable"
    PAUSE = "pause"
    RESUME = "resume"
    HOME = "home"
    STOP = "stop"
    CLEAR_FAULT = "clear-fault"
    USE_SCENE = "use-scene"
    FAULT = "a fault shows"


class RefusedError(Exception):
    """A command that is refused: `code` names the reason, `message` says it, `hint` what to do."""

    def __init__(self, code: str, message: str, hint: str) -> None:
        super().__init__(message)
        self.code, self.message, self.hint = code, message, hint


@final
class Conditions(Value):
    def __init__(
        self,
        connected: bool,
        fresh: bool,
        homed: bool,
        busy: bool,
        device_latched: bool,
        sensor_doubted: bool = False,
        cause: str = "",
        remedy: str = "",
        round_trip_s: float = 0.0,
        clock_drift: float = 0.0,
        apart_mm: float = 0.0,
        most_apart_mm: float = math.inf,
        most_round_trip_s: float = math.inf,
        most_clock_drift: float = math.inf,
    ) -> None:
        self.connected: Final = connected
        self.fresh: Final = fresh
        self.homed: Final = homed
        self.busy: Final = busy
        self.device_latched: Final = device_latched
        self.sensor_doubted: Final = sensor_doubted
        self.cause: Final = cause
        "Why the device is not connected, or its measurements not fresh."
        self.remedy: Final = remedy
        self.round_trip_s: Final = round_trip_s
        self.clock_drift: Final = clock_drift
        self.apart_mm: Final = apart_mm
        self.most_apart_mm: Final = most_apart_mm
        self.most_round_trip_s: Final = most_round_trip_s
        self.most_clock_drift: Final = most_clock_drift


@final
class SafetyState(Value):
    """Operating state, latched faults, and the newest request to the device."""

    def __init__(
        self,
        operating_state: OperatingState = OperatingState.DISABLED,
        faults: tuple[Fault, ...] = (),
        request: DeviceRequest = DeviceRequest.NONE,
        request_number: int = 0,
        clearing_until_s: float = -math.inf,
        needs_homing: bool = False,
    ) -> None:
        self.operating_state: Final = operating_state
        self.faults: Final = faults
        self.request: Final = request
        self.request_number: Final = request_number
        self.clearing_until_s: Final = clearing_until_s
        self.needs_homing: Final = needs_homing

    @property
    def is_driven(self) -> bool:
        return self.operating_state is OperatingState.ENABLED or self.operating_state is OperatingState.PAUSED

    def ask(self, request: DeviceRequest) -> "SafetyState":
        """Return this state with a new request to the device, under the next number."""
        return self.replaced(request=request, request_number=self.request_number + 1)


Refuses = Callable[[SafetyState, Conditions], str]
"Returns what is wrong, with the figures; empty where nothing is."


class Guard(NamedTuple):
    """A condition of a transition. Where it does not hold, the event is refused with `code`."""

    code: str
    wants: str
    "The condition in words, for docs/states.md."
    refuses: Refuses
    remedy: str


class Transition(NamedTuple):
    event: Event
    source: OperatingState
    target: OperatingState
    reason: str
    "What the log says."
    guards: tuple[Guard, ...] = ()
    "The first that does not hold is told."
    request: DeviceRequest = DeviceRequest.NONE


class Refusal(NamedTuple):
    event: Event
    source: OperatingState
    code: str
    remedy: str


def _not_connected(state: SafetyState, present: Conditions) -> str:
    return "" if present.connected else f"the device is not connected{_because(present)}"


def _latched(state: SafetyState, present: Conditions) -> str:
    return "the device has latched a fault" if present.device_latched else ""


def _busy(state: SafetyState, present: Conditions) -> str:
    return "the device homes or opens, or is not ready" if present.busy else ""


def _lost(state: SafetyState, present: Conditions) -> str:
    return "a fault took the carriages' positions away" if state.needs_homing else ""


def _unhomed(state: SafetyState, present: Conditions) -> str:
    return "" if present.homed else "the carriages are not homed"


def _stale(state: SafetyState, present: Conditions) -> str:
    return "" if present.fresh else f"no fresh measurement from the device{_because(present)}"


def _doubted(state: SafetyState, present: Conditions) -> str:
    return "the force sensor reads what no believable device gives with its gap open" if present.sensor_doubted else ""


def _apart(state: SafetyState, present: Conditions) -> str:
    if present.apart_mm <= present.most_apart_mm:
        return ""
    return f"the carriages are {present.apart_mm:.2f} mm apart: allowed is at most {present.most_apart_mm:g} mm"


def _slow(state: SafetyState, present: Conditions) -> str:
    if present.round_trip_s <= present.most_round_trip_s:
        return ""
    return (
        f"the round trip to the device is {present.round_trip_s * 1e3:.1f} ms: allowed is at most "
        f"{present.most_round_trip_s * 1e3:.1f} ms, or the carriages swing"
    )


def _wrong_clock(state: SafetyState, present: Conditions) -> str:
    if abs(present.clock_drift) <= present.most_clock_drift:
        return ""
    return f"the device's clock is off by {present.clock_drift:+.1%}: allowed is {present.most_clock_drift:.0%}"


def _because(present: Conditions) -> str:
    return f": {present.cause}" if present.cause else ""


ARM: Final = "tormagctl arm"
"The hint of a command that wishes for force; no other command hints at it."
CLEAR: Final = "tormagctl clear-fault"
CONNECTED = Guard("not_connected", "the device is connected", _not_connected, "check port, cable and supply")
NOT_BUSY = Guard(
    "busy",
    "the device neither homes nor opens, and its calibration is loaded",
    _busy,
    "wait until is_busy is false",
)
NOT_LATCHED = Guard("device_latched", "the device has latched no fault", _latched, CLEAR)
READY: tuple[Guard, ...] = (
    CONNECTED,
    NOT_LATCHED._replace(remedy=ARM),
    NOT_BUSY,
    Guard("not_homed", "it has homed since a fault last lost its position", _lost, ARM),
    Guard("not_homed", "the device is homed", _unhomed, ARM),
    Guard("not_fresh", "State, Sense and Status are fresh", _stale, "check the link in tormagctl status"),
    Guard(
        "sensor_doubted",
        "the force sensor is believed",
        _doubted,
        "check sensor, cable and zero, then turn the handle for a second",
    ),
    Guard("skewed", "the carriages are at most `limits.skew_fault_mm` apart", _apart, "tormagctl home"),
    Guard(
        "link_degraded",
        "the position loop bears the round trip",
        _slow,
        "check the round trip in tormagctl firmware, and a USB adapter's latency timer in tormagctl doctor",
    ),
    Guard(
        "clock",
        "the device's clock is not off enough for the fault CLOCK",
        _wrong_clock,
        "check the firmware's timer and clock source",
    ),
)
"What must hold before anything is driven."

DISABLED: Final = OperatingState.DISABLED
ENABLED: Final = OperatingState.ENABLED
PAUSED: Final = OperatingState.PAUSED
FAULTED: Final = OperatingState.FAULT
RETRACT: Final = DeviceRequest.RETRACT
NOTHING_TO_DO: Final = "nothing to do"

_OPENS = "the device is asked to open the gap"
_CLEARED = "faults are cleared; nothing moves"
_UNLATCHED = "no fault is latched here, and the device's own is cleared; nothing moves"
ROWS: tuple[Transition | Refusal, ...] = (
    Transition(Event.ENABLE, DISABLED, ENABLED, "the force goes to the setpoint along a ramp", READY),
    Refusal(Event.ENABLE, ENABLED, "already_enabled", NOTHING_TO_DO),
    Refusal(Event.ENABLE, PAUSED, "already_enabled", "tormagctl resume"),
    Refusal(Event.ENABLE, FAULTED, "fault", ARM),
    Transition(Event.DISABLE, DISABLED, DISABLED, _OPENS, (CONNECTED,), RETRACT),
    Transition(Event.DISABLE, ENABLED, DISABLED, _OPENS, (CONNECTED,), RETRACT),
    Transition(Event.DISABLE, PAUSED, DISABLED, _OPENS, (CONNECTED,), RETRACT),
    Refusal(Event.DISABLE, FAULTED, "fault", CLEAR),
    Refusal(Event.PAUSE, DISABLED, "not_enabled", NOTHING_TO_DO),
    Transition(Event.PAUSE, ENABLED, PAUSED, "the gap is held where it is", (CONNECTED,)),
    Refusal(Event.PAUSE, PAUSED, "not_enabled", NOTHING_TO_DO),
    Refusal(Event.PAUSE, FAULTED, "fault", CLEAR),
    Refusal(Event.RESUME, DISABLED, "not_paused", ARM),
    Refusal(Event.RESUME, ENABLED, "not_paused", NOTHING_TO_DO),
    Transition(Event.RESUME, PAUSED, ENABLED, "the force goes to the setpoint along a ramp", (CONNECTED,)),
    Refusal(Event.RESUME, FAULTED, "fault", ARM),
    Transition(
        Event.HOME,
        DISABLED,
        DISABLED,
        "the device is asked to look for its open switches",
        (CONNECTED, NOT_LATCHED, NOT_BUSY),
        DeviceRequest.HOME,
    ),
    Refusal(Event.HOME, ENABLED, "not_disabled", "tormagctl disable"),
    Refusal(Event.HOME, PAUSED, "not_disabled", "tormagctl disable"),
    Refusal(Event.HOME, FAULTED, "fault", CLEAR),
    # stop is never refused, and needs no device: a device that comes back finds a fault that somebody has to clear
    *[Transition(Event.STOP, source, FAULTED, _OPENS, (), RETRACT) for source in OperatingState],
    # the daemon has latched nothing here; a device may hold what it latched while nobody was there
    Transition(Event.CLEAR_FAULT, DISABLED, DISABLED, _UNLATCHED, (CONNECTED, NOT_BUSY), DeviceRequest.CLEAR),
    # a fault that the device latches meanwhile is news, and must not be cleared unseen
    Transition(Event.CLEAR_FAULT, ENABLED, ENABLED, "there is nothing to clear", (CONNECTED, NOT_BUSY)),
    Transition(Event.CLEAR_FAULT, PAUSED, PAUSED, "there is nothing to clear", (CONNECTED, NOT_BUSY)),
    Transition(Event.CLEAR_FAULT, FAULTED, DISABLED, _CLEARED, (CONNECTED, NOT_BUSY), DeviceRequest.CLEAR),
    Transition(Event.USE_SCENE, DISABLED, DISABLED, "another scene takes the place of this one", (NOT_BUSY,)),
    Refusal(Event.USE_SCENE, ENABLED, "not_disabled", "tormagctl disable"),
    Refusal(Event.USE_SCENE, PAUSED, "not_disabled", "tormagctl disable"),
    Refusal(Event.USE_SCENE, FAULTED, "fault", CLEAR),
    *[Transition(Event.FAULT, source, FAULTED, _OPENS, (), RETRACT) for source in OperatingState],
)
TRANSITIONS: dict[tuple[Event, OperatingState], Transition | Refusal] = {(row.event, row.source): row for row in ROWS}
"A fault that is latched already is no event."
COMMANDS: tuple[str, ...] = tuple([str(event) for event in Event if event is not Event.FAULT])
_RANK: dict[Fault, int] = {fault: place for place, fault in enumerate(Fault)}


def latch(state: SafetyState, faults: tuple[Fault, ...]) -> SafetyState:
    """Return `state` in FAULT with the new `faults` latched and the device asked to open."""
    if not faults:
        return state
    new = [fault for fault in faults if fault not in state.faults]
    if not new:
        return state
    new.sort(key=_RANK.__getitem__)
    row = TRANSITIONS[Event.FAULT, state.operating_state]
    assert isinstance(row, Transition), "a fault is latched in every state"
    latched = state.replaced(
        faults=state.faults + tuple(new),
        needs_homing=state.needs_homing or not LOST_POSITION.isdisjoint(new),
    )
    return _taken(latched, row.target, row.request)


def homed_again(state: SafetyState, is_homed: bool) -> SafetyState:
    """Return `state` without `needs_homing` once the device has said that it is not homed."""
    return state if is_homed or not state.needs_homing else state.replaced(needs_homing=False)


def command(state: SafetyState, name: str, now_s: float, conditions: Conditions) -> SafetyState:
    """Return the state after the operator's command `name`. Raises RefusedError."""
    if name not in COMMANDS:
        raise RefusedError(
            "unknown_command",
            f"no command {name!r}",
            f"commands: status, describe, arm, take, confirm, mark, blackbox, {', '.join(COMMANDS)}",
        )
    event = Event(name)
    row = TRANSITIONS[event, state.operating_state]
    if isinstance(row, Refusal):
        if not conditions.connected:
            require(CONNECTED, state, conditions)
        raise RefusedError(row.code, _refused(row, state), row.remedy)
    for guard in row.guards:
        require(guard, state, conditions)
    if event is Event.STOP:
        return latch(state, (Fault.STOPPED,))
    request = row.request
    if event is Event.ENABLE:
        state = state.replaced(clearing_until_s=-math.inf)
    elif event is Event.CLEAR_FAULT:
        state = state.replaced(faults=())
        if not conditions.device_latched:
            request = DeviceRequest.NONE
        elif request is DeviceRequest.CLEAR:
            state = state.replaced(clearing_until_s=now_s + CLEARING_S)
    return _taken(state, row.target, request)


def require(guard: Guard, state: SafetyState, conditions: Conditions) -> None:
    message = guard.refuses(state, conditions)
    if message:
        is_told_better = guard is CONNECTED and conditions.remedy
        raise RefusedError(guard.code, message, conditions.remedy if is_told_better else guard.remedy)


def next_commands(state: SafetyState, is_homed: bool) -> tuple[Event, ...]:
    if state.operating_state is ENABLED:
        return ()
    if state.operating_state is PAUSED:
        return (Event.RESUME,)
    has_lost = any(FAULTS[fault].position is not Position.KEPT for fault in state.faults)
    commands = [Event.CLEAR_FAULT] if state.operating_state is FAULTED else []
    if has_lost or state.needs_homing or not is_homed:
        commands.append(Event.HOME)
    return (*commands, Event.ENABLE)


def reason(name: str, source: OperatingState) -> str:
    """Return the log's line for a command, as in "FAULT to DISABLED: why"."""
    row = TRANSITIONS[Event(name), source]
    return f"{source} to {row.target}: {row.reason}" if isinstance(row, Transition) else ""


def _taken(state: SafetyState, target: OperatingState, request: DeviceRequest) -> SafetyState:
    after = state.replaced(operating_state=target)
    return after if request is DeviceRequest.NONE else after.ask(request)


def _refused(row: Refusal, state: SafetyState) -> str:
    if row.source is FAULTED:
        return f"cannot {row.event} in {row.source}: {', '.join(state.faults)}"
    already = f"already {row.source}"
    return already if row.event is Event.ENABLE else f"cannot {row.event} while {row.source}"
