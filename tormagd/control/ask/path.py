"""The path of a gap that misses least of a force known ahead, at the gap's speeds of closing and opening.

    least sum of weight (path - wanted)^2    with    -sure <= path' <= opening

The sum is over TIMES_S. A weight is a point's share of the time, times the square of |dF/dgap|, so newtons are missed
least. A dynamic programme solves this exactly, backwards over the points (Johnson, J. Comput. Graph. Stat. 22, 2013,
for the fused lasso, the dual).
"""

from typing import Final

from tormagd.control.records import GapSpeeds
from tormagd.element.model.force_curve import within

PATH_S: Final = [0.0, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03]
"When, after the moment planned for, a plan looks at the force to come."
TIMES_S: Final = [*PATH_S, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25, 0.33, 0.4]
"When what is known ahead is looked at. By the last the gap crosses a third of its stroke."
LASTS_S: Final = [
    0.5 * (after_s - before_s)
    for before_s, after_s in zip([0.0, *TIMES_S[:-1]], [*TIMES_S[1:], TIMES_S[-1]], strict=True)
]
"Each of TIMES_S stands for the time from half way to the one before to half way to the next."
SPEEDING_UP_S: Final = 0.025
"Time constant of the gap's speed where carriages are in time; 20 to 30 ms do as well (sample 1)."
FLATTEST_N_MM: Final = 1e-3
"The least weight's slope, for forces that hardly depend on the gap."


def nearest_path_mm(
    start_mm: float,
    elapsed_s: float,
    times_s: list[float],
    wanted_mm: list[float],
    weights: list[float],
    speeds: GapSpeeds,
    count: int,
) -> list[float]:
    """Return the first `count` gaps of the path that misses `wanted_mm` least."""
    best_mm = _best_mm(times_s, wanted_mm, weights, speeds)
    path_mm: list[float] = []
    gap_mm, before_s = start_mm, times_s[0] - elapsed_s
    for place in range(count):
        closed_mm, opened_mm = speeds.reach_mm(times_s[place] - before_s)
        gap_mm = within(best_mm[place], (gap_mm - closed_mm, gap_mm + opened_mm))
        path_mm.append(gap_mm)
        before_s = times_s[place]
    return path_mm


def _best_mm(times_s: list[float], wanted_mm: list[float], weights: list[float], speeds: GapSpeeds) -> list[float]:
    """Return for each point the gap from which it and all later ones are missed least."""
    best_mm = wanted_mm[:]
    # The least cost of what comes is convex in the gap, with a piecewise linear derivative. One point further back in
    # time, its two sides move apart by what the gap can move, and the point adds a line. Kept are the kinks on both
    # sides of the derivative's zero, nearest last, shifted back to time 0, and the growth of the slope at each.
    below_mm: list[float] = []
    below: list[float] = []
    above_mm: list[float] = []
    above: list[float] = []
    for place in range(len(wanted_mm) - 1, -1, -1):
        opened_mm, closed_mm = speeds.opening_mm_s * times_s[place], speeds.sure_mm_s * times_s[place]
        least_mm, slope = wanted_mm[place], weights[place]
        offset = -slope * least_mm
        while above and least_mm > above_mm[-1] - closed_mm:
            kink_mm, change = above_mm.pop() - closed_mm, above.pop()
            slope += change
            offset -= change * kink_mm
            below_mm.append(kink_mm - opened_mm)
            below.append(-change)
            least_mm = -offset / slope
        while below and least_mm < below_mm[-1] + opened_mm:
            kink_mm, change = below_mm.pop() + opened_mm, below.pop()
            slope += change
            offset -= change * kink_mm
            above_mm.append(kink_mm + closed_mm)
            above.append(-change)
            least_mm = -offset / slope
        best_mm[place] = least_mm
        below_mm.append(least_mm - opened_mm)
        below.append(slope)
        above_mm.append(least_mm + closed_mm)
        above.append(slope)
    return best_mm
