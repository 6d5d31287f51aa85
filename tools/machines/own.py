"""Runs a module as on a machine of its own: FIFO and locked memory, where the kernel grants them.

`own.py PRIORITY MODULE [ARGUMENT ...]`. What stands for another computer (the device, the robot that publishes)
would otherwise wait for this one's processors, and for its pages: where the kernel takes idle ones back, a page that
returns from a disk is later than the 50 ms after which a state is stale.
"""

import runpy
import sys

from tormagd.config import RealTime
from tormagd.daemon.realtime import prepare


def own_machine(priority: int, module: str, *arguments: str) -> list[str]:
    """What the interpreter is given to run `module` so."""
    return ["-P", __file__, str(priority), module, *arguments]


if __name__ == "__main__":
    prepare(RealTime(fifo_priority=int(sys.argv[1]), lock_memory=True))
    del sys.argv[:2]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
