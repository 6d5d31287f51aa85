"""Linear interpolation between tabulated points, and a low-pass filter of first order, on floats."""

from itertools import accumulate
from typing import Final, final

from tormagd.element.model.features import require_number
from tormagd.element.physics.errors import DomainError


def low_pass(value: float, towards: float, dt_s: float, time_s: float) -> float:
    """Return `value` after `dt_s` on its way to `towards` with the time constant `time_s` (implicit Euler)."""
    return value + dt_s / (time_s + dt_s) * (towards - value)


STRETCHES: Final = 1024
"A rising list is divided into this many stretches, so that few points share one and a search is short."
MIN_SPAN: Final = 1e-9
"The least span of a list, against a division by 0."
MIN_STEP: Final = 1e-200
"Neighbours that differ by less have no finite slope between them."


@final
class Rising:
    """A rising list of finite numbers (n >= 1) with a fast search for a value's place."""

    def __init__(self, values: list[float]) -> None:
        for place, value in enumerate(values):
            require_number("values", value)
            if place and 0.0 < abs(value - values[place - 1]) < MIN_STEP:
                raise DomainError("values", value, f"{values[place - 1]:g}, or {MIN_STEP:g} from there")
        self.values: Final = values
        self._per_unit: Final = STRETCHES / max(values[-1] - values[0], MIN_SPAN)
        points_in = [0] * (STRETCHES + 1)
        for value in values:
            points_in[min(max(int((value - values[0]) * self._per_unit), 0), STRETCHES)] += 1
        self._points_before: Final = list(accumulate(points_in[:-1], initial=0))

    def after(self, value: float) -> int:
        """Return how many numbers are at most `value`, as `bisect_right` does."""
        values = self.values
        stretch = (value - values[0]) * self._per_unit
        if not stretch >= 0.0:
            if stretch != stretch:  # NaN would be taken for the last place, which is the closest gap
                raise DomainError("value", value, "a number")
            return 0
        place = self._points_before[int(stretch) if stretch < STRETCHES else STRETCHES]
        while place < len(values) and values[place] <= value:
            place += 1
        return place


def interpolated(x: float, xs: Rising, ys: list[float]) -> float:
    """Return y at `x`, linear between the points and constant beyond the ends."""
    return interpolated_before(xs.after(x), x, xs, ys)


def interpolated_before(after: int, x: float, xs: Rising, ys: list[float]) -> float:
    """Return y at `x` for a known place `after` = `xs.after(x)`."""
    if after == 0:
        return ys[0]
    if after == len(ys):
        return ys[-1]
    values = xs.values
    low, before = values[after - 1], ys[after - 1]
    return (ys[after] - before) / (values[after] - low) * (x - low) + before


def at_step(steps: float, ys: list[float]) -> float:
    """Return y at `steps` from the first of the evenly spaced `ys`, linear between them."""
    if not steps < len(ys) - 1:
        if steps != steps:
            raise DomainError("steps", steps, "a number")
        return ys[-1]
    whole = int(steps)
    before = ys[whole]
    return (ys[whole + 1] - before) * (steps - whole) + before
