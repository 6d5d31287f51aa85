"""Types of the commands' options: a number outside its range is refused with what is allowed, and exit code 2."""

import argparse
from collections.abc import Callable

from tormagd.ctl.commands import Within


def whole(least: int, most: int) -> Callable[[str], int]:
    """Return a type for argparse: it reads a whole number from `least` to `most`, as `int` does.

    It raises ArgumentTypeError, which names the text and the range, for anything else.
    """

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r}: allowed is a whole number {least}..{most}")
        return value

    return number


def within(least: float, most: float, unit: str) -> Callable[[str], float]:
    """Return the type of a finite number in this range, of this unit. It raises ArgumentTypeError for any other
    text."""
    return Within(least, most, f" {unit}").__call__


SEED = whole(0, 2**31)
WORKERS = whole(1, 1024)
"Processes on one machine."
GAP_SPEED = within(1e-6, 1e4, "mm/s")
