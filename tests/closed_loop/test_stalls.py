"""Stalls of daemon and line against the simulated device, and a force below the least one, in virtual time."""

from collections.abc import Iterable

import pytest
from bad_lines import BadSerialLine, stopped_until

from firmware_protocol.codec import DeviceMode
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import OperatingState
from tormagd.simulation.closed_loop import ClosedLoop, Sample

FORCE_N = 1.4
ALLOWED_N = 0.1
OPEN_MM = 95.0
SHORT_MS = [5, 8, 25, 47]
LONG_MS = [60, 400]


@pytest.fixture
def holding(armed: ClosedLoop, render) -> ClosedLoop:
    assert render(armed, FORCE_N, 1.6)[-1].truth.force_N == pytest.approx(FORCE_N, abs=0.05)
    return armed


def stall(loop: ClosedLoop, stall_ms: int) -> list[float]:
    forces_N = []
    for _ in range(stall_ms):
        loop.skip()
        forces_N.append(loop.simulated.truth.force_N)
    return forces_N


def stop_the_line(loop: ClosedLoop, stop_ms: int) -> None:
    """Let all that is said wait in the line for so long, both ways."""
    line, until_s = BadSerialLine(loop.port.device), loop.now_s + stop_ms * 1e-3
    line.spoil(lambda: stopped_until(until_s))
    loop.port.device = line


def limits_of(samples: Iterable[Sample]) -> set[Limit]:
    return {limit for sample in samples for limit in sample.output.limits}


@pytest.mark.parametrize("stall_ms", SHORT_MS)
def test_a_daemon_that_stalls_for_less_than_the_timeout_goes_on(holding: ClosedLoop, stall_ms: int, render) -> None:
    forces_N = stall(holding, stall_ms)
    samples = render(holding, FORCE_N, 0.6)
    assert samples[-1].safety.faults == ()
    assert Limit.HOST_STALL in limits_of(samples)
    assert not samples[-1].output.limits
    forces_N += [sample.truth.force_N for sample in samples]
    assert max(abs(force_N - FORCE_N) for force_N in forces_N) < ALLOWED_N


@pytest.mark.parametrize("stall_ms", [8, 47])
def test_a_stall_on_the_way_leaves_no_kick(holding: ClosedLoop, stall_ms: int, render) -> None:
    render(holding, 1.7, 0.08)
    stall(holding, stall_ms)
    samples = render(holding, 1.7, 1.2)
    assert samples[-1].safety.faults == ()
    assert max(sample.truth.force_N for sample in samples) < 1.7 + ALLOWED_N
    assert all(sample.truth.force_N == pytest.approx(1.7, abs=ALLOWED_N) for sample in samples[400:])


@pytest.mark.parametrize("stall_ms", LONG_MS)
def test_a_daemon_that_stalls_for_longer_finds_the_device_opening_and_says_why(
    holding: ClosedLoop, stall_ms: int, render
) -> None:
    stall(holding, stall_ms)
    samples = render(holding, FORCE_N, 2.0)
    assert (samples[25].safety.operating_state, samples[-1].safety.faults) == (
        OperatingState.FAULT,
        (Fault.HOST_STALL,),
    )
    assert samples[-1].truth.gap_mm > OPEN_MM - 1.0
    assert (holding.measurement.mode, holding.stepper.measure.sight.stall_s) == (
        DeviceMode.LATCHED,
        pytest.approx(stall_ms * 1e-3 + 1e-3),
    )


@pytest.mark.parametrize("stop_ms", [4, *SHORT_MS[1:]])
def test_a_line_that_stands_still_for_less_than_the_timeout_is_waited_for(
    holding: ClosedLoop, stop_ms: int, render
) -> None:
    stop_the_line(holding, stop_ms)
    samples = render(holding, FORCE_N, 0.6)
    assert samples[-1].safety.faults == ()
    assert (Limit.DEVICE_SILENT in limits_of(samples)) == (stop_ms > 4)
    assert Limit.HOST_STALL not in limits_of(samples)
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
