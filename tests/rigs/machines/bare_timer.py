"""A bare timer: it shows what this machine gives a thread that only asks to be woken every control period.

It has the daemon's heartbeat, event loop and scheduling, but no controller and no device: what it misses, the daemon
would have missed too. `benchmark loop` lets it carry the daemon's clients. As a script it stays on one processor until
SIGTERM, and prints when it stood still.
"""

import argparse
import asyncio
import json
import signal
import sys

import uvloop

from machines.host import PERIOD_NS, Stall
from tormagd.config import RealTime
from tormagd.daemon.realtime import Heartbeat, prepare
from tormagd.headroom.bare_timer import NS, beat


async def stalls_until_ended(realtime: RealTime) -> list[Stall]:
    prepare(realtime)
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    found: list[Stall] = []

    def on_beat(heartbeat: Heartbeat, beats: int, now_ns: int) -> None:
        first_due_ns = heartbeat.due_ns - (beats - 1) * PERIOD_NS
        if now_ns - first_due_ns > PERIOD_NS:
            found.append(Stall(first_due_ns / NS, now_ns / NS))

    print("stands", flush=True)
    await beat(PERIOD_NS, on_beat, ended)
    return found


def main() -> int:
    """Beat on one processor; print a line when it begins, and at its end the stalls as JSON pairs of seconds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cpu", type=int, required=True, help="the processor it stays on")
    parser.add_argument("--fifo", type=int, default=0, help="SCHED_FIFO priority; 0, or refused: ordinary scheduling")
    options = parser.parse_args()
    print(json.dumps(uvloop.run(stalls_until_ended(RealTime(fifo_priority=options.fifo, cpus=(options.cpu,))))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
