"""The parts of `make run`."""

import judge  # noqa: F401  # it also finds the rigs
