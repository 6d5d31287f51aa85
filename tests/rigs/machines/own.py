"""Runs a module as on a machine of its own: FIFO and locked memory, if the kernel grants them.

`own.py PRIORITY [--waits] MODULE [ARGUMENT ...]`. What stands for another computer (the device, the robot that
publishes) would otherwise wait for this one's processors and pages; a page that returns from a disk comes too late.
"""

import importlib
import runpy
import signal
import sys

from tormagd.config import RealTime
from tormagd.daemon.realtime import prepare


def own_machine(priority: int, module: str, *arguments: str, waits: bool = False) -> list[str]:
    return ["-P", __file__, str(priority), *["--waits"][: int(waits)], module, *arguments]


if __name__ == "__main__":
    prepare(RealTime(fifo_priority=int(sys.argv[1]), lock_memory=True))
    del sys.argv[:2]
    if sys.argv[0] == "--waits":
        del sys.argv[0]
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
        module = importlib.import_module(sys.argv[0])
        print("waits", flush=True)
        signal.sigwait({signal.SIGUSR1})
        sys.exit(module.main(sys.argv[1:]))
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
