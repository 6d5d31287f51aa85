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
