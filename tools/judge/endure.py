"""Runs long, destructive cases, one at a time: does it hold?

The tests run the same cases with smaller counts. A case in real time reports what its host took meanwhile. An
unexpected fault is blamed on the host if a bare timer, too, stood still for half of the time that a device waits.
"""

import argparse
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from typing import NamedTuple

from machines.host import HOST_SHARE, HostWatch

from judge.frame import count
from judge.stand import FIFO_PRIORITY, Stand
from tormagd.lab.arrays import Json

DEVICE_WAITS_MS = 50.0
"For a command, before it opens by itself."


class Case(NamedTuple):
    """A module of this room, how much is taken `in_full`, and what else its `run` needs. One `on_stand` needs a
    daemon and a device.
    """

    module: str
    in_full: int
    of: str
    more: tuple[str, ...] = ()
    on_stand: bool = False


CASES = {
    "fuzz": Case("fuzz", 1_800, "seconds of bytes"),
    "replug-serial": Case("replug", 200, "cycles", ("serial",)),
    "replug-can": Case("replug", 200, "cycles", ("can",)),
    "stalls": Case("stalls", 400, "stops", on_stand=True),
    "soak": Case("soak", 3_600, "half seconds", on_stand=True),
    "siege": Case("siege", 200, "stops beside each attack", on_stand=True),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    counts = ", ".join(f"{name} {case.in_full:,} {case.of}" for name, case in CASES.items())
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--count", type=count, help=f"default: {counts}")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn (1)")


def measure(options: argparse.Namespace) -> Json:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what was begun is ended
    return measured(options.case, options.count or CASES[options.case].in_full, options.seed)


def measured(name: str, times: int, seed: int) -> Json:
    case = CASES[name]
    run = import_module(f"judge.{case.module}").run
    figures = _watched(run, times, seed) if case.on_stand else run(*case.more, times, seed)
    return {"case": name, "count": times, "seed": seed, "passed": not figures["failures"]} | figures


def _watched(run: Callable[..., Json], times: int, seed: int) -> Json:
    with HostWatch(FIFO_PRIORITY + 10, sys.stderr) as watch:
        with ExitStack() as stack:
            stand = Stand(stack)
            start_s = time.monotonic()
            figures = run(stand, times, seed)
            figures["failures"] += stand.unhandled()
        watch.end()
    figures["host"] = str(watch.between(start_s, time.monotonic()))
    figures["held_against_host"] = []
    for fault, from_s, to_s in stand.latched:
        stood_ms = watch.between(from_s, to_s).bare_worst_ms
        is_hosts = stood_ms >= HOST_SHARE * DEVICE_WAITS_MS
        figures["held_against_host" if is_hosts else "failures"].append(
            f"fault {fault}, while a bare timer stood still for {stood_ms:.0f} ms"
        )
    return figures
