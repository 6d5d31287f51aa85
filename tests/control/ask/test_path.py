"""The path of a gap that misses least of what is known ahead, beside paths that are searched for exhaustively."""

import itertools
import math

import pytest
from hypothesis import given, settings, strategies as st

from tormagd.control.ask.path import nearest_path_mm
from tormagd.control.records import GapSpeeds

STEP_S = 0.01
SPEED_MM_S = 40.0
MAX_MM = SPEED_MM_S * STEP_S


@pytest.mark.parametrize(("to_mm", "speed_mm_s"), [(40.0, -50.0), (80.0, 20.0)])
def test_a_late_gap_closes_by_what_the_motors_can_and_opens_by_what_a_task_may_lose(
    to_mm: float, speed_mm_s: float
) -> None:
    times_s = [STEP_S * place for place in range(10)]
    path = nearest_path_mm(60.0, STEP_S, times_s, [to_mm] * 10, [1.0] * 10, GapSpeeds(50.0, 20.0, 40.0), 3)
    assert path == pytest.approx([60.0 + speed_mm_s * STEP_S * place for place in (1, 2, 3)])


GRID = 4
"A step of the gap is this many steps of a search over all paths on a grid."


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-2.0, 2.0), st.floats(0.01, 1.0), st.integers(1, 3)), min_size=1, max_size=12),
    st.integers(-10, 10),
    st.sampled_from([1, 2, GRID]),
)
def test_no_path_within_the_speeds_misses_less(points: list[tuple[float, float, int]], start: int, opens: int) -> None:
    wanted, weights = [60.0 + at for at, _, _ in points], [weight for _, weight, _ in points]
    steps = [step for _, _, step in points]
    grid_mm = MAX_MM / GRID
    start_mm = 60.0 + start * grid_mm
    times_s = [STEP_S * (passed - steps[0]) for passed in itertools.accumulate(steps)]
    speeds = GapSpeeds(SPEED_MM_S, SPEED_MM_S * opens / GRID, SPEED_MM_S)
    path = nearest_path_mm(start_mm, STEP_S * steps[0], times_s, wanted, weights, speeds, len(wanted))
    for (before, after), step in zip(itertools.pairwise([start_mm, *path]), steps, strict=True):
        assert -step * MAX_MM - 1e-9 <= after - before <= step * MAX_MM * opens / GRID + 1e-9
    reached = {start: 0.0}
    for want, weight, step in zip(wanted, weights, steps, strict=True):
        following: dict[int, float] = {}
        for place, spent in reached.items():
            for there in range(place - step * GRID, place + step * opens + 1):
                total = spent + weight * (60.0 + there * grid_mm - want) ** 2
                following[there] = min(total, following.get(there, math.inf))
        reached = following
    cost = sum(weight * (at - want) ** 2 for at, want, weight in zip(path, wanted, weights, strict=True))
    assert cost <= min(reached.values()) + 1e-9
