"""The way of a gap that misses least of a force that is known ahead, at the speeds that the gap has.

    least sum of weight (way - wanted)^2    with    |way'| <= speed

One dynamic programme, backwards over the points: the least cost of the rest is a convex function of the gap, and its
derivative is piecewise linear. A step of the gap shifts what falls to one side and what rises to the other, and opens a
flat piece in between; a point adds a line. So the programme is exact, and as each kink is passed only as often as the
optimum moves across it, it takes microseconds (Johnson, J. Comput. Graph. Stat. 22, 2013, does the same for the fused
lasso, whose dual this is).
"""


def nearest_way_mm(
    start_mm: float,
    elapsed_s: float,
    times_s: list[float],
    wanted_mm: list[float],
    weights: list[float],
    speed_mm_s: float,
    count: int,
) -> list[float]:
    """The first `count` gaps of the best way along wanted gaps (n) with weights (n) > 0, at the first n of rising
    times. The first of them is `elapsed_s` after the gap was at `start_mm`."""
    best_mm = wanted_mm[:]
    # the kinks beside the flat piece, nearest last, each less the way that its side is shifted from its point back to
    # time 0; and by how much the slope of the derivative grows where one is passed on the way out
    below_mm: list[float] = []
    below: list[float] = []
    above_mm: list[float] = []
    above: list[float] = []
    place = len(wanted_mm)
    while place:
        place -= 1
        shift_mm = speed_mm_s * times_s[place]
        least_mm, slope = wanted_mm[place], weights[place]
        offset = -slope * least_mm
        while above and least_mm > above_mm[-1] - shift_mm:
            kink_mm, change = above_mm.pop() - shift_mm, above.pop()
            slope += change
            offset -= change * kink_mm
            below_mm.append(kink_mm - shift_mm)
            below.append(-change)
            least_mm = -offset / slope
        while below and least_mm < below_mm[-1] + shift_mm:
            kink_mm, change = below_mm.pop() + shift_mm, below.pop()
            slope += change
            offset -= change * kink_mm
            above_mm.append(kink_mm + shift_mm)
            above.append(-change)
            least_mm = -offset / slope
        best_mm[place] = least_mm
        below_mm.append(least_mm - shift_mm)
        below.append(slope)
        above_mm.append(least_mm + shift_mm)
        above.append(slope)
    way_mm: list[float] = []
    gap_mm, before_s = start_mm, times_s[0] - elapsed_s
    for place in range(count):
        moved_mm = speed_mm_s * (times_s[place] - before_s)
        gap_mm = min(max(best_mm[place], gap_mm - moved_mm), gap_mm + moved_mm)
        way_mm.append(gap_mm)
        before_s = times_s[place]
    return way_mm
