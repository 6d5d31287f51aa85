"""The ZeroMQ endpoint: setpoints in, telemetry and recording out, commands answered.

Everything that arrives is hostile until `messages.decode` has passed it. A refused message is counted, its reason kept,
and control goes on.
"""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgpack
import zmq
import zmq.utils.monitor

from tormagd.config import Endpoints
from tormagd.control.governor import TimedSetpoint
from tormagd.messages import (
    MAX_MESSAGE_BYTES,
    VERSION,
    ErrorReply,
    MessageError,
    Reply,
    Request,
    Setpoint,
    Telemetry,
    decode,
    encode,
)
from tormagd.safety.operating_state import RefusedError

DRAIN = 64
"Setpoints read per tick at most; more wait for the next, so that a flood cannot stall control."
REQUESTS = 16
"Commands answered per telemetry period at most."
SOURCES = 16
"Publishers that are kept apart; another one is refused until an old one has been silent."
SILENT_S = 1.0
"A source that was silent this long may start again at any sequence number."
RECONNECT_S = 0.5
"A peer that was cut off comes back within this time (libzmq's default is 0.1 s)."
AHEAD_S = 0.05
"A stamp may be this far ahead of our clock."

log = logging.getLogger(__name__)


class _Source:
    __slots__ = ("heard_s", "newest", "seq")

    def __init__(self, newest: Setpoint, heard_s: float) -> None:
        self.newest, self.seq, self.heard_s = newest, newest.seq, heard_s


class SetpointInbox:
    """Chooses among what the publishers sent: the newest valid setpoint. No sockets, no clock."""

    def __init__(self) -> None:
        self.accepted = 0
        self.refused = 0
        self.dropped = 0
        self.oversize = 0
        self.last_refusal: str | None = None
        self.newest: TimedSetpoint | None = None
        self._newest_stamp_ns = 0
        self._newest_source = ""
        self._sources: dict[str, _Source] = {}

    def take(self, data: bytes, now_s: float, realtime_ns: int) -> bool:
        """Takes one message; True if it became the newest setpoint. `now_s` is the control clock."""
        try:
            setpoint = decode(data, Setpoint)
            self._admit(setpoint, now_s, realtime_ns)
        except MessageError as error:
            self.refused += 1
            self.last_refusal = str(error)
            return False
        known = self._sources.get(setpoint.source)
        if known is not None and setpoint.seq <= known.seq and now_s - known.heard_s < SILENT_S:
            self.dropped += 1
            return False
        self._sources[setpoint.source] = _Source(setpoint, now_s)
        self.accepted += 1
        if setpoint.stamp_ns < self._newest_stamp_ns and self.newest is not None:
            return False
        self._newest_stamp_ns = setpoint.stamp_ns
        self._newest_source = setpoint.source
        self.newest = TimedSetpoint(
            force_N=setpoint.servo_cf,
            stamp_s=now_s - (realtime_ns - setpoint.stamp_ns) * 1e-9,
            valid_for_s=setpoint.valid_for_ms * 1e-3,
            displacement_mm=setpoint.displacement_mm,
            rate_mm_s=setpoint.rate_mm_s,
        )
        return True

    def report(self) -> dict[str, Any]:
        """Counters, the last refusal, and each source with its newest sequence number."""
        return {
            "accepted": self.accepted,
            "refused": self.refused,
            "dropped": self.dropped,
            "oversize": self.oversize,
            "last_refusal": self.last_refusal,
            "newest_source": self._newest_source,
            "sources": {name: source.seq for name, source in self._sources.items()},
        }

    def _admit(self, setpoint: Setpoint, now_s: float, realtime_ns: int) -> None:
        ahead_s = (setpoint.stamp_ns - realtime_ns) * 1e-9
        if ahead_s > AHEAD_S:
            raise MessageError(
                f"stamp_ns is {ahead_s * 1e3:.0f} ms ahead of this clock: allowed is {AHEAD_S * 1e3:.0f} ms"
            )
        if setpoint.source not in self._sources and len(self._sources) >= SOURCES:
            silent = [name for name, source in self._sources.items() if now_s - source.heard_s > SILENT_S]
            if not silent:
                raise MessageError(f"source = {setpoint.source!r}: allowed are {SOURCES} publishers at a time")
            del self._sources[silent[0]]


class Endpoint:
    """The daemon's sockets."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._context = zmq.Context()
        self.inbox = SetpointInbox()
        self._setpoints = self._bind(zmq.SUB, endpoints.setpoint)
        self._setpoints.subscribe(b"")
        self._monitor = self._setpoints.get_monitor_socket(zmq.EVENT_DISCONNECTED | zmq.EVENT_ACCEPTED)
        self._cut_off_s: deque[float] = deque(maxlen=SOURCES)
        self._telemetry = self._bind(zmq.PUB, endpoints.telemetry)
        self._recording = self._bind(zmq.PUB, endpoints.recording)
        self._control = self._bind(zmq.ROUTER, endpoints.control)
        self._paths = [
            Path(address.removeprefix("ipc://"))
            for address in (endpoints.setpoint, endpoints.telemetry, endpoints.recording, endpoints.control)
            if _is_file(address)
        ]

    def fileno(self) -> int:
        """The descriptor that becomes readable when setpoints may have arrived (edge-triggered: drain them)."""
        return self._setpoints.fileno()

    def drain_setpoints(self, now_s: float) -> bool:
        """Reads what has arrived, at most DRAIN messages; True if there is a newer setpoint."""
        is_newer = False
        for _ in range(DRAIN):
            try:
                parts = self._setpoints.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return is_newer
            data = parts[0] if len(parts) == 1 else b""
            is_newer = self.inbox.take(data, now_s, time.time_ns()) or is_newer
        return is_newer

    def publish(self, telemetry: Telemetry) -> None:
        """Sends one telemetry message to whoever listens."""
        self._send(self._telemetry, encode(telemetry))

    def publish_ticks(self, columns: tuple[str, ...], rows: Sequence[tuple[Any, ...]]) -> None:
        """Sends the control ticks since the last time, a row each."""
        self._send(self._recording, msgpack.packb({"v": VERSION, "columns": columns, "rows": rows}))

    def serve(self, now_s: float, answer: Callable[[Request], dict[str, Any]]) -> None:
        """Answers waiting commands, at most REQUESTS. `answer` returns the result or raises RefusedError."""
        self._count_oversize(now_s)
        for _ in range(REQUESTS):
            try:
                envelope = self._control.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            reply = _reply(envelope[-1], answer)
            # a client that has gone meanwhile is not our business
            with contextlib.suppress(zmq.ZMQError):
                self._control.send_multipart([*envelope[:-1], encode(reply)], zmq.NOBLOCK)

    def close(self) -> None:
        """Closes the sockets without waiting for anybody."""
        self._setpoints.disable_monitor()
        self._context.destroy(linger=0)
        for path in self._paths:
            path.unlink(missing_ok=True)

    def _bind(self, kind: int, address: str) -> "zmq.Socket[bytes]":
        if _is_file(address):
            Path(address.removeprefix("ipc://")).parent.mkdir(parents=True, exist_ok=True)
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        socket.setsockopt(zmq.RCVHWM, 1_000)
        socket.setsockopt(zmq.SNDHWM, 1_000)
        try:
            socket.bind(address)
        except zmq.ZMQError as error:
            raise OSError(f"{address}: cannot be bound: {error}") from error
        return socket

    def _send(self, socket: "zmq.Socket[bytes]", data: bytes) -> None:
        # PUB drops for a subscriber that does not keep up; it never blocks
        with contextlib.suppress(zmq.Again):
            socket.send(data, zmq.NOBLOCK)

    def _count_oversize(self, now_s: float) -> None:
        # libzmq cuts off a peer that sends more than MAXMSGSIZE and delivers nothing. The only trace is a peer that is
        # disconnected and, unlike one that leaves, connects again at once by itself
        while self._monitor.poll(0):
            event = zmq.utils.monitor.recv_monitor_message(self._monitor)["event"]
            if event == zmq.EVENT_DISCONNECTED:
                self._cut_off_s.append(now_s)
            elif self._cut_off_s and now_s - self._cut_off_s.pop() < RECONNECT_S:
                self.inbox.oversize += 1


def _is_file(address: str) -> bool:
    # "ipc://@name" is a name without a file
    return address.startswith("ipc://") and not address.startswith("ipc://@")


def _reply(data: bytes, answer: Callable[[Request], dict[str, Any]]) -> Reply:
    try:
        request = decode(data, Request)
    except MessageError as error:
        refused = ErrorReply("bad_request", str(error), "see the message table in the README")
        return Reply(v=VERSION, id=None, ok=False, error=refused)
    try:
        return Reply(v=VERSION, id=request.id, ok=True, result=answer(request))
    except RefusedError as error:
        return Reply(v=VERSION, id=request.id, ok=False, error=ErrorReply(error.code, error.message, error.hint))
