"""The ZeroMQ endpoint: setpoints in, telemetry and recording out, commands answered.

Everything that arrives is hostile until `messages.decode` has passed it. A refused message is counted, its reason kept,
and control goes on.
"""

import contextlib
import logging
import os
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import zmq
import zmq.utils.monitor

from tormagd.config import Endpoints
from tormagd.daemon.inbox import SOURCES, SetpointInbox
from tormagd.daemon.socket_file import SocketFile, ipc_path
from tormagd.messages import (
    MAX_MESSAGE_BYTES,
    VERSION,
    ErrorReply,
    MessageError,
    Reply,
    Request,
    Telemetry,
    TickRecord,
    decode,
    encode,
    encode_ticks,
)
from tormagd.safety.operating_state import RefusedError

DRAIN = 64
"Setpoints read per tick at most; more wait for the next, so that a flood cannot stall control."
REQUESTS = 16
"Commands answered per telemetry period at most."
RECONNECT_S = 0.5
"A peer that was cut off comes back within this time (libzmq's default is 0.1 s)."

_CREDENTIALS = struct.Struct("3i")
_Peer = tuple[int, ...] | str

log = logging.getLogger(__name__)


class Endpoint:
    """The daemon's sockets. With an `io_priority` above 0, ZeroMQ's own threads run at this priority of SCHED_FIFO.
    `priority` is the inbox's.

    Raises OSError naming the endpoint that cannot be bound, and why: another daemon has it, say.
    """

    def __init__(self, endpoints: Endpoints, io_priority: int = 0, priority: tuple[str, ...] = ()) -> None:
        self._context = context(io_priority)
        self._files: list[SocketFile] = []
        self.inbox = SetpointInbox(priority)
        try:
            self._setpoints = self._bind(zmq.SUB, "setpoint", endpoints.setpoint)
            self._telemetry = self._bind(zmq.PUB, "telemetry", endpoints.telemetry)
            self._recording = self._bind(zmq.PUB, "recording", endpoints.recording)
            self._control = self._bind(zmq.ROUTER, "control", endpoints.control)
        except OSError:
            self._release()
            raise
        self._setpoints.subscribe(b"")
        self._monitor = self._setpoints.get_monitor_socket(zmq.EVENT_DISCONNECTED | zmq.EVENT_ACCEPTED)
        self._peers: dict[int, _Peer] = {}
        self._cut_off: deque[tuple[_Peer, float]] = deque(maxlen=SOURCES)

    def fileno(self) -> int:
        """The descriptor that becomes readable when setpoints may have arrived (edge-triggered: drain them)."""
        return self._setpoints.fileno()

    def drain_setpoints(self) -> bool:
        """Reads what has arrived, at most DRAIN messages; True if there is a newer setpoint."""
        is_newer = False
        for _ in range(DRAIN):
            try:
                parts = self._setpoints.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return is_newer
            data = parts[0] if len(parts) == 1 else b""
            # both clocks at once, for each message: how they part says which clock was set, and a drain may be held up
            is_newer = self.inbox.take(data, time.monotonic(), time.time_ns()) or is_newer
        return is_newer

    def publish(self, telemetry: Telemetry) -> None:
        """Sends one telemetry message to whoever listens."""
        self._send(self._telemetry, encode(telemetry))

    def publish_ticks(self, rows: Sequence[object], columns: tuple[str, ...] = TickRecord.__struct_fields__) -> None:
        """Sends the control ticks since the last time, a row each."""
        self._send(self._recording, encode_ticks(rows, columns))

    def serve(self, now_s: float, answer: Callable[[Request], dict[str, Any]], until_ns: int) -> None:
        """Answers waiting commands, at most REQUESTS, and none but the first from `until_ns` (monotonic) on.

        `answer` returns the result or raises RefusedError.
        """
        self._count_oversize(now_s)
        for number in range(REQUESTS):
            if number and time.monotonic_ns() >= until_ns:
                return
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
        self._release()

    def _release(self) -> None:
        for file in self._files:
            file.close()
        self._context.destroy(linger=0)

    def _bind(self, kind: int, name: str, address: str) -> "zmq.Socket[bytes]":
        made = self._context.socket(kind)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        made.setsockopt(zmq.RCVHWM, 1_000)
        made.setsockopt(zmq.SNDHWM, 1_000)
        path = ipc_path(address)
        try:
            if path is not None:
                file = SocketFile(path)
                self._files.append(file)
                made.setsockopt(zmq.USE_FD, file.detach())
            made.bind(address)
        except zmq.ZMQError as error:
            raise OSError(f"endpoints.{name} = {address!r}: cannot be bound: {error.strerror}") from error
        except OSError as error:
            raise OSError(f"endpoints.{name} = {address!r}: {error}") from error
        return made

    def _send(self, to: "zmq.Socket[bytes]", data: bytes) -> None:
        # PUB drops for a subscriber that does not keep up; it never blocks
        with contextlib.suppress(zmq.Again):
            to.send(data, zmq.NOBLOCK)

    def _count_oversize(self, now_s: float) -> None:
        # libzmq cuts off a peer that sends more than MAXMSGSIZE and delivers nothing. The only trace is a peer that is
        # disconnected and, unlike one that leaves, connects again at once by itself. A process that closes its socket
        # and opens another that soon looks the same; over TCP, where only the machine is known, so do two processes
        while self._monitor.poll(0):
            event = zmq.utils.monitor.recv_monitor_message(self._monitor)
            descriptor = event["value"]
            if event["event"] == zmq.EVENT_DISCONNECTED:
                gone = self._peers.pop(descriptor, None)
                if gone is not None:
                    self._cut_off.append((gone, now_s))
                continue
            peer = _peer(descriptor)
            if peer is None:
                continue
            self._peers[descriptor] = peer
            for cut_off in self._cut_off:
                if cut_off[0] == peer and now_s - cut_off[1] < RECONNECT_S:
                    self._cut_off.remove(cut_off)
                    self.inbox.oversize += 1
                    break


def context(io_priority: int) -> "zmq.Context[zmq.Socket[bytes]]":
    """A ZeroMQ context whose threads run at this priority of SCHED_FIFO; 0 for an ordinary one.

    A priority that is refused ends the process: see `realtime.priority_of_threads`.
    """
    made = zmq.Context()
    if io_priority:
        made.set(zmq.THREAD_SCHED_POLICY, os.SCHED_FIFO)
        made.set(zmq.THREAD_PRIORITY, io_priority)
    return made


def _peer(descriptor: int) -> _Peer | None:
    """The process at the other end of an accepted connection, over TCP its host; None where it has gone already."""
    try:
        connection = socket.socket(fileno=os.dup(descriptor))
    except OSError:
        return None
    with connection:
        try:
            if connection.family == socket.AF_UNIX:
                return _CREDENTIALS.unpack(
                    connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
                )
            return str(connection.getpeername()[0])
        except OSError:
            return None


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
