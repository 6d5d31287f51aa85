"""Quantities over time in a few rows of block characters."""

import math
from collections.abc import Callable, Sequence

EIGHTHS = " ▁▂▃▄▅▆▇█"


def columns(
    times_ns: Sequence[int],
    values: Sequence[float | None],
    count: int,
    period_ns: int,
    of_column: Callable[[list[float]], float],
) -> list[float | None]:
    """The newest `count` periods, the oldest first: what `of_column` makes of each one's values, None where none is.

    Periods are those of the clock, so that a column stays what it is while the picture moves on.
    """
    if not times_ns:
        return [None] * count
    first = times_ns[-1] // period_ns - count + 1
    gathered: list[list[float]] = [[] for _ in range(count)]
    for t_ns, value in zip(times_ns, values, strict=True):
        column = t_ns // period_ns - first
        if 0 <= column < count and value is not None and math.isfinite(value):
            gathered[column].append(value)
    return [of_column(known) if known else None for known in gathered]


def span(values: Sequence[float | None], least: float) -> tuple[float, float]:
    """The range that all values lie in, no narrower than `least`: noise is not to look like a signal."""
    known = [value for value in values if value is not None]
    if not known:
        return 0.0, least
    low, high = min(known), max(known)
    wider = max(least - (high - low), 0.0) / 2.0
    return low - wider, high + wider


def sparkline(values: Sequence[float | None], low: float, high: float, rows: int) -> list[str]:
    """`rows` lines of bars from `low` (one eighth of a character) to `high` (all rows), the top line first."""
    steps = len(EIGHTHS) - 1
    full = rows * steps
    eighths = [
        0 if value is None else 1 + round((full - 1) * min(max((value - low) / (high - low), 0.0), 1.0))
        for value in values
    ]
    return [
        "".join(EIGHTHS[min(max(height - row * steps, 0), steps)] for height in eighths)
        for row in reversed(range(rows))
    ]
