"""The wire of a pty: kernel workers carry its bytes at ordinary priority, as those of a USB adapter do.

With all processors busy they came up to 90 ms late while daemon and device kept every beat (Linux 6.18), and the
device's states are stale then. To measure the daemon alone, the workers get a real-time priority, if the kernel grants
it. New ones are made at any time, so they are looked for again and again.
"""

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

WORKERS = "kworker/u"
"Unbound workers: a terminal's bytes wait for one of them (drivers/tty/tty_buffer.c)."
LOOK_S = 0.25


@contextlib.contextmanager
def carried(priority: int) -> Iterator[None]:
    """Keep the workers at this SCHED_FIFO priority, if granted; afterwards at ordinary priority."""
    ended = threading.Event()
    keeper = threading.Thread(target=keep, args=(priority, ended))
    keeper.start()
    try:
        yield
    finally:
        ended.set()
        keeper.join()


def keep(priority: int, ended: threading.Event) -> None:
    while schedule(os.SCHED_FIFO, priority) and not ended.wait(LOOK_S):
        pass
    schedule(os.SCHED_OTHER, 0)


def schedule(policy: int, priority: int) -> bool:
    for worker in workers().values():
        with contextlib.suppress(ProcessLookupError):  # they come and go
            try:
                os.sched_setscheduler(worker, policy, os.sched_param(priority))
            except PermissionError:
                return False
    return True


def workers() -> dict[str, int]:
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # they come and go
            if (process / "comm").read_text(encoding="utf-8", errors="replace").startswith(WORKERS):
                found[f"wire's worker {process.name}"] = int(process.name)
    return found
