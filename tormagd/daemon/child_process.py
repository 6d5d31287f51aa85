"""Processes beside the daemon: each runs a module of its own and exchanges packets over a socket."""

import select
import socket
import subprocess
import sys

MAX_PACKET = 65_536


def start_child(module: str, its_end: socket.socket, *files: int) -> "subprocess.Popen[bytes]":
    """Start `python -m module DESCRIPTOR...` with the descriptors of `its_end` and of `files`."""
    numbers = its_end.fileno(), *files
    command = [sys.executable, "-P", "-m", module, *map(str, numbers)]
    # a session of its own: signals to our process group must not end it before us
    return subprocess.Popen(command, pass_fds=numbers, stdin=subprocess.DEVNULL, start_new_session=True)


class ChildProcess:
    """Our end of a process that runs `module`, with these `files` open, and of the packet socket to it."""

    def __init__(self, module: str, *files: int) -> None:
        self.socket, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.setblocking(False)
        with its:
            self.process = start_child(module, its, *files)
        self.is_gone = False

    def send(self, data: bytes) -> bool:
        """Send one packet without waiting, and return whether the socket took it."""
        try:
            self.socket.send(data)
        except ConnectionError:
            self.is_gone = True
        except OSError:
            return False
        return not self.is_gone

    def receive(self, wait_s: float = 0.0) -> bytes | None:
        try:
            if wait_s:
                select.select([self.socket], [], [], wait_s)
            data = self.socket.recv(MAX_PACKET)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        self.is_gone = self.is_gone or not data
        return data or None

    def close(self) -> None:
        """Close our end of the socket, which tells the process to end."""
        self.is_gone = True
        self.socket.close()
