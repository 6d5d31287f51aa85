"""The subcommands of `benchmark.py`."""

import judge  # noqa: F401  # it also finds the rigs
