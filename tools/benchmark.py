"""Measurements of tormagd, one a subcommand. Each prints one JSON object with --json, a table otherwise.

Each also says, as `machine_us`, how fast interpreter and processor were meanwhile: the time of a fixed loop of pure
Python. A measurement is a module of `benchmarks` (`_` for `-`) with the functions of `judge/frame.py`.
"""

import sys
from collections.abc import Sequence

from judge.frame import parsed, told

from tormagd.ground.machine_loop import machine_us

MEASUREMENTS = {
    "inverse": "speed against accuracy of the searches for the field",
    "loop": "lateness of the control loop beside a bare timer",
    "latency": "from a setpoint to the first drive frame that reflects it",
    "step": "how fast and how exactly the gap follows, in virtual time, and how fast that runs",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one measurement; return 0, or 2 on a wrong command line."""
    module, options = parsed("benchmarks", MEASUREMENTS, arguments)
    before_us = machine_us()
    return told(module, options, module.measure(options) | {"machine_us": round((before_us + machine_us()) / 2.0, 1)})


if __name__ == "__main__":
    sys.exit(main())
