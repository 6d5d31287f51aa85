"""Requests that wait to be answered: every client in its turn, and none that a `stop` or `disable` has overtaken."""

from collections import deque
from typing import NamedTuple

from tormagd.daemon.tally import Peer

FIRST = ("stop", "disable")
"These are carried out before anything that waits."
_SIGNS = tuple(name.encode() for name in FIRST)
WAITING_PER_CLIENT = 64
WAITING = 1_024
"Requests that wait at most, of one connection and of all; what is beyond is dropped."


class Waiting(NamedTuple):
    """A request as it came, and who sent it. `opens` is how often the gap had been told to open by then."""

    envelope: list[bytes]
    data: bytes
    peer: Peer
    opens: int


class Requests:
    """The waiting requests. No sockets, no clock."""

    def __init__(self) -> None:
        self._waiting: dict[bytes, deque[Waiting]] = {}
        self.count = 0
        "How many wait."
        self.opens = 0
        "How often the gap has been told to open."

    def put(self, waiting: Waiting) -> bool:
        """Lets a request wait for its client's turn; False where too many wait."""
        client = waiting.envelope[0]
        if self.count >= WAITING or len(self._waiting.get(client, ())) >= WAITING_PER_CLIENT:
            return False
        self._waiting.setdefault(client, deque()).append(waiting)
        self.count += 1
        return True

    def next(self) -> Waiting | None:
        """The one whose turn it is: one of each client, then the next of each."""
        for client, of_client in self._waiting.items():
            taken = of_client.popleft()
            del self._waiting[client]
            if of_client:
                self._waiting[client] = of_client
            self.count -= 1
            return taken
        return None


def may_go_first(data: bytes) -> bool:
    """Whether this may be one of FIRST: a msgpack string holds its characters as they are, however it is packed."""
    return any(sign in data for sign in _SIGNS)
