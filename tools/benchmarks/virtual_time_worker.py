"""The closed loop of one build of one checkout, run in stretches as they are asked for on the standard input.

`benchmark virtual-time` starts one for everything that it compares, and lets them take turns. The tools and the package
are those of PYTHONPATH, maybe of an older checkout: of these nothing is used but how it makes its two loops.
"""

import gc
import json
import sys
import time
from pathlib import Path

from benchmarks import virtual_time
from firmware_protocol.build import settle
from tormagd import closed_loop
from tormagd.config import Config


def main() -> int:
    """Answers each name of a loop and number of ticks with the processor time of a tick, us, until the input ends."""
    plant = sys.argv[1]
    runs = {
        "whole_core": virtual_time.force_loop(Config(), plant),
        "position_loop": virtual_time.gap_loop(Config(), plant),
    }
    gc.collect()
    gc.freeze()  # what was imported is no garbage; a daemon does the same
    # by a module of it: an empty folder of the package's name would pass for the package itself
    package = Path(str(closed_loop.__file__)).parent
    print(json.dumps({"compiled": settle().is_compiled, "package": str(package)}), flush=True)
    for line in sys.stdin:
        name, ticks = line.split()
        started_s = time.thread_time()
        runs[name](int(ticks))
        print((time.thread_time() - started_s) / int(ticks) * 1e6, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
