"""The conversation with one firmware: handshake, commands that are repeated until acknowledged, measurements.

It has no I/O and no clock: the daemon and the virtual-time simulation carry its messages.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import ClassVar, Final, final

from firmware_protocol.codec import (
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
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
    period,
)
from tormagd.hardware.link_statistics import UNKNOWN_QUALITY, DeviceClock, LinkQuality, LinkWatch, RoundTrip
from tormagd.hardware.measurement import DeviceRequest, Measurement

REPEAT_S: Final = 0.05
"After this time without an acknowledgement a Hello or a command is sent again."
GIVE_UP_S: Final = 1.0
"A Home or Clear that is not acknowledged by then is given up: a late one would be a surprise."
HELLO_S: Final = 1.0
"A device that was reset takes no Drive before a Hello."
SILENT_S: Final = 0.08
"By then the firmware's own 50 ms have passed."
UNANSWERED_S: Final = 1.0
"A device without an Identity for this long may be of another make; it gets a Hello only every HELLO_S."
FIRST_NONCE: Final = 255
"Commands count from 1 to 254, so a Hello's nonce always differs."
OVERTAKEN: Final = 16
"A State whose counter is behind by less is a repetition or was overtaken."

POSITION_SPAN_MM: Final = period(State, "left_position_mm")
DEVICE_TIME_SPAN_S: Final = period(State, "device_time_s")
HANDLE_SPAN_MM: Final = period(Sense, "handle_position_mm")

_HOMED: Final = int(Switches.HOMED)
_COMMANDS: Final[dict[DeviceRequest, type[Home] | type[Retract] | type[Clear]]] = {
    DeviceRequest.HOME: Home,
    DeviceRequest.RETRACT: Retract,
    DeviceRequest.CLEAR: Clear,
}


class LinkState(StrEnum):
    """The state of a connection. In CLOSED, BACK_OFF and LOST the port is not open."""

    CLOSED = "CLOSED"
    BACK_OFF = "BACK_OFF"
    IDENTIFYING = "IDENTIFYING"
    UNANSWERED = "UNANSWERED"
    REFUSED = "REFUSED"
    RUNNING = "RUNNING"
    LOST = "LOST"


# looking a member up in its class takes longer than the rest of the work on a message
_IDENTIFYING: Final = LinkState.IDENTIFYING
_UNANSWERED: Final = LinkState.UNANSWERED
RUNNING: Final = LinkState.RUNNING
_NO_REQUEST: Final = DeviceRequest.NONE


@final
class DeviceLink:
    """One conversation with a device."""

    __match_args__: ClassVar = (
        "_acknowledged", "_asked_s", "_broken", "_delay_s", "_device_time_s", "_drives", "_handle_mm",
        "_heard_s", "_hello_due_s", "_is_measured", "_least_delay_s", "_left_mm", "_nonce", "_number", "_quality_watch",
        "_received_s", "_reported_s", "_request", "_request_due_s", "_requested_s", "_right_mm", "_sense", "_sensed_s",
        "_state", "_states", "_status", "_told", "cause", "clock", "identity", "quality", "repeated", "round_trip",
        "state",
    )  # fmt: skip

    def __init__(self, now_s: float) -> None:
        self.repeated = 0
        self._drives = self._states = 0
        self._request = DeviceRequest.NONE
        self._request_due_s = self._requested_s = now_s
        self._begin(now_s, "waiting for the device to say who it is")

    def _begin(self, now_s: float, cause: str) -> None:
        """Begin to identify the device, and forget all that was known of it."""
        self.state, self.cause = _IDENTIFYING, cause
        self.identity: Identity | None = None
        self.round_trip = RoundTrip()
        self.clock = DeviceClock()
        self.quality: LinkQuality = UNKNOWN_QUALITY
        self._quality_watch = LinkWatch(now_s)
        self._heard_s = self._hello_due_s = self._asked_s = now_s
        self._broken, self._delay_s, self._nonce = "", 0.0, 0
        # the device takes a Hello's nonce for the last accepted one, and so acknowledges nothing
        self._acknowledged = FIRST_NONCE
        self._state: State | None = None
        self._sense: Sense | None = None
        self._status: Status | None = None
        self._told: Status | None = None
        self._is_measured = False
        self._measurement: Measurement | None = None
        self._number = 0
        self._received_s = 0.0
        self._sensed_s = 0.0
        self._reported_s = 0.0
        self._device_time_s = 0.0
        self._left_mm = 0.0
        self._right_mm = 0.0
        self._handle_mm = 0.0
        self._least_delay_s = 0.0
        if self._request is not DeviceRequest.RETRACT:  # opening is still wanted; nothing else may move unasked
            self._request = DeviceRequest.NONE

    @property
    def measurement(self) -> Measurement | None:
        """The newest State, Sense and Status; None until a State follows the first of both others."""
        if self._measurement is None and self._is_measured:
            self._measurement = self._measured()
        return self._measurement

    @property
    def pending(self) -> DeviceRequest:
        return self._request

    def receive(self, now_s: float, message: Message) -> None:
        self._heard_s = now_s
        if self.state is _UNANSWERED:
            self.state = _IDENTIFYING
            self._asked_s = self._hello_due_s = now_s
        if isinstance(message, State):
            self._take_state(now_s, message)
        elif isinstance(message, Sense):
            self._take_sense(now_s, message)
        elif isinstance(message, Status):
            self._take_status(now_s, message)
        elif isinstance(message, Identity):
            self._take_identity(message)

    def due(self, now_s: float) -> list[Message]:
        """Return the Hello or the command to send after this period's Drive."""
        self.round_trip.drive(self._drives % 256, now_s)
        self._change_state(now_s)
        is_waiting = False
        if self._request is not _NO_REQUEST:
            if self._request is not DeviceRequest.RETRACT and now_s - self._requested_s > GIVE_UP_S:
                self._request = _NO_REQUEST
            else:
                is_waiting = self.state is RUNNING and self._status is not None
        messages: list[Message] = []
        if now_s >= self._hello_due_s and not is_waiting:
            self._hello_due_s = now_s + (REPEAT_S if self.state is _IDENTIFYING else HELLO_S)
            self.round_trip.hello()
            messages.append(Hello(schema_hash=SCHEMA_HASH, protocol_version=PROTOCOL_VERSION, nonce=self._acknowledged))
        if is_waiting and now_s >= self._request_due_s:
            self._request_due_s = now_s + REPEAT_S
            messages.append(_COMMANDS[self._request](nonce=self._nonce))
        return messages

    def drive(self, left_duty: float, right_duty: float, mode: DriveMode) -> Drive:
        self._drives += 1
        return Drive(left_duty=left_duty, right_duty=right_duty, mode=mode, counter=self._drives % 256)

    def request(self, now_s: float, request: DeviceRequest) -> None:
        """Ask the device for a routine: `due` repeats the command until a Status acknowledges it."""
        self._nonce = _next_nonce(self._nonce)
        self._request = request
        self._request_due_s = self._requested_s = now_s

    def missing(self, refused: Mapping[str, str]) -> str:
        if self.state is not RUNNING or self._is_measured:
            return ""
        lacking: list[str] = []
        for name, message in (("State", self._state), ("Sense", self._sense), ("Status", self._status)):
            if message is None:
                lacking.append(f"{name} refused: {refused[name]}" if name in refused else f"no {name} yet")
        return ", ".join(lacking) or "no State after the first Sense and Status yet"

    def judge(self, now_s: float, frames: int, damaged: int, unsent: int) -> None:
        """Renew `quality` from the backend's counters, when that is due."""
        if self._quality_watch.is_due(now_s):
            counts = self._drives, self._states, frames, damaged, unsent
            self.quality = self._quality_watch.look(now_s, counts, self.round_trip.usual_s, self.clock.drift)
            self._measurement = None

    def _change_state(self, now_s: float) -> None:
        """Identify a device anew after a reset or a replacement, or enter LOST or UNANSWERED."""
        # one tick later, so that the core has seen the measurement that shows the break, and names it better
        if self._broken:
            self._begin(now_s, self._broken)
        elif self.state is RUNNING and now_s - self._heard_s > SILENT_S:
            self.state = LinkState.LOST
            self.cause = f"no message for {SILENT_S * 1e3:.0f} ms"
        elif self.state is _IDENTIFYING and now_s - self._asked_s > UNANSWERED_S:
            self.state = LinkState.UNANSWERED
            self.cause = f"the device has not said who it is for {UNANSWERED_S:g} s"

    def _take_identity(self, identity: Identity) -> None:
        self.round_trip.identity()
        known, self.identity = self.identity, identity
        if known is not None and known.serial_number != identity.serial_number:
            self._broken = f"device {known.serial_number} was replaced by device {identity.serial_number}"
        if identity.schema_hash == SCHEMA_HASH:
            self.state = LinkState.RUNNING
            self.cause = ""
        else:
            self.state = LinkState.REFUSED
            self.cause = (
                f"the firmware's protocol schema is {identity.schema_hash:08x} (firmware {identity.firmware_major}."
                f"{identity.firmware_minor}), this daemon's is {SCHEMA_HASH:08x}: install the one that fits the other"
            )

    def _take_status(self, now_s: float, status: Status) -> None:
        """Keep a Status: end an acknowledged request, and note a reset or how late the device obeys."""
        if self._status is None:
            # an earlier host has counted this far; its last number would be taken for a repetition
            self._nonce = _next_nonce(status.command_nonce)
        elif self._status.command_nonce != 0 and status.command_nonce == 0:
            self._broken = "the device was reset"
        # a device that has just homed has a new origin, and the newest State is still of the old one
        has_new_origin = self._status is not None and _is_homed(status) and not _is_homed(self._status)
        self._status = status
        if not has_new_origin:
            self._told = status
        self._reported_s = now_s
        self.round_trip.status(status.drive_counter)
        if status.command_nonce == self._nonce:
            self._request = DeviceRequest.NONE
            self._acknowledged = self._nonce
        elif self._request is DeviceRequest.RETRACT and status.mode is DeviceMode.LATCHED:
            # a latched device has opened, or cannot, and tries again only after a Clear
            self._request = DeviceRequest.NONE
        # one late Status alone is a stall
        last_s = self._delay_s
        self._delay_s = 0.0
        if status.mode is DeviceMode.RUN:
            self._delay_s = self.round_trip.since_next_s(status.drive_counter, now_s)
        if self._is_measured:
            self._least_delay_s = min(last_s, self._delay_s)
            self._measurement = None

    def _take_sense(self, now_s: float, sense: Sense) -> None:
        # Sense follows the State of the same instant
        self._sensed_s = now_s
        previous = self._sense
        if self._is_measured and previous is not None:
            self._handle_mm += _unwrapped(previous.handle_position_mm, sense.handle_position_mm, HANDLE_SPAN_MM)
            self._measurement = None
        self._sense = sense

    def _take_state(self, now_s: float, state: State) -> None:
        """Unwrap a State's positions and time into the measurement, and feed round trips and clock."""
        previous = self._state
        if previous is not None and (previous.counter - state.counter) % 256 < OVERTAKEN:
            self.repeated += 1
            return
        self._state, self._told = state, self._status
        self._states += 1
        self.round_trip.state(state.counter, now_s)
        if previous is None or not self._is_measured:
            self._begin_measuring(now_s, state)
            return
        self._number += 1
        self._received_s = now_s
        self._device_time_s += (state.device_time_s - previous.device_time_s) % DEVICE_TIME_SPAN_S
        # homing sets an arbitrary origin to 0, so a wrap and a re-zero look alike: taking the shortest way is right for
        # a wrap and harmless for a re-zero
        self._left_mm += _unwrapped(previous.left_position_mm, state.left_position_mm, POSITION_SPAN_MM)
        self._right_mm += _unwrapped(previous.right_position_mm, state.right_position_mm, POSITION_SPAN_MM)
        self._measurement = None
        self.clock.add(now_s, self._device_time_s)

    def _begin_measuring(self, now_s: float, state: State) -> None:
        if self._status is None or self._sense is None:
            return
        self._is_measured, self._number, self._received_s = True, 0, now_s
        self._device_time_s = state.device_time_s
        self._left_mm = state.left_position_mm
        self._right_mm = state.right_position_mm

    def _measured(self) -> Measurement:
        sense, status = self._sense, self._told
        assert sense is not None, "measuring begins with a Sense"
        assert status is not None, "measuring begins with a Status"
        return Measurement(
            self._number,
            self._received_s,
            self._device_time_s,
            self._left_mm,
            self._right_mm,
            sense.left_current_A,
            sense.right_current_A,
            sense.force_N,
            self._handle_mm,
            status.mode,
            status.switches,
            status.faults,
            status.temperature_C,
            status.supply_V,
            self._sensed_s,
            self._reported_s,
            self._least_delay_s,
            self.quality,
        )


def _is_homed(status: Status) -> bool:
    return int(status.switches) & _HOMED != 0


def _next_nonce(nonce: int) -> int:
    return nonce % (FIRST_NONCE - 1) + 1


def _unwrapped(previous: float, value: float, span: float) -> float:
    return (value - previous + span / 2.0) % span - span / 2.0
