"""What the tests of beliefs share: a planner of a device that nothing is known of, and readings for it."""

from collections.abc import Callable

import pytest

from tormagd.control.core import Planner
from tormagd.control.records import Measured, Plan

PERIOD_S = 0.004


@pytest.fixture
def hear(planned: Callable[..., Plan]) -> Callable[..., Planner]:
    def heard(planner: Planner, seconds: float, measured: Measured, noise_N: float = 0.003) -> Planner:
        for number in range(round(seconds / PERIOD_S)):
            off_N = noise_N * (-1) ** number
            planned(planner, 1.0, measured.replaced(force_N=measured.force_N + off_N))
        return planner

    return heard
