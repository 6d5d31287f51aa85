"""The closed loop of one build, run in stretches as they are asked for on the standard input.

`benchmark virtual-time` starts one for each build, and lets them take turns.
"""

import gc
import json
import sys
import time

from benchmarks import virtual_time
from firmware_protocol.build import settle
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
    print(json.dumps(settle().is_compiled), flush=True)
    for line in sys.stdin:
        name, ticks = line.split()
        started_s = time.thread_time()
        runs[name](int(ticks))
        print((time.thread_time() - started_s) / int(ticks) * 1e6, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
