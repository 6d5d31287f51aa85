"""A great step of the force, held: what the elastomer relaxes before the trim gives it back. All data are synthetic."""

from collections.abc import Callable

import numpy as np
import pytest

from tormagd.assembly.build import Core, build_core
from tormagd.closed_loop import ClosedLoop, stream
from tormagd.config import Config, Trim

Maker = Callable[..., ClosedLoop]
LOW_N, HIGH_N = 0.7, 2.0
REST_S, HOLD_S = 12.0, 12.0
"The trim knows the device before the step; the elastomer's shortest time constant is 8 s."
TRIMMED_S = 3.0
"Arrival takes 0.8 s; then three time constants of the trim, which learned the device at the lower force."
PERIOD_S = 0.01


def errors_after_step(arm: Maker, plant: str, trim_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times after the step and the true force less the asked one, with a trim of that time constant."""
    config = Config(scene="coronary", trim=Trim(time_s=trim_s))
    loop = arm(plant, core=build_core(config), config=config)
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


def drift_N(arm: Maker, plant: str, trim_s: float) -> float:
    """The greatest mean error of any second from TRIMMED_S on."""
    time_s, error_N = errors_after_step(arm, plant, trim_s)
    held_N = error_N[time_s > TRIMMED_S]
    return float(max(abs(second.mean()) for second in np.array_split(held_N, round(HOLD_S - TRIMMED_S))))


@pytest.fixture(scope="module")
def allowed_N(core: Core) -> float:
    """A fifth of what the scene tolerates."""
    return 0.2 * core.scene.force.tolerance_rms_N


@pytest.mark.parametrize("plant", ["sample_1", "sample_2"])
def test_the_trim_takes_up_what_the_elastomer_relaxes(arm, plant: str, allowed_N: float) -> None:
    """So nothing needs to be fed forward."""
    assert drift_N(arm, plant, Trim().time_s) < allowed_N


def test_without_a_trim_the_relaxation_is_seen(arm, hold_gap, allowed_N: float) -> None:
    """At a gap that is held, the force falls by more than the trim leaves of it."""
    forces_N = [sample.truth.force_N for sample in hold_gap(arm(planned=False), 65.0, HOLD_S)]
    assert forces_N[round(TRIMMED_S * 1e3)] - forces_N[-1] > 2.0 * allowed_N
