"""Admission to the sockets: the CURVE keys of guarded endpoints, and the number of connections of an address.

libzmq carries out the handshakes in its own thread. Through ZAP (RFC 27) it asks about every peer that has proved that
it holds the secret of its key. Through socket monitors it tells of peers that got less far. Both are handled in a slice
of the beat.
"""

import contextlib
import logging
import socket
import struct
import time
from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
from typing import Any

import zmq
import zmq.utils.monitor
from zmq.utils import z85

from tormagd.daemon.allowance import Allowance
from tormagd.daemon.arrivals import Arrivals
from tormagd.daemon.door import Door
from tormagd.daemon.tally import Peer, Tally, shown
from tormagd.keys import Allowed, KeyRing
from tormagd_client.endpoints import ROLES
from tormagd_client.keys import fingerprint

CONNECTIONS = 200
CONNECTIONS_PER_PEER = 160
"Connections allowed to one endpoint, and to one address or process. For one more, another is cut off."
CLOSING = 8
"Connections that were cut off and are not closed yet; while there are so many, nobody is let in."
TOLD_S = 60.0
"How often a process that makes too many connections is named in the log."
SHUT_NS = 100_000_000
"How long nobody is let in to an endpoint at which somebody said too much."
UPDATE_NS = 100_000
"For how long events are handled in one slice."
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
LEFT, READ = 16, 65_536
"Reads of what a peer that is cut off has sent, and bytes of each."
AT_ONCE = 8
"Events taken in one slice at most."
WATCHED = (
    zmq.EVENT_LISTENING
    | zmq.EVENT_ACCEPTED
    | zmq.EVENT_ACCEPT_FAILED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_CREDENTIALS = struct.Struct("3i")

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
UNASKED_KEY = "no handshake that an open endpoint knows: a key is not to be shown here"

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
        self.heard: set[int] = set()
        "Connections by which a message has come."
        self.cut: dict[int, str] = {}
        "Addresses of connections that were cut off and are not closed yet."
        self.door: Door
        self.shut_ns = 0
        "Until then, of the monotonic clock, nobody more is let in."

    def crowded(self, address: str) -> int | None:
        """Return the connection to cut off, now that one of `address` has come; None where there is room."""
        of = Counter(self.addresses.values())
        if of[address] <= CONNECTIONS_PER_PEER:
            if len(self.addresses) <= CONNECTIONS:
                return None
            address = of.most_common(1)[0][0]
        theirs = [descriptor for descriptor, each in self.addresses.items() if each == address]
        return next((descriptor for descriptor in theirs if descriptor not in self.heard), theirs[-1])


class Admission:
    """Decides who may connect to the daemon's sockets: by CURVE key, and by the number of connections of an address."""

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", keys: KeyRing | None, arrivals: Arrivals) -> None:
        self._keys, self._arrivals = keys, arrivals
        self.allowed: Allowed = keys.allowed if keys else {}
        self.refusals = Tally("refused %d peers, the newest at %s", self.name)
        self._endpoints: dict[str, _Connections] = {}
        # before any guarded socket is bound: libzmq lets nobody in (ZAP_ENFORCE_DOMAIN) while nobody can be asked
        self._zap = context.socket(zmq.ROUTER)
        self._zap.linger = 0
        self._zap.bind("inproc://zeromq.zap.01")
        self._parts = deque([(self._zap, self._admit)])
        self._crowds = Allowance(1.0 / TOLD_S, 1.0)
        arrivals.watch(self._zap)

    def guard(self, endpoint: "zmq.Socket[bytes]", name: str, is_guarded: bool) -> None:
        """Begin to watch the connections of the endpoint `name`, and set the options of its socket if it is guarded."""
        if is_guarded:
            if self._keys is None:
                raise OSError("CURVE keys are needed: endpoints.curve.server_secret")
            keyed: dict[int, Any] = {
                zmq.CURVE_SERVER: 1,
                zmq.CURVE_SECRETKEY: self._keys.server.secret,
                zmq.ZAP_DOMAIN: name.encode(),
            }
            for option, value in (GUARDED | keyed).items():
                endpoint.setsockopt(option, value)
        known = self._endpoints[name] = _Connections(name, endpoint, is_guarded)
        self._parts.append((known.monitor, partial(self._watch, known)))
        self._arrivals.watch(known.monitor)

    def bound(self, name: str) -> None:
        """Bound the connections of the endpoint `name` from now on."""
        self._watch(self._endpoints[name])

    def hear(self, name: str, descriptor: int) -> None:
        """Note that a message has come by the connection `descriptor` of the endpoint `name`."""
        self._endpoints[name].heard.add(descriptor)

    def update(self) -> bool:
        """Handle waiting events, AT_ONCE of each socket, for about UPDATE_NS; return False where there are none."""
        # in turn: who knocks at one endpoint without pause must not keep everybody from the others
        until_ns, is_done = time.monotonic_ns() + UPDATE_NS, False
        for known in self._endpoints.values():
            if len(known.cut) < CLOSING and until_ns > known.shut_ns:
                known.door.open()
        for _ in range(len(self._parts)):
            self._parts.rotate()
            events, handle = self._parts[0]
            if self._arrivals.has(events):
                handle()
                is_done = True
                if time.monotonic_ns() > until_ns:
                    break
        return is_done

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
        """Answer libzmq's waiting questions about keys (ZAP, RFC 27), AT_ONCE at most."""
        for _ in range(AT_ONCE):
            if not self._arrivals.has(self._zap):
                return
            frames = self._zap.recv_multipart(zmq.NOBLOCK)
            # only libzmq asks here, and only of guarded sockets: the mechanism is CURVE
            envelope, (version, request, domain, address, _, _, key) = frames[:2], frames[2:]
            name, public = domain.decode(), z85.encode(key).decode()
            is_admitted = self._is_admitted(name, address.decode(errors="replace"), public)
            status, text = (b"200", b"OK") if is_admitted else (b"400", b"")
            self._zap.send_multipart([*envelope, version, request, status, text, public.encode(), b""])
            self._arrivals.touch(self._zap)

    def _is_admitted(self, name: str, address: str, public: str) -> bool:
        """Tell whether the key `public` may use the endpoint `name`; count one that may not, with the reason."""
        known = self._endpoints[name]
        if self.has_role(public, MAY[name]):
            known.admitted[address] += 1
            return True
        known.refused[address] += 1
        listed = self.allowed.get(public)
        reason = "key not listed" if listed is None else f"role not allowed: {', '.join(sorted(listed.roles))}"
        self.refusals.add(name, Peer(address, public), reason)
        return False

    def _watch(self, known: _Connections) -> None:
        """Handle the waiting events of one endpoint's monitor, AT_ONCE at most: connected, closed, handshake failed."""
        for _ in range(AT_ONCE):
            if not self._arrivals.has(known.monitor):
                return
            event = zmq.utils.monitor.recv_monitor_message(known.monitor, zmq.NOBLOCK)
            kind, value = event["event"], event["value"]
            if kind == zmq.EVENT_LISTENING:
                known.door = Door(value)
            elif kind == zmq.EVENT_ACCEPTED:
                known.door.is_open = False
                self._accepted(known, value)
            elif kind == zmq.EVENT_ACCEPT_FAILED:
                known.door.is_open = False
            elif kind == zmq.EVENT_DISCONNECTED:
                self._arrivals.touch(self._zap)  # a question about its key may have come just now: it is counted once
                self._admit()
                self._disconnected(known, value)
            elif kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                known.failed = REASONS.get(value, "broken handshake") if known.is_guarded else UNASKED_KEY
            else:
                known.failed = PLAIN if known.is_guarded else "left in the handshake"

    def _accepted(self, known: _Connections, descriptor: int) -> None:
        """Note a new connection and its address."""
        address = known.addresses[descriptor] = _address(descriptor)
        cut = known.crowded(address)
        if cut is None:
            return
        address = known.cut[cut] = known.addresses.pop(cut)
        _end(cut, address)
        if self._crowds.grants(Peer(address), time.monotonic()):
            log.warning(
                "%s makes more connections to %s than %d, or than the %d of all: what is beyond is cut off; "
                "next: end it, or let it use one socket for all its messages",
                *(shown(address), known.name, CONNECTIONS_PER_PEER, CONNECTIONS),
            )

    def _disconnected(self, known: _Connections, descriptor: int) -> None:
        """Forget a closed connection, and count a refusal where its peer never got in, or was cut off as
        one too many."""
        address = known.addresses.pop(descriptor, "")
        failed, known.failed = known.failed, None
        known.heard.discard(descriptor)
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
            made = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            process, user, group = _CREDENTIALS.unpack(made)
            return f"localhost:{user}:{group}:{process}"
        return str(connection.getpeername()[0])
    return ""


def _end(descriptor: int, address: str) -> None:
    """Shut down the connection `descriptor`, unless its peer is no longer `address`: descriptors are used again."""
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        if _address(descriptor) == address:
            connection.shutdown(socket.SHUT_RDWR)
            for _ in range(LEFT):
                if not connection.recv(READ, socket.MSG_DONTWAIT):
                    return


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Yield `descriptor` as a socket, which stays open."""
    connection = socket.socket(fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()
