"""The judges, one a module: devices, signals, hands and disturbances, and what came of them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "tests" / "rigs"))  # what tests and tools both play with
