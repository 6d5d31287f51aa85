"""Which sockets hold messages, and requests that wait. Clients take turns; `stop` and `disable` overtake all."""

import select
from collections import deque
from typing import NamedTuple

import zmq

from tormagd.daemon.peers import Peer

FIRST = ("stop", "disable")
"These are carried out before anything that waits."
_SIGNS = tuple(name.encode() for name in FIRST)
WAITING_PER_CLIENT = 64
WAITING = 1_024
"Requests that wait at most, of one connection and of all; what is beyond is dropped."


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
        client = waiting.envelope[0]
        if self.count >= WAITING or len(self._waiting.get(client, ())) >= WAITING_PER_CLIENT:
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


_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)


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

    def look(self) -> None:
        for descriptor, _ in self._poll.poll(0):
            self._ready.add(self._sockets[descriptor])

    def touch(self, socket: "zmq.Socket[bytes]") -> None:
        """Count `socket` as ready after a send through it: sending clears its signal."""
        self._ready.add(socket)

    def has(self, socket: "zmq.Socket[bytes]") -> bool:
        if socket in self._ready and not int(socket.get(_EVENTS)) & _POLLIN:
            self._ready.discard(socket)
        return socket in self._ready
