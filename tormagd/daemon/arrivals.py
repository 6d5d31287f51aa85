"""Which of the daemon's sockets hold messages: one system call a beat, however many sockets there are."""

import select

import zmq

_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)


class Arrivals:
    """Knows which ZeroMQ sockets hold messages, by polling their descriptors once a beat."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._sockets: dict[int, zmq.Socket[bytes]] = {}
        self._ready: set[zmq.Socket[bytes]] = set()

    def watch(self, socket: "zmq.Socket[bytes]") -> None:
        """Watch `socket`, too."""
        self._ready.add(socket)
        descriptor = int(socket.fileno())
        self._sockets[descriptor] = socket
        self._poll.register(descriptor, select.POLLIN)

    def look(self) -> None:
        """Poll all watched sockets without waiting, and note which have signalled."""
        for descriptor, _ in self._poll.poll(0):
            self._ready.add(self._sockets[descriptor])

    def touch(self, socket: "zmq.Socket[bytes]") -> None:
        """Count `socket` as ready after a send through it: the send has cleared its signal."""
        self._ready.add(socket)

    def has(self, socket: "zmq.Socket[bytes]") -> bool:
        """Tell whether a message waits in a watched socket; False for one that is not watched."""
        if socket in self._ready and not int(socket.get(_EVENTS)) & _POLLIN:
            self._ready.discard(socket)
        return socket in self._ready
