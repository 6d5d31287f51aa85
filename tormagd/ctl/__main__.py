"""`tormagctl`, as `python -m tormagd.ctl`."""

import sys
from functools import partial

from tormagd.ground.entry import run

command = partial(run, "tormagd.ctl.main")

if __name__ == "__main__":
    sys.exit(command())
