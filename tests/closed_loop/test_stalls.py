"""A stall while the force rises, and a force below the least one, against the simulated device in virtual time.

What stalls are named and how they end: the fault matrix, and tests/control/test_core.py.
"""

import pytest

from tormagd.control.safety.codes import Limit
from tormagd.simulation.closed_loop import ClosedLoop

ALLOWED_N = 0.1
OPEN_MM = 95.0


@pytest.mark.parametrize("stall_ms", [8, 25, 47])
def test_a_stall_on_the_way_leaves_no_kick(armed: ClosedLoop, stall_ms: int, render) -> None:
    render(armed, 1.4, 1.6)
    render(armed, 1.7, 0.08)
    for _ in range(stall_ms):
        armed.skip()
    samples = render(armed, 1.7, 1.2)
    assert samples[-1].safety.faults == ()
    assert max(sample.truth.force_N for sample in samples) < 1.7 + ALLOWED_N
    assert all(sample.truth.force_N == pytest.approx(1.7, abs=ALLOWED_N) for sample in samples[400:])


@pytest.mark.parametrize("force_N", [0.2, 0.5])
def test_a_force_below_the_least_is_held_at_a_switch_that_comes_early(
    force_N: float, armed: ClosedLoop, render
) -> None:
    render(armed, 1.2, 0.8)
    armed.device.messages._home_m -= 2e-4
    samples = render(armed, force_N, 3.0)
    assert samples[-1].safety.faults == ()
    assert Limit.F_MIN in samples[-1].plan.limits
    assert OPEN_MM - 0.5 < samples[-1].truth.gap_mm < OPEN_MM - 0.02
    assert not any(Limit.SATURATED in sample.output.limits for sample in samples[1_500:])
    forces_N = [sample.truth.force_N for sample in render(armed, 1.2, 1.5)]
    assert max(forces_N) < 1.2 + ALLOWED_N
    assert forces_N[-1] == pytest.approx(1.2, abs=0.06)
