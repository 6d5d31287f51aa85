"""The door of an endpoint: libzmq accepts one connection each time that it is opened.

libzmq accepts whatever comes, and ends the process where no descriptor is left for it (`ipc_listener.cpp`). It watches
its listening sockets through epoll. Here each of them becomes one-shot there (EPOLLONESHOT, `epoll_ctl(2)`); what
epoll has to be told of it anew is in /proc/self/fdinfo (`proc(5)`).
"""

import contextlib
import ctypes
import platform
import re
import select
import struct
import time
from pathlib import Path

_EVENT = struct.Struct("=IQ" if platform.machine() == "x86_64" else "@IQ")
"`struct epoll_event`, which is packed on x86-64 only."
_libc = ctypes.CDLL(None, use_errno=True)


def door(listening: int) -> tuple[int, int, int]:
    """Return what `let_in` takes: the epoll set in which the descriptor `listening` is watched, itself,
    its data there."""
    entry = re.compile(rf"^tfd: +{listening} +events: +(\w+) +data: +(\w+)", re.MULTILINE)
    for _ in range(1_000):  # libzmq's thread takes up a new socket in its own time
        for path in Path("/proc/self/fdinfo").iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed meanwhile
                found = entry.search(path.read_text(encoding="ascii"))
                if found and int(found[1], 16) & select.EPOLLIN:
                    return int(path.name), listening, int(found[2], 16)
        time.sleep(0.001)  # with SCHED_FIFO it would wait for this thread
    raise OSError("connections cannot be bounded: /proc/self/fdinfo names no epoll set; mount /proc")


def let_in(epoll: int, listening: int, data: int) -> None:
    """Let libzmq accept one connection, the one that waits or comes next."""
    # 3: EPOLL_CTL_MOD
    if _libc.epoll_ctl(epoll, 3, listening, _EVENT.pack(select.EPOLLIN | select.EPOLLONESHOT, data)):
        raise OSError(ctypes.get_errno(), "epoll_ctl")
