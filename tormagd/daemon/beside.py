"""Processes beside the daemon's: each runs a module of its own, and talks over the socket that it is given."""

import socket
import subprocess
import sys


def start_beside(module: str, its_end: socket.socket) -> "subprocess.Popen[bytes]":
    """`python -m module DESCRIPTOR`. To be called before this process becomes a real-time one, whose processors it
    would have."""
    number = its_end.fileno()
    command = [sys.executable, "-P", "-m", module, str(number)]
    # no signal for our group is meant for it: it ends when we have ended
    return subprocess.Popen(command, pass_fds=(number,), stdin=subprocess.DEVNULL, start_new_session=True)
