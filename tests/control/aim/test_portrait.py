"""A force is found among a portrait's points as `bisect_right` finds it, and read as straight lines give it."""

import math
from bisect import bisect_right
from itertools import accumulate

import numpy as np
from hypothesis import given, strategies as st

from tormagd.control.aim.portrait import Portrait

GAINS_N = st.lists(st.floats(1e-9, 1.0), min_size=1, max_size=60)


def drawn_portrait(least_N: float, gains_N: list[float]) -> Portrait:
    """A portrait whose forces rise by so much from point to point, from steep to flat as they come."""
    forces_N = list(accumulate(gains_N, initial=least_N))
    gaps_mm = np.linspace(40.0, 15.0, len(forces_N)).tolist()
    return Portrait(gaps_mm, forces_N, [*gains_N, 2.0 * gains_N[-1]])


@given(least_N=st.floats(0.1, 1.0), gains_N=GAINS_N, share=st.floats(-0.5, 1.5), place=st.integers(0))
def test_a_force_is_found_as_bisection_finds_it(least_N: float, gains_N: list[float], share: float, place: int) -> None:
    shown = drawn_portrait(least_N, gains_N)
    forces_N = shown.force_N
    at_a_point = forces_N[place % len(forces_N)]
    for force_N in (
        shown.min_N + share * (shown.max_N - shown.min_N),
        at_a_point,
        math.nextafter(at_a_point, -math.inf),
        math.nextafter(at_a_point, math.inf),
        -1e300,
        1e300,
    ):
        next_to = min(bisect_right(forces_N, force_N), len(forces_N) - 1)
        gap_mm, slope_N_mm = shown.gap_and_slope_at(force_N)
        assert slope_N_mm == shown.slope_N_mm[next_to]
        assert gap_mm == shown.gap_mm_at(force_N)
        assert math.isclose(gap_mm, np.interp(force_N, forces_N, shown.gap_mm), rel_tol=1e-12)
        assert math.isclose(shown.slope_at_N_mm(force_N), np.interp(force_N, forces_N, shown.slope_N_mm), rel_tol=1e-9)
