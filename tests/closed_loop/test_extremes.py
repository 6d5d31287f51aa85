"""Extremes of the loop on the simulated device: uneven screws, an uneven clock, targets that flip.

All data here are synthetic: the device is the simulator's.
"""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from tormagd.closed_loop import Array, ClosedLoop, Sample
from tormagd.config import Config
from tormagd.control.core import Stepper
from tormagd.control.move.carriages import Carriages
from tormagd.control.move.reference import Reference
from tormagd.control.records import Plan
from tormagd.safety.operating_state import OperatingState
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import RecordedHand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

CONFIG = Config()
SCENE = load_scene("coronary")
OPEN_MM = 95.0


def gap_plan(gap_mm: float, now_s: float = 0.0, speed_mm_s: float = 0.0) -> Plan:
    """A plan for a gap instead of a force."""
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, speed_mm_s, 1.0, ())


def on_the_way(loop: ClosedLoop, gap_mm: float, ticks: int) -> list[Sample]:
    return [ticked(loop, gap_mm) for _ in range(ticks)]


def ticked(loop: ClosedLoop, gap_mm: float, speed_mm_s: float = 0.0) -> Sample:
    """One tick towards a gap: finite everywhere, nothing wound up beyond the duty limit."""
    sample, move = loop.tick(plan=gap_plan(gap_mm, loop.now_s, speed_mm_s)), loop.stepper.move
    limit = CONFIG.position.duty_limit
    assert isinstance(move, Carriages)
    assert max(abs(sample.output.left_duty), abs(sample.output.right_duty)) <= limit
    assert max(abs(move.left.integral), abs(move.right.integral)) <= limit
    reference, expected = move.reference or Reference(0.0), move.expected
    told = [reference.gap_mm, reference.speed_mm_s, reference.acceleration_mm_s2]
    told += [expected.gap_mm, expected.speed_mm_s, expected.filtered_mm_s, sample.truth.gap_mm]
    assert all(map(math.isfinite, told))
    return sample


# -- synchronisation -----------------------------------------------------------------------------------------------


def uneven() -> PlantParameters:
    """Sample 1 with three times the drag on the left."""
    plant = load_plant("sample_1")
    return msgspec.structs.replace(
        plant, screw=msgspec.structs.replace(plant.screw, drag_left_N=12.0, drag_right_N=4.0)
    )


def skews_um(synchronisation: float) -> Array:
    """Skew by the encoders on the way to and fro at 15 mm/s, with half of the drag again on the left soon."""
    config = msgspec.structs.replace(
        CONFIG, position=msgspec.structs.replace(CONFIG.position, synchronisation=synchronisation)
    )
    device = VirtualDevice(uneven(), SteadyHand(), [parse_fault("drag_left=+50%@2.7")], 1)
    loop = ClosedLoop(config, Stepper(config, SCENE), None, device)
    loop.arm(gap_plan(OPEN_MM))
    assert loop.now_s < 2.6
    samples = []
    for tick in range(1_600):
        gap_mm, speed_mm_s = (94.0 - 15e-3 * tick, -15.0) if tick < 800 else (82.0 + 15e-3 * (tick - 800), 15.0)
        samples.append(ticked(loop, gap_mm, speed_mm_s))
    assert (samples[-1].safety.operating_state, samples[-1].truth.gap_mm) == (
        OperatingState.ENABLED,
        pytest.approx(94.0, abs=0.1),
    )
    return np.array([sample.measured.skew_mm for sample in samples if sample.measured is not None]) * 1e3


def test_uneven_screws_stay_together_and_cross_coupling_is_why() -> None:
    coupled, apart = skews_um(CONFIG.position.synchronisation), skews_um(0.0)
    assert np.abs(coupled).max() <= 30.0
    # in the mean: the worst of either is one or two encoder counts
    assert np.sqrt(np.mean(coupled**2)) < 0.8 * np.sqrt(np.mean(apart**2))


def test_motors_that_cannot_keep_the_speed_are_waited_for() -> None:
    """Sample 2 reaches less than the speed limit: over the stroke it falls behind, but never so far as a fault."""
    at_rest = RecordedHand((0.0,), (0.0,))  # in motion, the force over the scene's would be a fault
    loop = ClosedLoop(CONFIG, Stepper(CONFIG, SCENE), None, VirtualDevice(load_plant("sample_2"), at_rest, seed=1))
    loop.arm(gap_plan(OPEN_MM))
    samples = on_the_way(loop, 47.0, 2_000) + on_the_way(loop, 93.0, 2_000)
    assert (samples[-1].safety.operating_state, samples[-1].truth.gap_mm) == (
        OperatingState.ENABLED,
        pytest.approx(93.0, abs=0.1),
    )


# -- the clock -----------------------------------------------------------------------------------------------------


def unevenly(loop: ClosedLoop, gap_mm: float, periods_s: list[float]) -> list[Sample]:
    """The ticks on the way to a gap, each this long after the one before it."""
    samples = []
    for period_s in periods_s:
        now_s = loop.now_s
        loop._period_s = (now_s + period_s) / (loop._ticks + 1)
        samples.append(ticked(loop, gap_mm))
        assert samples[-1].time_s - now_s == pytest.approx(period_s, abs=1e-12)
    return samples


@settings(max_examples=4, deadline=None, suppress_health_check=list(HealthCheck))
@given(periods_s=st.lists(st.floats(1e-5, 4e-3), min_size=300, max_size=300))
def test_jitter_of_a_few_periods_is_ridden_out(arm, periods_s: list[float]) -> None:
    samples = unevenly(arm(planned=False), 92.0, periods_s)
    assert samples[-1].safety.operating_state is OperatingState.ENABLED
    assert min(sample.truth.gap_mm for sample in samples) > 92.0 - 0.2


@settings(max_examples=4, deadline=None, suppress_health_check=list(HealthCheck))
@given(periods_s=st.lists(st.sampled_from([1e-5, 1e-3, 0.03, 0.1]), min_size=60, max_size=60))
def test_jitter_beyond_the_timeout_ends_in_a_fault_and_not_in_motion(arm, periods_s: list[float]) -> None:
    samples = unevenly(arm(planned=False), 90.0, periods_s)
    if max(periods_s) > 0.05:
        assert samples[-1].safety.operating_state is OperatingState.FAULT
    assert min(sample.truth.gap_mm for sample in samples) > 90.0 - 2.0


# -- the target ----------------------------------------------------------------------------------------------------


def test_a_target_that_flips_every_tick_is_averaged_and_left_behind_cleanly(arm) -> None:
    loop = arm(planned=False)
    on_the_way(loop, 85.0, 500)
    flipping = [ticked(loop, 80.0 + 10.0 * (tick % 2)) for tick in range(600)]
    assert all(79.9 < sample.truth.gap_mm < 90.1 for sample in flipping)
    after = on_the_way(loop, 85.0, 600)
    assert (after[-1].safety.operating_state, after[-1].truth.gap_mm) == (
        OperatingState.ENABLED,
        pytest.approx(85.0, abs=0.03),
    )
