"""A great step of the force, held: what the elastomer relaxes before the trim gives it back. All data are synthetic."""

import numpy as np
import pytest

from tormagd.closed_loop import ClosedLoop, stream
from tormagd.config import Config, Trim
from tormagd.control.core import build_core
from tormagd.control.plan import Plan
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

LOW_N, HIGH_N = 0.7, 2.0
REST_S, HOLD_S = 12.0, 12.0
"The trim knows the device before the step; the elastomer's shortest time constant is 8 s."
TRIMMED_S = 3.0
"Arrival takes 0.8 s; then three time constants of the trim, which learned the device at the lower force."
PERIOD_S = 0.01


def errors_after_step(plant: str, trim_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times after the step and the true force less the asked one, with a trim of that time constant."""
    config = Config(scene="coronary", trim=Trim(time_s=trim_s))
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(load_plant(plant), SteadyHand(), seed=1))
    loop.arm()
    times_s = loop.now_s + PERIOD_S * np.arange(round((REST_S + HOLD_S) / PERIOD_S))
    step_s = loop.now_s + REST_S
    forces_N = np.where(times_s < step_s, LOW_N, HIGH_N)
    samples = [
        (sample.time_s - step_s, sample.truth.force_N - HIGH_N)
        for sample in loop.run(REST_S + HOLD_S, stream(times_s, forces_N))
        if sample.time_s >= step_s
    ]
    time_s, error_N = np.array(samples).T
    return time_s, error_N


def drift_N(plant: str, trim_s: float) -> float:
    """The greatest mean error of any second from TRIMMED_S on."""
    time_s, error_N = errors_after_step(plant, trim_s)
    held_N = error_N[time_s > TRIMMED_S]
    return float(max(abs(second.mean()) for second in np.array_split(held_N, round(HOLD_S - TRIMMED_S))))


@pytest.fixture(scope="module")
def allowed_N() -> float:
    """A fifth of what the scene tolerates."""
    return 0.2 * build_core(Config(scene="coronary")).scene.force.tolerance_rms_N


@pytest.mark.parametrize("plant", ["sample_1", "sample_2"])
def test_the_trim_takes_up_what_the_elastomer_relaxes(plant: str, allowed_N: float) -> None:
    """So nothing needs to be fed forward."""
    assert drift_N(plant, Trim().time_s) < allowed_N


def test_without_a_trim_the_relaxation_is_seen(allowed_N: float) -> None:
    """At a gap that is held, the force falls by more than the trim leaves of it."""
    config = Config(scene="coronary")
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, None, VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1))
    loop.arm(held(95.0, 0.0))
    forces_N = [loop.tick(plan=held(65.0, loop.now_s)).truth.force_N for _ in range(round(HOLD_S * 1e3))]
    assert forces_N[round(TRIMMED_S * 1e3)] - forces_N[-1] > 2.0 * allowed_N


def held(gap_mm: float, now_s: float) -> Plan:
    """A plan of nothing but a gap."""
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())
