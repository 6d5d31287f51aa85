"""Measurements of tormagd, one a subcommand. Each prints one JSON object with --json, a table otherwise.

Each also says, as `machine_us`, how fast interpreter and processor were meanwhile: the time of a fixed loop of pure
Python. A measurement is a module of `benchmarks` (`_` for `-`) with `add_arguments(parser)` and `measure(options)`,
which returns the object.
"""

import argparse
import importlib
import json
import sys
from collections.abc import Sequence

from tormag_lab.told import lines
from tormagd.headroom.machine_loop import machine_us

MEASUREMENTS = {
    "inverse": "speed against accuracy of the searches for the field",
    "scenes": "what each scene costs with all terms and with those it requires",
    "loop": "lateness of the control loop beside a bare timer",
    "latency": "from a setpoint to the first drive frame that reflects it",
    "step": "how fast and how exactly the gap follows, in virtual time",
    "virtual-time": "how much faster than real time that is",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one measurement; return 0, or 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="benchmark.py", description=(__doc__ or "").splitlines()[0])
    measurements = parser.add_subparsers(dest="measurement", required=True)
    modules = {}
    for name, says in MEASUREMENTS.items():
        modules[name] = importlib.import_module(f"benchmarks.{name.replace('-', '_')}")
        subparser = measurements.add_parser(name, help=says, description=modules[name].__doc__)
        subparser.add_argument("--json", action="store_true", help="print JSON")
        modules[name].add_arguments(subparser)
    options = parser.parse_args(arguments)
    module = modules[options.measurement]
    before_us = machine_us()
    result = module.measure(options)
    result["machine_us"] = round((before_us + machine_us()) / 2.0, 1)
    print(json.dumps(result) if options.json else "\n".join(lines(result)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
