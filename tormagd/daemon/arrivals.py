"""Finds which of the daemon's sockets hold messages, with one system call a beat however many sockets there are."""

import select

import zmq

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
