"""As `tormag-lab bound`."""

import sys

from tormagd.lab.main import run

if __name__ == "__main__":
    sys.exit(run("bound", sys.argv[1:]))
