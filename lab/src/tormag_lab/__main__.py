"""`tormag-lab`, as `python -m tormag_lab`."""

import sys
from functools import partial

from tormagd.ground.entry import run

command = partial(run, "tormag_lab.main")

if __name__ == "__main__":
    sys.exit(command())
