"""Peers: which sockets hold messages, what waits, how much of it is read, what was not, and who listens to which topic.

Clients take turns; `stop` and `disable` overtake all.
"""

import logging
import select
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

import zmq

from tormagd_client.messages import MOTION_TOPIC, VERDICT_TOPIC, PeerReport

NEWS_S = 10.0

log = logging.getLogger(__name__)


class Peer(NamedTuple):
    """A peer: its host or local process, as libzmq names it, and its key if it has one."""

    address: str
    key: str = ""


class Tally:
    """Counts refusals, and keeps the newest: endpoint, peer, reason, and how often it came in a row."""

    def __init__(self, line: str, name: Callable[[str], str]) -> None:
        self._line, self._name = line, name
        self.total = self._told = self._in_a_row = 0
        self._tell_s = 0.0
        self._newest = "", Peer(""), ""

    def add(self, endpoint: str, peer: Peer, reason: str) -> None:
        newest = endpoint, peer, reason
        self._in_a_row = self._in_a_row + 1 if newest == self._newest else 1
        self._newest = newest
        self.total += 1

    def report(self) -> tuple[PeerReport, ...]:
        endpoint, peer, reason = self._newest
        key = peer.key and self._name(peer.key)
        return (PeerReport(endpoint, shown(peer.address), key, reason, self._in_a_row),) if self.total else ()

    def tell(self, now_s: float) -> None:
        if self.total > self._told and now_s >= self._tell_s:
            (it,) = self.report()
            newest = f"{it.endpoint}: {it.address}{f', key {it.key}' if it.key else ''}: {it.reason}"
            log.warning(self._line, self.total - self._told, newest)
            self._told, self._tell_s = self.total, now_s + NEWS_S


def shown(address: str) -> str:
    """Return libzmq's address of a peer for people: the host, or `process N of user N`."""
    if address.startswith("localhost:"):
        _, user, _, process = address.split(":")
        return f"process {process} of user {user}"
    return address or "gone before it was seen"


PEERS = 256
"Peers that have a bucket; beyond, the one heard longest ago is forgotten."


class Allowance:
    """A token bucket for each peer: `per_s` messages a second, and a `burst` at once. No sockets, no clock."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._buckets: dict[Peer, tuple[float, float]] = {}

    def grants(self, peer: Peer, now_s: float) -> bool:
        """Tell whether one more message of `peer` may be read at `now_s`; if so, it is taken from the peer's bucket."""
        if peer not in self._buckets and len(self._buckets) >= PEERS:
            del self._buckets[min(self._buckets, key=self._buckets.__getitem__)]
        filled_s, left = self._buckets.get(peer, (now_s, self._burst))
        left = min(self._burst, left + (now_s - filled_s) * self._per_s)
        is_granted = left >= 1.0
        self._buckets[peer] = now_s, left - is_granted
        return is_granted


TOPICS = MOTION_TOPIC, VERDICT_TOPIC
LISTENERS = 16
"Peers that are counted apart at each topic: none takes away what another asked for."
OTHERS = Peer("others")


class Listeners:
    """Counts who subscribes to each of TOPICS by its name, so that nothing is built for nobody.

    A peer that subscribes to everything gets a topic only while another asks for it by its name.
    """

    def __init__(self) -> None:
        self._asked: dict[bytes, Counter[Peer | None]] = {topic: Counter() for topic in TOPICS}
        "Of each topic, subscriptions by peer; less than 0 for None, which stands for those that have gone."

    def has(self, topic: bytes) -> bool:
        """Tell whether a peer subscribes to `topic` by its name."""
        return bool(self._asked[topic])

    def hear(self, word: bytes, peer: Peer | None) -> None:
        """Count what a subscriber says to an XPUB socket: byte 1 to subscribe or 0 to end, then the topic's name."""
        for topic in TOPICS:
            if word[1:] == topic:
                _count(self._asked[topic], peer, is_subscription=word[0] == 1)


def _count(asked: Counter[Peer | None], peer: Peer | None, *, is_subscription: bool) -> None:
    """Count one subscription, or its end, in `asked`."""
    if peer is not None and peer not in asked and (len(asked) >= LISTENERS or not is_subscription):
        peer = OTHERS
    if is_subscription:
        asked[peer] += 1
    elif peer is None or asked[peer] > 0:
        asked[peer] -= 1
    if asked.total() <= 0:
        asked.clear()


FIRST = ("stop", "disable")
"These are carried out before anything that waits."
_SIGNS = tuple(name.encode() for name in FIRST)
WAITING_PER_CLIENT = 64
WAITING = 1_024
"Requests that wait, of one connection and of all, in equal shares; more are dropped."


class Waiting(NamedTuple):
    """A request as it came, still encoded, the peer that sent it, and its connection, a descriptor."""

    envelope: list[bytes]
    data: bytes
    peer: Peer
    connection: int
    opens: int


class Requests:
    """The requests that wait for an answer; clients take turns. No sockets, no clock."""

    def __init__(self) -> None:
        self._waiting: dict[bytes, deque[Waiting]] = {}
        self.count = 0
        "How many wait."
        self.opens = 0
        "How often the gap has been told to open."

    def put(self, waiting: Waiting) -> bool:
        """Add a request behind its client's others; the client is the first frame of its envelope."""
        client, share = waiting.envelope[0], WAITING // (len(self._waiting) + 1)
        if len(self._waiting.get(client, ())) >= min(WAITING_PER_CLIENT, share) or self.count >= WAITING:
            return False
        self._waiting.setdefault(client, deque()).append(waiting)
        self.count += 1
        return True

    def next(self) -> Waiting | None:
        """Remove and return the next request; None where none waits."""
        for client, of_client in self._waiting.items():
            taken = of_client.popleft()
            del self._waiting[client]
            if of_client:
                self._waiting[client] = of_client
            self.count -= 1
            return taken
        return None


def may_go_first(data: bytes) -> bool:
    """Tell whether an encoded request may be a `stop` or `disable`: whether either word is anywhere in its bytes."""
    return any(sign in data for sign in _SIGNS)


_POLLIN = int(zmq.POLLIN)


class Arrivals:
    def __init__(self) -> None:
        self._poll = select.poll()
        self._sockets: dict[int, zmq.Socket[bytes]] = {}
        self._ready: set[zmq.Socket[bytes]] = set()

    def watch(self, socket: "zmq.Socket[bytes]") -> None:
        self._ready.add(socket)
        descriptor = int(socket.fileno())
        self._sockets[descriptor] = socket
        self._poll.register(descriptor, select.POLLIN)

    def leave(self, socket: "zmq.Socket[bytes]") -> None:
        descriptor = int(socket.fileno())
        self._ready.discard(socket)
        self._poll.unregister(descriptor)
        del self._sockets[descriptor]

    def look(self) -> None:
        for descriptor, _ in self._poll.poll(0):
            self._ready.add(self._sockets[descriptor])

    def touch(self, socket: "zmq.Socket[bytes]") -> None:
        """Count `socket` as ready after a send through it: sending clears its signal."""
        self._ready.add(socket)

    def has(self, socket: "zmq.Socket[bytes]") -> bool:
        if socket in self._ready and not zmq.zmq_poll([(socket, _POLLIN)], 0):
            self._ready.discard(socket)
        return socket in self._ready
