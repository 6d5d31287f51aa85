"""Which of the daemon's sockets hold messages: one system call a beat, however many sockets there are."""

import select

import zmq

_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)


class Arrivals:
    """Watches ZeroMQ's sockets by their descriptors.

    Such a descriptor tells once that something has come, and whatever is done with the socket takes that word away
    (zmq_getsockopt, ZMQ_FD). So a socket that has told counts as ready until it was found empty.
    """

    def __init__(self) -> None:
        self._poll = select.poll()
        self._sockets: dict[int, zmq.Socket[bytes]] = {}
        self._ready: set[zmq.Socket[bytes]] = set()

    def watch(self, socket: "zmq.Socket[bytes]") -> None:
        """Watches this socket, too. Its first message may come without a word: it is ready until found empty."""
        self._ready.add(socket)
        descriptor = int(socket.fileno())
        self._sockets[descriptor] = socket
        self._poll.register(descriptor, select.POLLIN)

    def look(self) -> None:
        """Asks which sockets have news: once a beat."""
        for descriptor, _ in self._poll.poll(0):
            self._ready.add(self._sockets[descriptor])

    def touch(self, socket: "zmq.Socket[bytes]") -> None:
        """Something was sent through this socket: what has come meanwhile does not tell any more."""
        self._ready.add(socket)

    def has(self, socket: "zmq.Socket[bytes]") -> bool:
        """Whether a message waits in this socket."""
        if socket not in self._ready:
            return False
        if is_readable(socket):
            return True
        self._ready.discard(socket)
        return False


def is_readable(socket: "zmq.Socket[bytes]") -> bool:
    """Whether a message waits in a socket that nobody watches. Asking takes a third of what an exception does."""
    return bool(int(socket.get(_EVENTS)) & _POLLIN)
