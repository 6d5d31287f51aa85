"""A force is found among a portrait's points as `bisect_right` finds it, and read as straight lines give it."""

import math
from bisect import bisect_right
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.control.aim.portrait import Portrait
from tormagd.physics.errors import DomainError

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
        assert (slope_N_mm, gap_mm) == (shown.slope_N_mm[next_to], shown.gap_mm_at(force_N))
        assert math.isclose(gap_mm, np.interp(force_N, forces_N, shown.gap_mm), rel_tol=1e-12)
        assert math.isclose(shown.slope_at_N_mm(force_N), np.interp(force_N, forces_N, shown.slope_N_mm), rel_tol=1e-9)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_a_table_with_what_is_no_number_is_refused(value: float) -> None:
    with pytest.raises(DomainError, match=r"^values = .* is not allowed: a finite number"):
        Portrait([95.0, 70.0, 45.0], [0.5, value, 2.0], [0.1, 0.1, 0.1])


def test_points_between_which_no_slope_is_are_refused_and_equal_ones_are_not() -> None:
    with pytest.raises(DomainError, match=r"^values = 5e-324 is not allowed: 0, or 1e-200 from there$"):
        Portrait([95.0, 70.0, 45.0], [0.0, 5e-324, 2.0], [0.1, 0.1, 0.1])
    flat = Portrait([95.0, 70.0, 45.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    assert (flat.gap_mm_at(0.9), flat.gap_mm_at(1.1)) == (95.0, 45.0)


def test_a_force_or_gap_that_is_no_number_has_no_place() -> None:
    """It would be taken for the last point, the closest gap."""
    shown = drawn_portrait(0.4, [0.2] * 8)
    for asked, name in ((shown.gap_mm_at, "value"), (shown.gap_and_slope_at, "value"), (shown.force_N_at, "steps")):
        with pytest.raises(DomainError, match=f"^{name} = nan is not allowed: a number$"):
            asked(math.nan)
    assert (shown.gap_mm_at(math.inf), shown.gap_mm_at(-math.inf)) == (15.0, 40.0)
    assert (shown.force_N_at(-math.inf), shown.force_N_at(math.inf)) == (shown.max_N, shown.min_N)
