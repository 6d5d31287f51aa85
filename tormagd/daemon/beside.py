"""Processes beside the daemon's: each runs a module of its own, and talks in packets over the socket it is given."""

import select
import socket
import subprocess
import sys

MOST_PACKET = 65_536
"Bytes in one packet that is received, at most."


def start_beside(module: str, its_end: socket.socket) -> "subprocess.Popen[bytes]":
    """`python -m module DESCRIPTOR`."""
    number = its_end.fileno()
    command = [sys.executable, "-P", "-m", module, str(number)]
    # no signal for our group is meant for it: it ends when we have ended
    return subprocess.Popen(command, pass_fds=(number,), stdin=subprocess.DEVNULL, start_new_session=True)


class Beside:
    """Our end. To be made before this process becomes a real-time one, whose processors the other would have.

    Raises OSError where it does not start; from then on nothing does, and nothing waits.
    """

    def __init__(self, module: str) -> None:
        self.socket, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.setblocking(False)
        with its:
            self.process = start_beside(module, its)
        self.is_gone = False
        "Whether it was found to have ended, or this end was closed."

    def send(self, data: bytes) -> bool:
        """Whether it was taken: not where no more fits in now, or where it is more than a packet holds."""
        try:
            self.socket.send(data)
        except ConnectionError:
            self.is_gone = True
        except OSError:
            return False
        return not self.is_gone

    def receive(self, wait_s: float = 0.0) -> bytes | None:
        """The next packet; None where there is none, for `wait_s` or now."""
        try:
            if wait_s:
                select.select([self.socket], [], [], wait_s)
            data = self.socket.recv(MOST_PACKET)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        self.is_gone = self.is_gone or not data
        return data or None

    def close(self) -> None:
        """Closes this end, by which the other sees that it is over."""
        self.is_gone = True
        self.socket.close()
