"""Who troubles the daemon gets nowhere: strangers, floods, hostile messages; `stop` is heard beside 100 clients.

Each part starts a daemon on a simulated device and counts what becomes of it; one that judges control's time measures
the same without the trouble, or a bare timer beside it, in the same run. What else runs on the machine spoils that all
the same, so each line says what bare timers on every processor missed meanwhile, and a fault is held against the
machine where they stood still so long that the device or the daemon had to latch. Exit status 0 if all held. The whole
takes about 20 minutes.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

from intrusion import floods, messages, pulse_from_afar, stop_lane, strangers
from intrusion.besieged import FAULT, FIFO_PRIORITY, Line
from machines.host import HOST_SHARE, Host, HostWatch
from machines.wire import carried

from tormagd.config import Device

PARTS: dict[str, Callable[[float], Line]] = {
    "strangers": strangers.measure,
    "pulse": pulse_from_afar.measure,
    "stop": stop_lane.measure,
    "floods": floods.measure,
    "messages": messages.measure,
}


def main(arguments: list[str] | None = None) -> int:
    """Runs the named parts, or all; 0 if all held, 1 if not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default all")
    parser.add_argument("--share", type=float, default=1.0, help="of the counts and times, to try it (1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.part if name not in PARTS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: allowed are {', '.join(PARTS)}")
    if not 0.0 < options.share <= 1.0:
        parser.error(f"--share {options.share:g}: allowed is above 0, to 1")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what was changed of the machine is put back
    lines = {}
    for name in options.part or PARTS:
        lines[name] = watched(PARTS[name], options.share)
        if not options.json:
            print_line(*lines[name])
    result = as_json(lines)
    if options.json:
        print(json.dumps(result))
    return 0 if result["passed"] else 1


def watched(part: Callable[[float], Line], share: float) -> tuple[Line, Host]:
    """What a part came to, and what the machine took meanwhile."""
    with carried(FIFO_PRIORITY - 1), HostWatch(FIFO_PRIORITY + 1, sys.stderr) as watch:
        start_s = time.monotonic()
        line = part(share)
        end_s = time.monotonic()
    host = watch.between(start_s, end_s)
    return attributed(line, host), host


def attributed(line: Line, host: Host) -> Line:
    """With the faults held against the machine, where it stood still for long enough."""
    if host.bare_worst_ms < HOST_SHARE * Device().command_timeout_ms:
        return line
    latched = [failure for failure in line.failures if failure.startswith(FAULT)]
    others = [failure for failure in line.failures if failure not in latched]
    return line._replace(failures=others, held_against_machine=latched)


def as_json(lines: dict[str, tuple[Line, Host]]) -> dict[str, Any]:
    """What is printed with --json: lines with what the machine took."""
    failures = [failure for line, _ in lines.values() for failure in line.failures]
    return {
        "lines": {name: line._asdict() | {"host": host._asdict()} for name, (line, host) in lines.items()},
        "failures": failures,
        "passed": not failures,
    }


def print_line(line: Line, host: Host) -> None:
    """One line for people."""
    print(f"{line.says}; {host}", flush=True)
    for failure in line.failures:
        print(f"  FAILED: {failure}", flush=True)
    for fault in line.held_against_machine:
        print(f"  held against the machine: {fault}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
