"""`python -m tormag_lab`, as `tormag-lab`."""

import sys

from tormag_lab.main import main

if __name__ == "__main__":
    sys.exit(main())
