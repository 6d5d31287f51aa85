"""Runs long, destructive cases, one at a time: does it hold?

The tests run the same cases with smaller counts. A case in real time reports what its host took meanwhile. An
unexpected fault is blamed on the host if a bare timer, too, stood still for half of the time that a device waits. Exit
status 0 if all held.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from typing import Any, NamedTuple

from machines.host import HOST_SHARE, HostWatch

DEVICE_WAITS_MS = 50.0
"For a command, before it opens by itself."


class Case(NamedTuple):
    """A module of `endurance`, how much is taken `in_full`, and what else its `run` needs. One `on_stand` needs a
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


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    counts = ", ".join(f"{name} {case.in_full:,} {case.of}" for name, case in CASES.items())
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--count", type=int, help=f"default: {counts}")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn (1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    count = CASES[options.case].in_full if options.count is None else options.count
    if count < 1:
        parser.error(f"--count {count}: allowed is at least 1")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what was begun is ended
    result = measured(options.case, count, options.seed)
    print(json.dumps(result, indent=None if options.json else 1))
    return 0 if result["passed"] else 1


def measured(name: str, count: int, seed: int) -> dict[str, Any]:
    case = CASES[name]
    run = import_module(f"endurance.{case.module}").run
    figures = _watched(run, count, seed) if case.on_stand else run(*case.more, count, seed)
    return {"case": name, "count": count, "seed": seed, "passed": not figures["failures"]} | figures


def _watched(run: Callable[..., dict[str, Any]], count: int, seed: int) -> dict[str, Any]:
    from endurance.stand import FIFO_PRIORITY, Stand

    with HostWatch(FIFO_PRIORITY + 10, sys.stderr) as watch:
        with ExitStack() as stack:
            stand = Stand(stack)
            start_s = time.monotonic()
            figures = run(stand, count, seed)
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


if __name__ == "__main__":
    sys.exit(main())
