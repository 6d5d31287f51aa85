"""A function of one variable as a table, where a tick has no time to compute it."""

from typing import final


@final
class Curve:
    """A function's values at equal distances from `start` to `end`, linear between them."""

    def __init__(self, values: list[float], start: float, end: float) -> None:
        self._start = start
        self._per_unit = (len(values) - 1) / (end - start)
        self._last = len(values) - 2
        self._values = values

    def at(self, x: float) -> float:
        """Return the value at `x`; beyond both ends the outermost pieces go on."""
        place = (x - self._start) * self._per_unit
        index = min(max(int(place), 0), self._last)
        values = self._values
        low = values[index]
        return low + (values[index + 1] - low) * (place - index)
