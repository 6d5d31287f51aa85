"""As `tormag-lab reproduce-thesis`."""

import sys

from tormagd.lab.main import run

if __name__ == "__main__":
    sys.exit(run("reproduce-thesis", sys.argv[1:]))
