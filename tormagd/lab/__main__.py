"""`python -m tormagd.lab`, as `tormag-lab`."""

import sys

from tormagd.lab.main import main

if __name__ == "__main__":
    sys.exit(main())
