"""The operating state: armed on purpose, opened on every fault, never re-armed by itself.

Pure functions of explicit state. The safe state is *gap open*: friction holds the force when power goes, and the
magnets pull shut. Opening is the device's own routine, because it must also work when this process is gone.
"""

import math
from enum import StrEnum
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.safety.codes import Fault

CLEARING_S = 0.5
"How long the device may take to report that a cleared fault is gone."
LOST_POSITION = frozenset(
    {
        Fault.SKEW,
        Fault.FOLLOWING_ERROR,
        Fault.NO_MOTION,
        Fault.ENCODER,
        Fault.OUT_OF_STROKE,
        Fault.WRONG_DIRECTION,
        Fault.HOMING,
    }
)
"""After these faults the counts of an encoder are not believed any more. The device does not know, and goes on calling
itself homed; where it has latched a fault of its own it does not."""


class OperatingState(StrEnum):
    """CRTK operating states."""

    DISABLED = "DISABLED"
    ENABLED = "ENABLED"
    PAUSED = "PAUSED"
    FAULT = "FAULT"


class DeviceRequest(StrEnum):
    """What the daemon asks of the firmware, once per request number."""

    NONE = "none"
    HOME = "home"
    RETRACT = "retract"
    CLEAR = "clear"


class RefusedError(Exception):
    """A command that the present state does not allow."""

    def __init__(self, code: str, message: str, hint: str) -> None:
        super().__init__(message)
        self.code, self.message, self.hint = code, message, hint


@final
class Conditions(Value):
    """What the decisions depend on."""

    __match_args__ = (
        "connected", "fresh", "homed", "busy", "device_latched", "requested_N", "neutral_N", "sensor_doubted", "cause",
        "remedy", "round_trip_s", "clock_drift",
    )  # fmt: skip
    __slots__ = __match_args__

    def __init__(
        self,
        connected: bool,
        fresh: bool,
        homed: bool,
        busy: bool,
        device_latched: bool,
        requested_N: float | None,
        neutral_N: float,
        sensor_doubted: bool = False,
        cause: str = "",
        remedy: str = "",
        round_trip_s: float = 0.0,
        clock_drift: float = 0.0,
    ) -> None:
        self.connected: Final = connected
        self.fresh: Final = fresh
        self.homed: Final = homed
        self.busy: Final = busy
        self.device_latched: Final = device_latched
        self.requested_N: Final = requested_N
        self.neutral_N: Final = neutral_N
        self.sensor_doubted: Final = sensor_doubted
        self.cause: Final = cause
        "What keeps the device from being connected or its measurements from being fresh; empty where nothing does."
        self.remedy: Final = remedy
        self.round_trip_s: Final = round_trip_s
        self.clock_drift: Final = clock_drift


@final
class SafetyState(Value):
    """Operating state, latched faults, and the newest request to the device.

    `needs_homing`: the device's word that it is homed does not count, until it has begun homing and so taken it back.
    """

    __match_args__ = ("operating_state", "faults", "request", "request_number", "clearing_until_s", "needs_homing")
    __slots__ = __match_args__

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

    def ask(self, request: DeviceRequest) -> "SafetyState":
        """The same state with a new request to the device."""
        return self.replaced(request=request, request_number=self.request_number + 1)


def latch(state: SafetyState, faults: tuple[Fault, ...]) -> SafetyState:
    """`state` with `faults` latched and the device asked to open; unchanged where there is nothing new."""
    new = tuple(fault for fault in faults if fault not in state.faults)
    if not new:
        return state
    latched = state.replaced(
        operating_state=OperatingState.FAULT,
        faults=state.faults + new,
        needs_homing=state.needs_homing or not LOST_POSITION.isdisjoint(new),
    )
    return latched.ask(DeviceRequest.RETRACT)


def homed_again(state: SafetyState, is_homed: bool) -> SafetyState:
    """`state` after the device has said whether it is homed; one that says no has begun anew and is believed again."""
    return state if is_homed or not state.needs_homing else state.replaced(needs_homing=False)


def command(state: SafetyState, name: str, now_s: float, conditions: Conditions) -> SafetyState:
    """The state after an operator's command. Raises RefusedError with code, message and what to do."""
    transition = _TRANSITIONS.get(name)
    if transition is None:
        raise RefusedError("unknown_command", f"no command {name!r}", f"commands: {', '.join(_TRANSITIONS)}")
    if name != "stop" and not conditions.connected:
        raise RefusedError(
            "not_connected",
            f"the device is not connected: {conditions.cause}" if conditions.cause else "the device is not connected",
            conditions.remedy or "check port, cable and supply",
        )
    return transition(state, now_s, conditions)


def _enable(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    _refuse_in(state, OperatingState.FAULT, "enable")
    if state.operating_state is not OperatingState.DISABLED:
        remedy = "tormagctl resume" if state.operating_state is OperatingState.PAUSED else "nothing to do"
        raise RefusedError("already_enabled", f"already {state.operating_state}", remedy)
    if conditions.device_latched:
        raise RefusedError("device_latched", "the device has latched a fault", "tormagctl clear-fault, then home")
    _refuse_busy(conditions)
    if state.needs_homing:
        raise RefusedError("not_homed", "a fault took the carriages' positions away", "tormagctl home")
    if not conditions.homed:
        raise RefusedError("not_homed", "the carriages are not homed", "tormagctl home")
    if not conditions.fresh:
        said = f": {conditions.cause}" if conditions.cause else ""
        raise RefusedError(
            "not_fresh", f"no fresh measurement from the device{said}", "look at the link in tormagctl status"
        )
    if conditions.sensor_doubted:
        raise RefusedError(
            "sensor_doubted",
            "the force sensor reads what no believable device gives with its gap open",
            "check sensor, cable and zero, then turn the handle for a second: it is judged while friction slides",
        )
    if conditions.requested_N is not None and not conditions.requested_N <= conditions.neutral_N:  # NaN is not neutral
        raise RefusedError(
            "not_neutral",
            f"the setpoint is {conditions.requested_N:.2f} N: allowed is at most {conditions.neutral_N:.2f} N",
            "lower the setpoint, enable, then raise it",
        )
    return state.replaced(operating_state=OperatingState.ENABLED, clearing_until_s=-math.inf)


def _disable(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    _refuse_in(state, OperatingState.FAULT, "disable")
    return state.replaced(operating_state=OperatingState.DISABLED).ask(DeviceRequest.RETRACT)


def _pause(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    _refuse_in(state, OperatingState.FAULT, "pause")
    if state.operating_state is not OperatingState.ENABLED:
        remedy = "nothing to do" if state.operating_state is OperatingState.PAUSED else "tormagctl enable"
        raise RefusedError("not_enabled", f"cannot pause while {state.operating_state}", remedy)
    return state.replaced(operating_state=OperatingState.PAUSED)


def _resume(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    _refuse_in(state, OperatingState.FAULT, "resume")
    if state.operating_state is not OperatingState.PAUSED:
        remedy = "nothing to do" if state.operating_state is OperatingState.ENABLED else "tormagctl enable"
        raise RefusedError("not_paused", f"cannot resume while {state.operating_state}", remedy)
    return state.replaced(operating_state=OperatingState.ENABLED)


def _home(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    _refuse_in(state, OperatingState.FAULT, "home")
    if state.operating_state is not OperatingState.DISABLED:
        raise RefusedError("not_disabled", f"cannot home while {state.operating_state}", "tormagctl disable")
    if conditions.device_latched:
        raise RefusedError("device_latched", "the device has latched a fault", "tormagctl clear-fault")
    _refuse_busy(conditions)
    return state.ask(DeviceRequest.HOME)


def _stop(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    return latch(state, (Fault.STOPPED,))


def _clear_fault(state: SafetyState, now_s: float, conditions: Conditions) -> SafetyState:
    _refuse_busy(conditions)
    if state.operating_state in (OperatingState.ENABLED, OperatingState.PAUSED):
        return state  # nothing is latched; what the device latches meanwhile is news, and must not be passed over
    cleared = state.replaced(operating_state=OperatingState.DISABLED, faults=())
    if not conditions.device_latched:
        return cleared
    return cleared.replaced(clearing_until_s=now_s + CLEARING_S).ask(DeviceRequest.CLEAR)


def _refuse_in(state: SafetyState, forbidden: OperatingState, name: str) -> None:
    if state.operating_state is forbidden:
        raise RefusedError("fault", f"cannot {name} in {forbidden}: {', '.join(state.faults)}", "tormagctl clear-fault")


def _refuse_busy(conditions: Conditions) -> None:
    if conditions.busy:
        raise RefusedError("busy", "the device is homing or opening", "wait until is_busy is false")


_TRANSITIONS = {
    "enable": _enable,
    "disable": _disable,
    "pause": _pause,
    "resume": _resume,
    "home": _home,
    "stop": _stop,
    "clear-fault": _clear_fault,
}
