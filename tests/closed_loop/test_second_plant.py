"""The core on the second plant, whose laws are of another form than everything that it was made with."""

import statistics
from collections.abc import Callable

import pytest

from tormagd.closed_loop import ClosedLoop, Sample
from tormagd.safety.codes import Limit


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_force_is_found_on_a_plant_of_other_structure(
    arm: Callable[..., ClosedLoop], render: Callable[[ClosedLoop, float, float], list[Sample]], direction: float
) -> None:
    """Generous: 50 mN after two seconds and a half at each level, ten times what it is, and no more than 0.1 N over."""
    loop = arm("second")
    for asked_N in (0.8, 2.0, 1.2) if direction > 0.0 else (2.0, 0.8, 1.6):
        samples = render(loop, asked_N, 3.0)
        assert samples[-1].safety.faults == ()
        felt_N = [sample.truth.force_N for sample in samples[-500:]]
        assert statistics.fmean(felt_N) == pytest.approx(asked_N, abs=0.05)
        assert max(felt_N) < asked_N + 0.1
        assert Limit.MODEL_RANGE not in samples[-1].plan.limits
