"""Stalls of daemon and line against the simulated device, and a force below the least one, in virtual time."""

from collections.abc import Callable, Iterable

import pytest
from bad_lines import BadSerialLine, stopped_until

from tormagd.control.safety.codes import Limit
from tormagd.simulation.closed_loop import ClosedLoop, Sample

FORCE_N = 1.4
ALLOWED_N = 0.1
OPEN_MM = 95.0


@pytest.fixture
def holding(armed: ClosedLoop, render) -> ClosedLoop:
    assert render(armed, FORCE_N, 1.6)[-1].truth.force_N == pytest.approx(FORCE_N, abs=0.05)
    return armed


def stall_the_daemon(loop: ClosedLoop, stall_ms: int) -> None:
    for _ in range(stall_ms):
        loop.skip()


def stop_the_line(loop: ClosedLoop, stop_ms: int) -> None:
    """Let all that is said wait in the line for so long, both ways."""
    line, until_s = BadSerialLine(loop.port.device), loop.now_s + stop_ms * 1e-3
    line.spoil(lambda: stopped_until(until_s))
    loop.port.device = line


def limits_of(samples: Iterable[Sample]) -> set[Limit]:
    return {limit for sample in samples for limit in sample.output.limits}


@pytest.mark.parametrize("stall_ms", [8, 25, 47])
@pytest.mark.parametrize(
    ("stall", "named"), [(stall_the_daemon, Limit.HOST_STALL), (stop_the_line, Limit.DEVICE_SILENT)]
)
def test_a_stall_of_less_than_the_timeout_is_borne_and_named(
    holding: ClosedLoop, render, stall: Callable[[ClosedLoop, int], None], named: Limit, stall_ms: int
) -> None:
    stall(holding, stall_ms)
    samples = render(holding, FORCE_N, 0.6)
    assert samples[-1].safety.faults == ()
    assert limits_of(samples) & {Limit.HOST_STALL, Limit.DEVICE_SILENT} == {named}
    assert not samples[-1].output.limits
    assert max(abs(sample.truth.force_N - FORCE_N) for sample in samples) < ALLOWED_N


@pytest.mark.parametrize("force_N", [0.2, 0.5])
def test_a_force_below_the_least_is_held_at_a_switch_that_comes_early(
    force_N: float, armed: ClosedLoop, render
) -> None:
    render(armed, 1.2, 0.8)
    armed.simulated._home_m -= 2e-4
    samples = render(armed, force_N, 3.0)
    assert samples[-1].safety.faults == ()
    assert Limit.F_MIN in samples[-1].plan.limits
    assert OPEN_MM - 0.5 < samples[-1].truth.gap_mm < OPEN_MM - 0.02
    assert Limit.SATURATED not in limits_of(samples[1_500:])
    forces_N = [sample.truth.force_N for sample in render(armed, 1.2, 1.5)]
    assert max(forces_N) < 1.2 + ALLOWED_N
    assert forces_N[-1] == pytest.approx(1.2, abs=0.06)
