"""What carriages of a top speed miss of a force, held against what can be said by hand."""

import numpy as np
import pytest

from tormagd.control.aim.portrait import Portrait
from tormagd.control.assembly.renderable import missed

# 1 N over 50 mm, evenly: at 25 mm/s half a newton a second everywhere
EVEN = Portrait(np.linspace(95.0, 45.0, 11).tolist(), np.linspace(0.5, 1.5, 11).tolist(), [0.02] * 11)
SPEED_MM_S = 25.0


@pytest.mark.parametrize("rate_N_s", [0.0, 0.49])
def test_a_force_that_is_slow_or_stands_is_followed_exactly(rate_N_s: float) -> None:
    times_s = np.linspace(0.0, 2.0, 201)
    found = missed(EVEN, times_s.tolist(), (0.5 + rate_N_s * times_s).tolist(), SPEED_MM_S)
    assert (found.rms_N, found.share, found.worst) == (pytest.approx(0.0, abs=1e-12), 0.0, ())


def test_a_step_is_caught_up_with_at_top_speed() -> None:
    found = missed(EVEN, [0.001 * tick for tick in range(1001)], [0.7] + [1.2] * 1000, SPEED_MM_S)
    assert (found.rms_N, found.share) == (pytest.approx(0.5 / np.sqrt(3.0), rel=2e-3), pytest.approx(1 / 1000))
    (worst,) = found.worst
    assert (worst.force_N, worst.asked_N_s, worst.given_N_s) == (1.2, pytest.approx(500.0), pytest.approx(0.5))


def test_the_worst_points_are_of_different_forces_and_the_worst_comes_first() -> None:
    times_s = np.linspace(0.0, 1.0, 1001)
    found = missed(EVEN, times_s.tolist(), (1.0 - 0.4 * np.cos(np.pi * times_s)).tolist(), SPEED_MM_S)
    excess = [point.asked_N_s / point.given_N_s for point in found.worst]
    assert (len(excess), excess, excess[0]) == (
        3,
        sorted(excess, reverse=True),
        pytest.approx(0.4 * np.pi / 0.5, rel=1e-3),
    )
    assert np.diff(sorted(point.force_N for point in found.worst)).min() > 0.01
    # faster than half a newton a second where the sine is above 0.4
    assert found.share == pytest.approx(1.0 - 2.0 * np.arcsin(0.5 / (0.4 * np.pi)) / np.pi, abs=0.01)
