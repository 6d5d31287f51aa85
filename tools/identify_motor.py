"""As `tormag-lab identify-motor`."""

import sys

from tormagd.lab.main import run

if __name__ == "__main__":
    sys.exit(run("identify-motor", sys.argv[1:]))
