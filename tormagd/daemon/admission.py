"""Who is let in: the CURVE keys of the guarded endpoints, and how many connections an address may have.

libzmq asks here (ZAP, RFC 27) about every peer whose handshake has proved that it has the secret key of the public one
it shows, and tells here (socket monitors) about those that came no further, which send nothing to us and get nothing
but ZMTP's greeting. The handshakes themselves are the work of libzmq's thread; what is left is a slice of the beat.
"""

import contextlib
import logging
import os
import socket
import struct
from collections import Counter, deque

import zmq
import zmq.utils.monitor
from zmq.utils import z85

from tormagd.daemon.arrivals import Arrivals
from tormagd.keys import Allowed, KeyRing
from tormagd_client.endpoints import ROLES
from tormagd_client.keys import fingerprint
from tormagd_client.messages import PeerReport

CONNECTIONS = 200
CONNECTIONS_PER_PEER = 160
"Of one endpoint, and of one address or process among them. More are cut off as soon as they are accepted."
PEERS = 32
"Refused peers that are told apart; the one that was refused longest ago joins the others."
OTHERS = "others"
GUARDED = {
    zmq.ZAP_ENFORCE_DOMAIN: 1,
    zmq.HANDSHAKE_IVL: 2_000,
    # a machine that has gone without a word frees its connection after half a minute
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 10,
    zmq.TCP_KEEPALIVE_INTVL: 5,
    zmq.TCP_KEEPALIVE_CNT: 4,
}
"Options of a guarded socket; times are in ms and s."
NEWS_S = 10.0
"At most one log line in this time."
AT_ONCE = 4
"Events taken in one slice at most."
WATCHED = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
_CREDENTIALS = struct.Struct("3i")
_ZAP = "inproc://zeromq.zap.01"
_KEY_BYTES = 32

MAY: dict[str, frozenset[str]] = {
    "setpoint": frozenset({"publish"}),
    "telemetry": frozenset({"observe", "operate"}),
    "recording": frozenset({"observe", "operate"}),
    "control": frozenset({"observe", "operate"}),
}
"Which roles an endpoint is for. On `control` an observer may ask for the status only."

PLAIN = "no CURVE handshake"
"It speaks without CURVE, leaves when it is asked for it, or says nothing: which of these is seen first varies."
REASONS: dict[int, str] = {
    zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH: PLAIN,
    zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC: "another server's key",
}
UNLISTED, WRONG_ROLE = "key not listed", "role not allowed"
TOO_MANY = "too many connections"
UNASKED_KEY = "no handshake that an open endpoint knows: a key is not to be shown here"
BROKEN_HANDSHAKE, LEFT = "broken handshake", "left in the handshake"

log = logging.getLogger(__name__)


class _Connections:
    """The connections of one endpoint, as its monitor tells of them."""

    def __init__(self, name: str, is_guarded: bool) -> None:
        self.name, self.is_guarded = name, is_guarded
        self.addresses: dict[int, str] = {}
        self.of_address: Counter[str] = Counter()
        self.admitted: Counter[str] = Counter()
        self.turned_away: deque[str] = deque(maxlen=CONNECTIONS)
        "Addresses whose keys were refused, and whose connections are not closed yet."
        self.untold = 0
        "So many of these libzmq has not turned away yet: whoever leaves in the handshake may be one of them."
        self.taken_for_one: deque[tuple[str, str]] = deque(maxlen=CONNECTIONS)
        "Addresses of those that did, and of those that they were taken for."
        self.failed: str | None = None
        "Why the handshake failed of the connection that is closed next: libzmq closes it at once."
        self.cut: set[int] = set()

    def turn_away(self, address: str) -> None:
        """Its key is refused, which libzmq will be told."""
        self.turned_away.append(address)
        self.untold += 1

    def told(self) -> str | None:
        """libzmq turns one away. The address of another that had left in the handshake and was taken for this one."""
        if self.untold:
            self.untold -= 1
            return None
        other, address = self.taken_for_one.pop() if self.taken_for_one else ("", "")
        self.turned_away.append(address)
        return other

    def left_untold(self, address: str) -> bool:
        """Whether a connection that was closed in the handshake is one whose key was refused."""
        taken = self._turned_away(address) if self.untold else None
        if taken is None:
            return False
        self.untold -= 1
        self.taken_for_one.append((address, taken))
        return True

    def was_turned_away(self, address: str) -> bool:
        """Whether a connection that is closed after its handshake is one whose key was refused."""
        return self._turned_away(address) is not None

    def _turned_away(self, address: str) -> str | None:
        if not address and self.turned_away:  # it had gone before it was seen
            return self.turned_away.popleft()
        if address not in self.turned_away:
            return None
        self.turned_away.remove(address)
        return address


class Admission:
    """Guards sockets while they are made, then watches them."""

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", keys: KeyRing | None, arrivals: Arrivals) -> None:
        self._keys, self._arrivals = keys, arrivals
        self.allowed: Allowed = keys.allowed if keys else {}
        self._refusals: dict[tuple[str, str, str, str], int] = {}
        self.refused = 0
        self.moves: deque[tuple[str, bool]] = deque(maxlen=64)
        "Publishers that came (False) or, after a handshake that went well, left (True), by their address."
        self._told = 0
        self._newest = ""
        self._tell_s = 0.0
        self._endpoints: dict[zmq.Socket[bytes], _Connections] = {}
        self._watched: list[zmq.Socket[bytes]] = []
        # before any guarded socket is bound: libzmq lets nobody in (ZAP_ENFORCE_DOMAIN) while nobody can be asked
        self._zap = context.socket(zmq.ROUTER)
        self._zap.linger = 0
        self._zap.bind(_ZAP)
        arrivals.watch(self._zap)

    def guard(self, endpoint: "zmq.Socket[bytes]", name: str, is_guarded: bool) -> None:
        """To be called before the socket is bound."""
        if is_guarded:
            if self._keys is None:
                raise OSError("CURVE keys are needed: endpoints.curve.server_secret")
            endpoint.curve_secretkey = self._keys.server.secret
            endpoint.curve_server = True
            endpoint.setsockopt(zmq.ZAP_DOMAIN, name.encode())
            for option, value in GUARDED.items():
                endpoint.setsockopt(option, value)
        monitor = endpoint.get_monitor_socket(WATCHED)
        self._arrivals.watch(monitor)
        self._endpoints[monitor] = _Connections(name, is_guarded)
        self._watched.append(endpoint)

    def update(self) -> bool:
        """Takes a few of the events that wait, of one socket; False where there were none."""
        if self._arrivals.has(self._zap):
            self._admit()
            return True
        for monitor, known in self._endpoints.items():
            if self._arrivals.has(monitor):
                self._watch(monitor, known)
                return True
        return False

    def close(self) -> None:
        """Watches no more; the sockets are the context's to close."""
        for endpoint in self._watched:
            # or ZeroMQ's thread would wait for ever for a monitor that has gone
            endpoint.disable_monitor()

    def roles(self, public: str) -> frozenset[str]:
        """What a key may do now."""
        listed = self.allowed.get(public)
        return listed.roles if listed else frozenset()

    def has_role(self, public: str, roles: frozenset[str]) -> bool:
        """Whether the key is listed for one of these now: one that was let in may have been taken off the list."""
        return not roles.isdisjoint(self.roles(public))

    def name(self, public: str) -> str:
        """A key as people know it: its fingerprint, and the name of its file."""
        listed = self.allowed.get(public)
        return fingerprint(public) if listed is None else f"{fingerprint(public)} ({listed.name})"

    def connections(self) -> dict[str, int]:
        """How many connections each endpoint has."""
        return {each.name: len(each.addresses) for each in self._endpoints.values()}

    def is_connected(self, name: str) -> bool:
        """Whether this endpoint has any."""
        return bool(self._of(name).addresses)

    def refusals(self) -> tuple[PeerReport, ...]:
        """Who was refused, the newest last."""
        return tuple(PeerReport(*peer, count) for peer, count in self._refusals.items())

    def tell(self, now_s: float) -> None:
        """Says in the log whether peers were refused: some times a second."""
        new = self.refused - self._told
        if new and now_s >= self._tell_s:
            log.warning("refused %d peers, the newest at %s", new, self._newest)
            self._told, self._tell_s = self.refused, now_s + NEWS_S

    def let_in(self, allowed: Allowed) -> None:
        """From now on these keys are let in."""
        before, self.allowed = self.allowed, allowed
        log.info("%d keys are let in: %s", len(allowed), _counts(allowed))
        lost = [key for key, listed in before.items() if not listed.roles <= self.roles(key)]
        if lost:
            # what they send is looked at again each time; what is sent to them is not. Who may stay is back in a moment
            log.warning("keys that are let in no more, or for less: %s", ", ".join(before[key].name for key in lost))
            for known in self._endpoints.values():
                if known.is_guarded and known.name in ("telemetry", "recording"):
                    self._cut(known)

    def cut_off(self, name: str, address: str) -> None:
        """Ends the connections that an address has to an endpoint; whoever may connect comes back."""
        self._cut(self._of(name), address)

    def _admit(self) -> None:
        for _ in range(AT_ONCE):
            if not self._arrivals.has(self._zap):
                return
            frames = self._zap.recv_multipart(zmq.NOBLOCK)
            envelope, (version, request, domain, address, _, mechanism, *credentials) = frames[:2], frames[2:]
            public = ""
            if mechanism == b"CURVE" and len(credentials) == 1 and len(credentials[0]) == _KEY_BYTES:
                public = z85.encode(credentials[0]).decode()
            name = domain.decode()
            is_admitted = self._is_admitted(name, address.decode(errors="replace"), public)
            status, text = (b"200", b"OK") if is_admitted else (b"400", b"")
            self._zap.send_multipart([*envelope, version, request, status, text, public.encode(), b""])
            self._arrivals.touch(self._zap)

    def _is_admitted(self, name: str, address: str, public: str) -> bool:
        known = self._of(name)
        if self.has_role(public, MAY[name]):
            self._moved(name, address, has_left=False)
            known.admitted[address] += 1
            return True
        known.turn_away(address)
        listed = self.allowed.get(public)
        reason = UNLISTED if listed is None else f"{WRONG_ROLE}: {', '.join(sorted(listed.roles))}"
        self._refuse(name, address, self.name(public) if public else "", reason)
        return False

    def _of(self, name: str) -> _Connections:
        (known,) = (each for each in self._endpoints.values() if each.name == name)
        return known

    def _watch(self, monitor: "zmq.Socket[bytes]", known: _Connections) -> None:
        for _ in range(AT_ONCE):
            if not self._arrivals.has(monitor):
                return
            event = zmq.utils.monitor.recv_monitor_message(monitor, zmq.NOBLOCK)
            kind, value = event["event"], event["value"]
            if kind == zmq.EVENT_ACCEPTED:
                self._accepted(known, value)
            elif kind == zmq.EVENT_DISCONNECTED:
                self._admit()  # it may have been asked about before it left, and is counted once
                self._disconnected(known, value)
            elif kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                other = known.told()
                if other is not None:
                    self._refuse(known.name, other, "", PLAIN)
            elif kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                known.failed = REASONS.get(value, BROKEN_HANDSHAKE) if known.is_guarded else UNASKED_KEY
            elif kind == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL:
                known.failed = PLAIN if known.is_guarded else LEFT

    def _accepted(self, known: _Connections, descriptor: int) -> None:
        connection = _connection(descriptor)
        if connection is None:  # it has gone already, and its address with it
            known.addresses[descriptor] = ""
            return
        with connection:
            address = _address(connection)
            known.addresses[descriptor] = address
            if not address:
                return
            known.of_address[address] += 1
            if known.of_address[address] > CONNECTIONS_PER_PEER or len(known.addresses) > CONNECTIONS:
                known.cut.add(descriptor)
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
            elif not known.is_guarded:
                self._moved(known.name, address, has_left=False)

    def _disconnected(self, known: _Connections, descriptor: int) -> None:
        address = known.addresses.pop(descriptor, "")
        failed, known.failed = known.failed, None
        if address:
            _count_down(known.of_address, address)
        was_asked = known.was_turned_away(address) if failed is None else failed == PLAIN and known.left_untold(address)
        if descriptor in known.cut:
            known.cut.discard(descriptor)
            failed = TOO_MANY
        if was_asked:
            pass  # counted then
        elif failed is not None:
            self._refuse(known.name, address, "", failed)
        elif not known.is_guarded:
            self._moved(known.name, address, has_left=True)
        elif known.admitted[address]:
            _count_down(known.admitted, address)
            self._moved(known.name, address, has_left=True)
        else:
            # a peer of an old version is closed without an event of its own
            self._refuse(known.name, address, "", PLAIN)

    def _moved(self, name: str, address: str, has_left: bool) -> None:
        if name == "setpoint" and address:
            self.moves.append((address, has_left))

    def _refuse(self, name: str, address: str, key: str, reason: str) -> None:
        self.refused += 1
        peer = (name, shown(address), key, reason)
        self._newest = f"{name}: {peer[1]}{f', key {key}' if key else ''}: {reason}"
        self._refusals[peer] = self._refusals.pop(peer, 0) + 1
        if len(self._refusals) > PEERS:
            first = next(each for each in self._refusals if each[1] != OTHERS)
            others = (first[0], OTHERS, "", first[3].split(":")[0])
            self._refusals[others] = self._refusals.pop(others, 0) + self._refusals.pop(first)

    def _cut(self, known: _Connections, whose: str = "") -> None:
        """Ends the connections of an address, or all."""
        for descriptor, address in known.addresses.items():
            connection = _connection(descriptor) if address == whose or not whose else None
            if connection is not None:
                with connection:
                    if _address(connection) == address:  # or its number has gone to another one since
                        with contextlib.suppress(OSError):
                            connection.shutdown(socket.SHUT_RDWR)


def shown(address: str) -> str:
    """A peer's address for people: the host, or the process."""
    if not address:
        return "gone before it was seen"
    parts = address.split(":")
    return f"process {parts[3]} of user {parts[1]}" if len(parts) == 4 else address


def _count_down(counts: Counter[str], name: str) -> None:
    """One less; what is not there any more is not kept."""
    counts[name] -= 1
    if not counts[name]:
        del counts[name]


def _counts(allowed: Allowed) -> str:
    roles = Counter(role for listed in allowed.values() for role in listed.roles)
    return ", ".join(f"{role} {roles[role]}" for role in ROLES)


def _connection(descriptor: int) -> socket.socket | None:
    try:
        return socket.socket(fileno=os.dup(descriptor))
    except OSError:
        return None


def _address(connection: socket.socket) -> str:
    """The peer as libzmq names it: its host, or `localhost:USER:GROUP:PROCESS`; empty where it has gone."""
    try:
        if connection.family == socket.AF_UNIX:
            made = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            process, user, group = _CREDENTIALS.unpack(made)
            return f"localhost:{user}:{group}:{process}"
        return str(connection.getpeername()[0])
    except OSError:
        return ""
