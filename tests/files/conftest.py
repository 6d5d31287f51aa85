"""The hostile files are those of the tool that measures how long, and with how much memory, they are refused."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
