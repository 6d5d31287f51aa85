"""The ZeroMQ endpoint: takes setpoints, publishes telemetry and recording, answers commands.

Everything that arrives is hostile until `messages.decode` has passed it. A refused message is counted, its reason kept,
and control goes on. `admission` decides who may connect, `allowance` how much each peer may send.
"""

import contextlib
import logging
import os
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import zmq

from tormagd.config import Sources
from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.admission import CONNECTIONS, MAY, Admission
from tormagd.daemon.inbox import EQUAL_SOURCES, SetpointInbox
from tormagd.daemon.peers import FIRST, Allowance, Arrivals, Listeners, Peer, Requests, Tally, Waiting, may_go_first
from tormagd.daemon.socket_file import SocketFile, ipc_path
from tormagd.ground.access_keys import KeyRing
from tormagd_client.endpoints import ENDPOINTS, ConfigError, Endpoints
from tormagd_client.messages import (
    MAX_MESSAGE_BYTES,
    VERSION,
    ErrorReply,
    MessageError,
    Motion,
    Numbered,
    PeersReport,
    Reply,
    Request,
    Telemetry,
    Verdict,
    decode,
    encode,
)

DRAIN_NS = 300_000
"For how long setpoints are read in one beat; more wait for the next, so that a flood cannot stall control."
SETPOINTS_PER_S, SETPOINT_BURST = 4_000.0, 1_000.0
"What one publisher may send; the rest is dropped unread. The burst is what comes at once after a network's pause."
OPTIONS: dict[int, dict[int, int]] = {
    zmq.SUB: {zmq.MAXMSGSIZE: MAX_MESSAGE_BYTES, zmq.RCVHWM: 10},
    zmq.ROUTER: {zmq.MAXMSGSIZE: MAX_MESSAGE_BYTES, zmq.RCVHWM: 10, zmq.SNDHWM: 16},
    # each subscription is passed on, not only the first of a topic
    zmq.XPUB: {zmq.MAXMSGSIZE: 512, zmq.RCVHWM: 2, zmq.SNDHWM: 100, zmq.XPUB_VERBOSER: 1},
}
"""Of each kind of socket: bytes of a message, and messages that wait in libzmq, of one peer and for it."""
SUBSCRIPTIONS_PER_S, SUBSCRIPTION_BURST = 20.0, 256.0
LONGEST_WORD = 16
"What one subscriber may say, in bytes each. One that says more is cut off, and may connect again."
TAKEN, TAKEN_NS = 64, 80_000
"Requests taken from the socket in one beat at most, and for how long; subscribers are heard as long at each socket."
HOPS, LONGEST_ROUTING_ID = 16, 255
"Parts of an envelope, and bytes of each, at most."
FIRSTS_PER_S, FIRST_BURST = 100.0, 100.0
"How often a peer may say `stop` or `disable`. With one more, which is carried out, its connection is cut off."
ANSWERS_NS = 150_000
"For how long requests are answered in one beat; one that has begun is ended."
PARTS_NS, MANY_PORTIONS = 400_000, 50
"For how long a message's further parts are read and dropped in one beat, some three hundred, and in how many beats."
TOO_MUCH, NOT_ALLOWED, OFF_THE_LIST = "sent too much", "command not allowed", "key taken off the list"
MANY_PARTS = "a message of thousands of parts"
LEAVES_MS = 20
OBSERVED = frozenset({"status", "describe"})
"What an observer may ask."
OPERATOR = frozenset({"operate"})

log = logging.getLogger(__name__)
Answer = Callable[[Request], Any]
"Returns the result, as plain data or packed already, or raises RefusedError."


class Endpoint:
    """The daemon's four sockets: takes setpoints, publishes telemetry and recording, answers requests."""

    def __init__(
        self,
        endpoints: Endpoints,
        io_priority: int = 0,
        sources: Sources = EQUAL_SOURCES,
        keys: KeyRing | None = None,
    ) -> None:
        self._context = context(io_priority)
        self._files: list[tuple[SocketFile, zmq.Socket[bytes], str, str]] = []
        self._guarded = {name for name in ENDPOINTS if endpoints.is_guarded(name)}
        self.inbox = SetpointInbox(sources)
        self.arrivals = Arrivals()
        self.admission = Admission(self._context, keys, self.arrivals)
        self._addresses = {name: getattr(endpoints, name) for name in ENDPOINTS}
        self._unread: dict[str, zmq.Frame] = {}
        "The newest part of an endpoint's newest message."
        self._portions = dict.fromkeys(ENDPOINTS, 0)
        "In how many beats in a row that was read on."
        try:
            self._setpoints = self._bind(zmq.SUB, "setpoint")
            # XPUB is a PUB that tells what its subscribers say
            self._telemetry = self._bind(zmq.XPUB, "telemetry")
            self._recording = self._bind(zmq.XPUB, "recording")
            self._control = self._bind(zmq.ROUTER, "control")
        except OSError:
            self.close()
            raise
        self.requests = Requests()
        self._cut_off: deque[bytes] = deque(maxlen=CONNECTIONS)
        self._firsts = Allowance(FIRSTS_PER_S, FIRST_BURST)
        self._allowance = Allowance(SETPOINTS_PER_S, SETPOINT_BURST)
        self._subscriptions = {
            name: Allowance(SUBSCRIPTIONS_PER_S, SUBSCRIPTION_BURST) for name in ("telemetry", "recording")
        }
        self._drops = Tally("%d messages were not read, the newest at %s", self.admission.name)
        self.listeners = Listeners()

    def take_setpoints(self) -> bool:
        """Read the waiting setpoints for DRAIN_NS into `inbox`; return True if another setpoint is in force."""
        is_newer, until_ns = False, time.monotonic_ns() + DRAIN_NS
        while time.monotonic_ns() < until_ns and self._has_message(self._setpoints, "setpoint"):
            frame = self._unread["setpoint"] = self._setpoints.recv(zmq.NOBLOCK, copy=False)
            # both clocks at once, for each message: their difference shows which was set, and the loop may be held up
            now_s, realtime_ns = time.monotonic(), time.time_ns()
            peer, _ = self._sender(frame, "setpoint")
            if not self._allowance.grants(peer, now_s):
                self._drops.add("setpoint", peer, TOO_MUCH)
            elif "setpoint" in self._guarded and not self.admission.has_role(peer.key, MAY["setpoint"]):
                self._drops.add("setpoint", peer, OFF_THE_LIST)
            else:
                key = self.admission.allowed[peer.key].fingerprint if peer.key else ""
                is_newer = self.inbox.take(b"" if frame.more else frame.bytes, now_s, realtime_ns, key) or is_newer
        return self.inbox.hand_on(time.monotonic()) or is_newer

    def publish(self, message: Telemetry | Motion | Verdict, *topic: bytes) -> None:
        """Send one message to all subscribers of telemetry, or to those of a topic, with the topic as its
        first part."""
        self._send(self._telemetry, *topic, encode(message))

    def publish_ticks(self, batch: bytes) -> None:
        """Send control ticks to all subscribers of the recording."""
        self._send(self._recording, batch)

    def hear(self) -> None:
        """Read what subscribers say, for TAKEN_NS at each socket; cut off those that say too much."""
        for name, subscribed in (("telemetry", self._telemetry), ("recording", self._recording)):
            if not self.arrivals.has(subscribed):  # asked once: with each question libzmq takes in more
                continue
            until_ns, cut = time.monotonic_ns() + TAKEN_NS, set()
            with contextlib.suppress(zmq.Again):
                while time.monotonic_ns() < until_ns:
                    frame = subscribed.recv(zmq.NOBLOCK, copy=False)
                    peer, _ = self._sender(frame, name)
                    if name == "telemetry":
                        self.listeners.hear(frame.bytes, peer if peer.address else None)
                    is_long = len(frame) > LONGEST_WORD
                    if peer.address and (is_long or not self._subscriptions[name].grants(peer, time.monotonic())):
                        self._drops.add(name, peer, TOO_MUCH)
                        cut.add(peer.address)
            for address in cut:
                self.admission.cut_off(name, address)

    def take_requests(self, answer: Answer) -> None:
        """Take waiting requests from the socket, TAKEN at most, for TAKEN_NS; answer `stop` and `disable` at once."""
        until_ns = time.monotonic_ns() + TAKEN_NS
        for _ in range(TAKEN):
            if time.monotonic_ns() > until_ns or not self._has_message(self._control, "control"):
                return
            waiting = self._next_request()
            if waiting is None:
                continue
            if not (may_go_first(waiting.data) and self._is_answered_first(waiting, answer)):
                is_dropped = not self.requests.put(waiting)
            elif is_dropped := not self._firsts.grants(waiting.peer, time.monotonic()):
                self.admission.cut_off("control", waiting.connection)
                if _is_made(waiting.envelope[0]):
                    self._cut_off.append(waiting.envelope[0])
            if is_dropped:
                self._drops.add("control", waiting.peer, TOO_MUCH)

    def serve(self, answer: Answer, most: int) -> int:
        """Answer the waiting requests, `most` at most, for about ANSWERS_NS; return the number answered."""
        until_ns = time.monotonic_ns() + ANSWERS_NS
        for number in range(most):
            if time.monotonic_ns() > until_ns or (waiting := self.requests.next()) is None:
                return number
            self._reply(waiting, self._answered(waiting, answer))
        return most

    def tell(self, now_s: float) -> None:
        """Log the newly refused and dropped messages, a line of each in 10 s; bind sockets again that were removed."""
        self._drops.tell(now_s)
        self.admission.refusals.tell(now_s)
        for gone in [each for each in self._files if each[0].is_gone()]:
            self._files.remove(gone)
            gone[0].close()
            try:
                self._listen(*gone[1:])
                log.warning("the socket of endpoints.%s was removed: it is bound again", gone[2])
            except OSError as error:
                log.error("a socket was removed: %s; next: restart tormagd", error)

    def report(self) -> PeersReport:
        """Return the connections of each endpoint, and since the start the peers refused and the messages dropped."""
        return PeersReport(
            connections=self.admission.connections(),
            refused=self.admission.refusals.total,
            dropped=self._drops.total,
            refusals=self.admission.refusals.report(),
            drops=self._drops.report(),
        )

    def close(self) -> None:
        """Close all sockets and remove their files, without waiting for anybody."""
        self.admission.close()
        for file, *_ in self._files:
            file.close()
        self._context.destroy(linger=0)

    def _bind(self, kind: int, name: str) -> "zmq.Socket[bytes]":
        """Return a new socket of this `kind`, guarded where `endpoints` says so, bound, with bounded queues."""
        made = self._context.socket(kind)
        for option, value in ({zmq.LINGER: 0, zmq.BACKLOG: 512} | OPTIONS[kind]).items():
            made.setsockopt(option, value)
        self.admission.guard(made, name, name in self._guarded)
        if kind == zmq.SUB:
            made.subscribe(b"")
        self._listen(made, name, self._addresses[name])
        self.arrivals.watch(made)
        return made

    def _listen(self, made: "zmq.Socket[bytes]", name: str, address: str) -> None:
        """Bind a socket to `address`, once more where it was bound before."""
        path = ipc_path(address)
        try:
            if path is not None:
                file = SocketFile(path)
                self._files.append((file, made, name, address))
                made.setsockopt(zmq.USE_FD, file.listener.detach())
            _occupy(made, address)
            self.admission.update()
        except zmq.ZMQError as error:
            raise OSError(f"endpoints.{name} = {address!r}: cannot be bound: {error.strerror}; name another") from error
        except (OSError, ConfigError) as error:
            raise OSError(f"endpoints.{name} = {address!r}: {error}") from error

    def _send(self, to: "zmq.Socket[bytes]", *parts: bytes) -> None:
        to.send_multipart(parts, zmq.NOBLOCK)  # an XPUB drops what a slow subscriber has no room for
        self.arrivals.touch(to)

    def _has_message(self, socket: "zmq.Socket[bytes]", name: str) -> bool:
        """Read on to the end of the newest message, for PARTS_NS; return whether another waits. One that is not over
        after MANY_PORTIONS goes with its socket."""
        frame, until_ns = self._unread.pop(name, None), time.monotonic_ns() + PARTS_NS
        while frame is not None and frame.more:
            if time.monotonic_ns() > until_ns:
                self._unread[name] = frame
                self._portions[name] += 1
                if self._portions[name] >= MANY_PORTIONS:
                    self._drops.add(name, self._sender(frame, name)[0], MANY_PARTS)
                    self._renew(socket, name)
                return False
            frame = socket.recv(zmq.NOBLOCK, copy=False)
        self._portions[name] = 0
        return self.arrivals.has(socket)

    def _renew(self, old: "zmq.Socket[bytes]", name: str) -> None:
        """Bind a new socket in the place of `old`, whose connections end and whose messages are lost."""
        del self._unread[name]
        self._portions[name] = 0
        self.admission.leave(name)
        self.arrivals.leave(old)
        for each in [each for each in self._files if each[1] is old]:
            self._files.remove(each)
            each[0].close()
        old.close(0)
        if name == "control":
            self._control = self._bind(zmq.ROUTER, name)
        else:
            self._setpoints = self._bind(zmq.SUB, name)

    def _sender(self, frame: zmq.Frame, name: str) -> tuple[Peer, int]:
        """Return the peer that sent a message, with its key where the endpoint is guarded, and its connection; nobody
        where it had gone."""
        try:
            connection = int(frame.get(zmq.SRCFD))
            key = str(frame.get("User-Id")) if name in self._guarded else ""
            peer = Peer(str(frame.get("Peer-Address")), key)
        except zmq.ZMQError:
            return Peer(""), -1
        self.admission.heard.add((name, connection))
        return peer, connection

    def _next_request(self) -> Waiting | None:
        """Read the message that waits; None if its client was cut off."""
        client = self._control.recv(zmq.NOBLOCK)
        part = self._unread["control"] = self._control.recv(zmq.NOBLOCK, copy=False)
        if client in self._cut_off:
            return None
        hops: list[bytes] = []
        while part.more and hops[-1:] != [b""] and len(hops) < HOPS and len(part) <= LONGEST_ROUTING_ID:
            hops.append(part.bytes)
            part = self._unread["control"] = self._control.recv(zmq.NOBLOCK, copy=False)
        envelope = hops if hops[-1:] == [b""] or all(map(_is_made, hops)) else None
        data = b"" if part.more or envelope is None else part.bytes
        return Waiting([client, *(envelope or ())], data, *self._sender(part, "control"), self.requests.opens)

    def _is_answered_first(self, waiting: Waiting, answer: Answer) -> bool:
        """Carry out and answer a `stop` or `disable`, and return True, also where it was refused."""
        try:
            request = decode(waiting.data, Request)
        except MessageError:
            return False
        if request.command not in FIRST:
            return False
        reply = self._carried_out(request, waiting, answer)
        self.requests.opens += reply.ok
        self._reply(waiting, reply)
        return True

    def _answered(self, waiting: Waiting, answer: Answer) -> Reply:
        """Carry out a request, and return the reply."""
        try:
            request = decode(waiting.data, Request)
        except MessageError as error:
            why = ErrorReply("bad_request", str(error), "see the message table in the README")
            number: int | str | None = None
            with contextlib.suppress(MessageError):
                number = decode(waiting.data, Numbered).id
            return Reply(v=VERSION, id=number, ok=False, error=why)
        return self._carried_out(request, waiting, answer)

    def _carried_out(self, request: Request, waiting: Waiting, answer: Answer) -> Reply:
        """Carry out a request that is permitted, and return the reply; a RefusedError becomes the reply, with `ok`
        False."""
        try:
            self._require_permitted(request, waiting)
            return Reply(v=VERSION, id=request.id, ok=True, result=answer(request))
        except RefusedError as error:
            return Reply(v=VERSION, id=request.id, ok=False, error=ErrorReply(error.code, error.message, error.hint))

    def _require_permitted(self, request: Request, waiting: Waiting) -> None:
        """Raise RefusedError where the peer's key lacks the role for a request, and count it as dropped."""
        is_observed, key = request.command in OBSERVED, waiting.peer.key
        if "control" in self._guarded and not self.admission.has_role(key, MAY["control"] if is_observed else OPERATOR):
            self._drops.add("control", waiting.peer, NOT_ALLOWED)
            raise RefusedError(
                "forbidden",
                f"{request.command!r} is not for the key {self.admission.name(key)}",
                "its .key belongs in the daemon's folder of operators (operate), which SIGHUP reads again",
            )
        # the gap was told to open after this request came: it was meant for the state before
        if waiting.opens < self.requests.opens and not is_observed:
            raise RefusedError(
                "overtaken",
                f"stop or disable came after {request.command!r} and went first",
                "give it again if it is meant",
            )

    def _reply(self, waiting: Waiting, reply: Reply) -> None:
        """Send the reply to the client that asked; drop it where the client has gone."""
        self.arrivals.touch(self._control)
        self._control.send_multipart([*waiting.envelope, encode(reply)], zmq.NOBLOCK)


def _occupy(made: "zmq.Socket[bytes]", address: str) -> None:
    """Bind a socket; one that had the address before may leave it up to LEAVES_MS later."""
    for _ in range(LEAVES_MS):
        with contextlib.suppress(zmq.ZMQError):
            made.bind(address)
            return
        time.sleep(1e-3)
    made.bind(address)


def _is_made(routing_id: bytes) -> bool:
    return len(routing_id) == 5 and routing_id[0] == 0


def context(io_priority: int) -> "zmq.Context[zmq.Socket[bytes]]":
    """Return a ZeroMQ context whose threads run at this priority of SCHED_FIFO; 0: at none, as ordinary threads."""
    made = zmq.Context()
    if io_priority:
        made.set(zmq.THREAD_SCHED_POLICY, os.SCHED_FIFO)
        made.set(zmq.THREAD_PRIORITY, io_priority)
    return made
