"""Admission to the sockets: the CURVE keys of guarded endpoints, and the number of connections of an endpoint.

libzmq carries out the handshakes in its own thread. Through ZAP (RFC 27) it asks about every peer that has proved that
it holds the secret of its key. Through socket monitors it tells of peers that got less far. Both are handled in a slice
of the beat.

libzmq accepts whatever comes, and ends the process where no descriptor is left for it (`ipc_listener.cpp`). It watches
its listening sockets through epoll. Here each of them becomes one-shot there (EPOLLONESHOT, `epoll_ctl(2)`): one
connection is accepted each time that the door is opened. What epoll has to be told of it anew is in /proc/self/fdinfo
(`proc(5)`).
"""

import contextlib
import ctypes
import logging
import platform
import re
import select
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import zmq
import zmq.utils.monitor
from zmq.utils import z85

from tormagd.daemon.peers import Allowance, Arrivals, Peer, Tally, shown
from tormagd.ground.access_keys import Allowed, KeyRing
from tormagd.ground.files import CREDENTIALS
from tormagd_client.endpoints import ROLES
from tormagd_client.keys import fingerprint

CONNECTIONS, CLOSING = 200, 8
"""Connections allowed to one endpoint: for one more, one of the address or process that has most is cut off."""
SHUT_NS = 100_000_000
"How long nobody is let in to an endpoint at which somebody said too much."
GUARDED = {
    zmq.ZAP_ENFORCE_DOMAIN: 1,
    zmq.HANDSHAKE_IVL: 2_000,
    # the connection of a machine that has gone without a word ends after half a minute
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 10,
    zmq.TCP_KEEPALIVE_INTVL: 5,
    zmq.TCP_KEEPALIVE_CNT: 4,
}
"Options of a guarded socket; times are in ms and s."
AT_ONCE = 4
"Events of one socket taken in one slice at most."
WATCHED = (
    zmq.EVENT_LISTENING
    | zmq.EVENT_ACCEPTED
    | zmq.EVENT_ACCEPT_FAILED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_EVENT = struct.Struct("=IQ" if platform.machine() == "x86_64" else "@IQ")
"`struct epoll_event`, which is packed on x86-64 only."
_libc = ctypes.CDLL(None, use_errno=True)

MAY: dict[str, frozenset[str]] = {
    "setpoint": frozenset({"publish"}),
    "telemetry": frozenset({"observe", "operate"}),
    "recording": frozenset({"observe", "operate"}),
    "control": frozenset({"observe", "operate"}),
}
"Roles that may use each endpoint. On `control` an observer may only ask for status and description."

PLAIN = "no CURVE handshake"
"The peer speaks no CURVE, leaves when asked for it, or says nothing: which of these is seen first varies."
REASONS: dict[int, str] = {
    zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH: PLAIN,
    zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC: "another server's key",
}
NOT_NULL = "no handshake of an open endpoint: allowed is ZMTP 3 without a key"

log = logging.getLogger(__name__)


class _Connections:
    """The connections of one endpoint, counted from the events of its socket monitor."""

    def __init__(self, name: str, endpoint: "zmq.Socket[bytes]", is_guarded: bool) -> None:
        self.name, self.endpoint, self.is_guarded = name, endpoint, is_guarded
        self.monitor = endpoint.get_monitor_socket(WATCHED)
        self.addresses: dict[int, str] = {}
        self.admitted: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        "How many open connections of an address were let in, or not, when libzmq asked about their keys."
        self.failed: str | None = None
        "Why the handshake failed of the connection that is closed next, as libzmq does at once; None: it did not fail."
        self.cut: dict[int, str] = {}
        "Addresses of connections that were cut off and are not closed yet."
        self.door: tuple[int, int, int]
        self.is_open = False
        "Whether libzmq may accept a connection, the next that comes."
        self.shut_ns = 0
        "Until then, of the monotonic clock, nobody more is let in."


class Admission:
    """Decides who may connect to the daemon's sockets: by CURVE key, and by the number of connections there."""

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", keys: KeyRing | None, arrivals: Arrivals) -> None:
        self._keys, self._arrivals = keys, arrivals
        self.allowed: Allowed = keys.allowed if keys else {}
        self.refusals = Tally("refused %d peers, the newest at %s", self.name)
        self._endpoints: dict[str, _Connections] = {}
        # before any guarded socket is bound: libzmq lets nobody in (ZAP_ENFORCE_DOMAIN) while nobody can be asked
        self._zap = context.socket(zmq.ROUTER)
        self._zap.linger = 0
        self._zap.bind("inproc://zeromq.zap.01")
        self._parts: list[tuple[zmq.Socket[bytes], Callable[[], None]]] = [(self._zap, self._admit)]
        self._crowds = Allowance(1.0 / 60.0, 1.0)
        self.heard: set[tuple[str, int]] = set()
        "Endpoints and connections by which a message has come."
        arrivals.watch(self._zap)

    def guard(self, endpoint: "zmq.Socket[bytes]", name: str, is_guarded: bool) -> None:
        """Begin to watch the connections of the endpoint `name`, and set the options of its socket if it is guarded."""
        if is_guarded:
            if self._keys is None:
                raise OSError("CURVE keys are needed: endpoints.curve.server_secret")
            keyed: dict[int, Any] = {zmq.CURVE_SERVER: 1, zmq.CURVE_SECRETKEY: self._keys.server.secret}
            for option, value in (GUARDED | keyed).items():
                endpoint.setsockopt(option, value)
        # where there is a domain, libzmq refuses ZMTP 1.0 and 2.0, of whose peers it tells nothing
        endpoint.setsockopt(zmq.ZAP_DOMAIN, name.encode())
        known = self._endpoints[name] = _Connections(name, endpoint, is_guarded)
        self._parts.append((known.monitor, partial(self._watch, known)))
        self._arrivals.watch(known.monitor)

    def update(self) -> bool:
        """Handle AT_ONCE waiting events of each socket; return False where none waits."""
        for number in range(AT_ONCE):
            busy = [handle for events, handle in self._parts if self._arrivals.has(events)]
            for handle in busy:
                handle()
            for known in self._endpoints.values():
                if not known.is_open and len(known.cut) < CLOSING and time.monotonic_ns() > known.shut_ns:
                    known.is_open = True
                    open_door(*known.door)
            if not busy:
                return number > 0
        return True

    def leave(self, name: str) -> None:
        """Forget the endpoint `name`, whose socket is about to be closed, and its connections."""
        known = self._endpoints.pop(name)
        self._arrivals.leave(known.monitor)
        self._parts = [each for each in self._parts if each[0] is not known.monitor]
        self.heard = {each for each in self.heard if each[0] != name}
        known.endpoint.disable_monitor()

    def close(self) -> None:
        """Stop watching the connections."""
        for known in self._endpoints.values():
            # or ZeroMQ's thread would wait for ever for a monitor that has gone
            known.endpoint.disable_monitor()

    def has_role(self, public: str, roles: frozenset[str]) -> bool:
        """Tell whether the key `public`, 40 characters (Z85), is now listed for at least one of `roles`."""
        return public in self.allowed and not roles.isdisjoint(self.allowed[public].roles)

    def name(self, public: str) -> str:
        """Return a key as people know it: its fingerprint, and the name of its file where the key is listed."""
        listed = self.allowed.get(public)
        return fingerprint(public) if listed is None else f"{fingerprint(public)} ({listed.name})"

    def connections(self) -> dict[str, int]:
        """Return the number of connections by the endpoint's name, as far as `update` has handled their events."""
        return {name: len(known.addresses) for name, known in self._endpoints.items()}

    def let_in(self, allowed: Allowed) -> None:
        """Replace the list of allowed keys by `allowed`, and log it."""
        before, self.allowed = self.allowed, allowed
        roles = Counter(role for listed in allowed.values() for role in listed.roles)
        log.info("%d keys are let in: %s", len(allowed), ", ".join(f"{role} {roles[role]}" for role in ROLES))
        lost = [
            key
            for key, listed in before.items()
            if not all(self.has_role(key, frozenset({role})) for role in listed.roles)
        ]
        if lost:
            # each message from a peer is checked against the list; what is sent to it is not. Allowed peers reconnect
            log.warning("keys that are let in no more, or for less: %s", ", ".join(before[key].name for key in lost))
            for name in ("telemetry", "recording"):
                if self._endpoints[name].is_guarded:
                    self.cut_off(name)

    def cut_off(self, name: str, whose: int | str | None = None) -> None:
        """Shut down a connection to the endpoint `name`, those of an address, or, None, all."""
        if isinstance(whose, str):
            self._endpoints[name].shut_ns = time.monotonic_ns() + SHUT_NS
        for descriptor, address in self._endpoints[name].addresses.items():
            if whose in (None, descriptor, address):
                _end(descriptor, address)

    def _admit(self) -> None:
        """Answer one of libzmq's questions about keys (ZAP, RFC 27), which must wait, and count a refusal."""
        frames = self._zap.recv_multipart(zmq.NOBLOCK)
        # only libzmq asks here: the mechanism is CURVE, or NULL, of an open socket
        envelope, (version, request, domain, where, _, mechanism, *keys) = frames[:2], frames[2:]
        name, address, public = domain.decode(), where.decode(errors="replace"), z85.encode(b"".join(keys)).decode()
        known, listed = self._endpoints[name], self.allowed.get(public)
        is_open = mechanism == b"NULL" and not known.is_guarded
        is_admitted = is_open or self.has_role(public, MAY[name])
        if not is_open:
            (known.admitted if is_admitted else known.refused)[address] += 1
        if not is_admitted:
            reason = "key not listed" if listed is None else f"role not allowed: {', '.join(sorted(listed.roles))}"
            self.refusals.add(name, Peer(address, public), reason)
        status, text = (b"200", b"OK") if is_admitted else (b"400", b"")
        self._zap.send_multipart([*envelope, version, request, status, text, public.encode(), b""])
        self._arrivals.touch(self._zap)

    def _watch(self, known: _Connections) -> None:
        """Handle one event of an endpoint's monitor, which must wait: connected, closed, or the handshake failed."""
        event = zmq.utils.monitor.recv_monitor_message(known.monitor, zmq.NOBLOCK)
        kind, value = event["event"], event["value"]
        if kind == zmq.EVENT_LISTENING:
            known.door, known.is_open = door(value), False
        elif kind == zmq.EVENT_ACCEPTED:
            self._accepted(known, value)
        elif kind == zmq.EVENT_ACCEPT_FAILED:
            known.is_open = False
        elif kind == zmq.EVENT_DISCONNECTED:
            self._arrivals.touch(self._zap)
            while self._arrivals.has(self._zap):  # a question about its key may still wait: it is counted once
                self._admit()
            self._disconnected(known, value)
        elif kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            known.failed = REASONS.get(value, "broken handshake") if known.is_guarded else NOT_NULL
        else:
            known.failed = PLAIN if known.is_guarded else "left in the handshake"

    def _accepted(self, known: _Connections, descriptor: int) -> None:
        """Note a new connection and its address."""
        known.is_open = False
        known.addresses[descriptor] = _address(descriptor)
        if len(known.addresses) <= CONNECTIONS:
            return
        address = Counter(known.addresses.values()).most_common(1)[0][0]
        theirs = [each for each in known.addresses if known.addresses[each] == address]
        cut = next((each for each in theirs if (known.name, each) not in self.heard), theirs[-1])
        known.cut[cut] = known.addresses.pop(cut)
        _end(cut, address)
        if self._crowds.grants(Peer(address), time.monotonic()):
            log.warning(
                "%s makes more connections to %s than the %d that are allowed in all; next: end it, or let it use one "
                "socket for all its messages",
                *(shown(address), known.name, CONNECTIONS),
            )

    def _disconnected(self, known: _Connections, descriptor: int) -> None:
        """Forget a closed connection, and count a refusal where its peer never got in, or was cut off as
        one too many."""
        address = known.addresses.pop(descriptor, "")
        failed, known.failed = known.failed, None
        self.heard.discard((known.name, descriptor))
        if descriptor in known.cut:
            address, failed = known.cut.pop(descriptor), "too many connections"
        elif failed in (None, PLAIN) and not address:  # a quick one: answered, and gone before its address was read
            gone = known.admitted - Counter(known.addresses.values())
            address = next(iter(+known.refused or gone), "")
        if failed in (None, PLAIN) and known.refused[address]:
            known.refused -= Counter((address,))
        elif failed is None and (not known.is_guarded or known.admitted[address]):
            known.admitted -= Counter((address,))
        else:
            self.refusals.add(known.name, Peer(address), failed or PLAIN)


def _address(descriptor: int) -> str:
    """Return the peer of a connection as libzmq names it: its IP address, or `localhost:USER:GROUP:PROCESS`."""
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        if connection.family == socket.AF_UNIX:
            made = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size)
            process, user, group = CREDENTIALS.unpack(made)
            return f"localhost:{user}:{group}:{process}"
        return str(connection.getpeername()[0])
    return ""


def _end(descriptor: int, address: str) -> None:
    """Shut down the connection `descriptor`, unless its peer is no longer `address`: descriptors are used again."""
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        if _address(descriptor) == address:
            connection.shutdown(socket.SHUT_RDWR)
            connection.recv(1_048_576, socket.MSG_DONTWAIT)


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Yield `descriptor` as a socket, which stays open."""
    connection = socket.socket(fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()


def door(listening: int) -> tuple[int, int, int]:
    """Return what `open_door` takes: the epoll set in which the descriptor `listening` is watched, itself,
    its data there."""
    entry = re.compile(rf"^tfd: +{listening} +events: +(\w+) +data: +(\w+)", re.MULTILINE)
    for _ in range(1_000):  # libzmq's thread takes up a new socket in its own time
        for path in Path("/proc/self/fdinfo").iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed meanwhile
                found = entry.search(path.read_text(encoding="ascii"))
                if found and int(found[1], 16) & select.EPOLLIN:
                    return int(path.name), listening, int(found[2], 16)
        time.sleep(0.001)  # with SCHED_FIFO it would wait for this thread
    raise OSError("connections cannot be bounded: /proc/self/fdinfo names no epoll set; mount /proc")


def open_door(epoll: int, listening: int, data: int) -> None:
    """Let libzmq accept one connection, the one that waits or comes next."""
    # 3: EPOLL_CTL_MOD
    if _libc.epoll_ctl(epoll, 3, listening, _EVENT.pack(select.EPOLLIN | select.EPOLLONESHOT, data)):
        raise OSError(ctypes.get_errno(), "epoll_ctl")
