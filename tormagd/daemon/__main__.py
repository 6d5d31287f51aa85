"""`tormagd`, as `python -m tormagd.daemon`."""

import sys
from functools import partial

from tormagd.ground.entry import run

command = partial(run, "tormagd.daemon.main")

if __name__ == "__main__":
    sys.exit(command())
