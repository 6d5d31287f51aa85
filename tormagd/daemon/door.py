"""The door of an endpoint: libzmq accepts one connection each time that it is opened.

libzmq accepts whatever comes, and ends the process where no descriptor is left for it (`ipc_listener.cpp`). It watches
its listening sockets through epoll. Here each of them becomes one-shot there (EPOLLONESHOT, `epoll_ctl(2)`); what
epoll has to be told of it anew is in /proc/self/fdinfo (`proc(5)`).
"""

import contextlib
import ctypes
import os
import platform
import re
import select
import struct
import time
from pathlib import Path

PATIENCE_S = 1.0
"libzmq's thread watches a new socket within this time."
_EVENT = struct.Struct("=IQ" if platform.machine() == "x86_64" else "@IQ")
"`struct epoll_event`, which is packed on x86-64 only."
_MOD = 3
_libc = ctypes.CDLL(None, use_errno=True)


class Door:
    """The listening socket `descriptor` of libzmq. Raises OSError where no epoll set is seen to watch it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self.is_open = descriptor, False
        until_s = time.monotonic() + PATIENCE_S
        while (place := _place(descriptor)) is None:
            if time.monotonic() > until_s:
                raise OSError("connections cannot be bounded: /proc/self/fdinfo names no epoll set; mount /proc")
            time.sleep(1e-4)
        self._epoll, self._data = place

    def open(self) -> None:
        """Let libzmq accept one connection, the one that waits or comes next, unless it may already."""
        if not self.is_open:
            self.is_open = True
            event = _EVENT.pack(select.EPOLLIN | select.EPOLLONESHOT, self._data)
            if _libc.epoll_ctl(self._epoll, _MOD, self._descriptor, event):
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _place(descriptor: int) -> tuple[int, int] | None:
    """Return the epoll set in which `descriptor` is watched for what comes, and its data there; None where in none."""
    entry = re.compile(rf"^tfd: +{descriptor} +events: +(\w+) +data: +(\w+)", re.MULTILINE)
    for path in Path("/proc/self/fdinfo").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            found = entry.search(path.read_text(encoding="ascii"))
            if found and int(found[1], 16) & select.EPOLLIN:
                return int(path.name), int(found[2], 16)
    return None
