"""The wire of a pty: workers of the kernel carry its bytes, at ordinary priority, as those of a USB adapter too.

With all processors busy they came up to 90 ms late while daemon and device kept every beat (Linux 6.18). The device's
states are stale then, whatever the daemon does. Where it is the daemon that is measured, and the kernel grants it, the
workers get a real-time priority. New ones are made at any time, so they are looked for again and again.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

WORKERS = "kworker/u"
"Those that are bound to no processor: a terminal's bytes wait for one of them (drivers/tty/tty_buffer.c)."
LOOK_S = 0.25


@contextlib.contextmanager
def carried(priority: int) -> Iterator[bool]:
    """The workers at this SCHED_FIFO priority meanwhile; tells whether the kernel granted it."""
    keeper = subprocess.Popen([sys.executable, "-P", __file__, str(priority)], stdout=subprocess.PIPE, text=True)
    try:
        assert keeper.stdout is not None
        yield keeper.stdout.readline().strip() == "granted"
    finally:
        keeper.terminate()
        keeper.wait()


def schedule(policy: int, priority: int) -> bool:
    """Puts every worker under the policy; False where that is not granted."""
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # they come and go
            if (process / "comm").read_text(encoding="utf-8", errors="replace").startswith(WORKERS):
                try:
                    os.sched_setscheduler(int(process.name), policy, os.sched_param(priority))
                except PermissionError:
                    return False
    return True


def main() -> int:
    """Until SIGTERM; then they are as they were."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    is_granted = schedule(os.SCHED_FIFO, int(sys.argv[1]))
    print("granted" if is_granted else "refused", flush=True)
    while is_granted and not ended.wait(LOOK_S):
        schedule(os.SCHED_FIFO, int(sys.argv[1]))
    schedule(os.SCHED_OTHER, 0)
    return 0


if __name__ == "__main__":
    sys.exit(main())
