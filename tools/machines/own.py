"""Runs a module as on a machine of its own: FIFO and locked memory, where the kernel grants them.

`own.py PRIORITY MODULE [ARGUMENT ...]`. What stands for another computer (the device, the robot that publishes)
would otherwise wait for this one's processors, and for its pages: where the kernel takes idle ones back, a page that
returns from a disk is later than the 50 ms after which a state is stale.
"""

import runpy
import signal
import subprocess
import sys
from typing import Any

from tormagd.config import RealTime
from tormagd.daemon.realtime import prepare

PATIENCE_S = 20.0


def own_machine(priority: int, module: str, *arguments: str) -> list[str]:
    """What the interpreter is given to run `module` so."""
    return ["-P", __file__, str(priority), module, *arguments]


def end(child: "subprocess.Popen[Any]", number: signal.Signals = signal.SIGTERM) -> int:
    """Asks a process that we began for its orderly end, and kills it where that does not come; its exit code."""
    child.send_signal(number)
    try:
        return child.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


if __name__ == "__main__":
    prepare(RealTime(fifo_priority=int(sys.argv[1]), lock_memory=True))
    del sys.argv[:2]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
