"""Straight lines between tabulated points, on floats: NumPy takes longer than this for one point."""

from bisect import bisect_right


def interpolated(x: float, xs: list[float], ys: list[float]) -> float:
    """Linear between the points (n, n) of rising `xs`, and the outermost `ys` beyond them."""
    after = bisect_right(xs, x)
    if after == 0:
        return ys[0]
    if after == len(xs):
        return ys[-1]
    low = xs[after - 1]
    return (ys[after] - ys[after - 1]) / (xs[after] - low) * (x - low) + ys[after - 1]


def at_step(steps: float, ys: list[float]) -> float:
    """The same of evenly spaced points: so many steps, 0 or more, behind the first of `ys` (n)."""
    whole = int(steps)
    if whole >= len(ys) - 1:
        return ys[-1]
    before = ys[whole]
    return (ys[whole + 1] - before) * (steps - whole) + before
