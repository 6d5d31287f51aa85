"""`make run`: see `demo/main.py`."""

import sys

from demo.main import begin

if __name__ == "__main__":
    sys.exit(begin())
