"""The daemon, with each of its writes timed: `benchmark loop` runs it in place of `tormagd`, of any checkout.

`written.py TIMES [tormagd's arguments]`. What a write to the device takes is the kernel's and the driver's
doing, and part of a control tick's time. TIMES gets pairs of int64 when the daemon has ended: when a write began,
CLOCK_MONOTONIC, and how long it took, ns. Taking the time costs 0.3 us a write.
"""

import os
import sys
import time
from array import array
from pathlib import Path

write, now_ns = os.write, time.monotonic_ns
begun_ended: list[tuple[int, int]] = []


def timed(fd: int, data: bytes) -> int:
    """As os.write."""
    begun_ns = now_ns()
    written = write(fd, data)
    begun_ended.append((begun_ns, now_ns()))
    return written


def main() -> int:
    """The daemon's own exit code."""
    os.write = timed  # type: ignore[assignment]
    from tormagd.daemon.main import main as daemon  # from now on: what it imports may keep the function

    try:
        return daemon(sys.argv[2:])
    finally:
        times = array("q", [value for begun_ns, ended_ns in begun_ended for value in (begun_ns, ended_ns - begun_ns)])
        Path(sys.argv[1]).write_bytes(times.tobytes())


if __name__ == "__main__":
    sys.exit(main())
