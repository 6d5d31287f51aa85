"""Strokes of the gap on the simulated device (synthetic): what magnets that pull and screws that stick do to them."""

import msgspec
import pytest

from tormagd.closed_loop import ClosedLoop, Sample
from tormagd.config import Config
from tormagd.control.plan import Plan
from tormagd.control.step import LIVELIEST, Stepper
from tormagd.scenes.scene import load_scene
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import RecordedHand
from tormagd.simulation.parameters import load_plant

CONFIG = Config()


def armed(config: Config = CONFIG, sample: str = "sample_1") -> ClosedLoop:
    """A sample with the gap open and the handle at rest: a force over the scene's would be a fault."""
    device = VirtualDevice(load_plant(sample), RecordedHand((0.0,), (0.0,)), seed=1)
    loop = ClosedLoop(config, Stepper(config, load_scene("coronary")), None, device)
    loop.arm(gap_plan(95.0, 0.0))
    return loop


def gap_plan(gap_mm: float, now_s: float) -> Plan:
    """A plan for a gap instead of a force."""
    return Plan(1, now_s, None, None, 0.0, None, 0.0, gap_mm, 0.0, 1.0, ())


def go(loop: ClosedLoop, gap_mm: float, duration_s: float) -> list[Sample]:
    return [loop.tick(plan=gap_plan(gap_mm, loop.now_s)) for _ in range(round(1_000 * duration_s))]


def worst_lag_mm(samples: list[Sample]) -> float:
    """How far the encoders were ever off what was expected of them."""
    states = [sample.state for sample in samples]
    return max(abs(s.expected.gap_mm - s.estimate.gap_mm) for s in states if s.expected and s.estimate)


def test_the_gap_opens_no_faster_than_the_magnets_let_it() -> None:
    """Without the pull in it the reference runs ahead of carriages that have no more voltage."""
    lags_mm, overshoots_mm = [], []
    for pull_V in (CONFIG.motor.pull_V, 0.0):
        loop = armed(msgspec.structs.replace(CONFIG, motor=msgspec.structs.replace(CONFIG.motor, pull_V=pull_V)))
        go(loop, 47.0, 2.5)
        samples = go(loop, 70.0, 1.2)
        lags_mm.append(worst_lag_mm(samples))
        overshoots_mm.append(max(sample.truth.gap_mm for sample in samples) - 70.0)
    assert lags_mm[0] < 0.1
    assert lags_mm[0] < 0.3 * lags_mm[1]
    assert overshoots_mm[0] < 0.01 < overshoots_mm[1]


def test_a_step_knows_nothing_of_the_stroke_before_it() -> None:
    """What the integral learned while closing is wrong for opening, and on target no error takes it away."""
    loop = armed()
    go(loop, 57.0, 1.5)
    samples = go(loop, 57.0, 0.5)
    assert max(abs(samples[-1].state.left.integral), abs(samples[-1].state.right.integral)) < 0.002
    gaps_mm = [s.state.estimate.gap_mm for s in go(loop, 58.0, 0.4) + go(loop, 57.8, 0.4) if s.state.estimate]
    assert max(gaps_mm) < 58.0 + 1e-3
    assert min(gaps_mm[400:]) > 57.8 - 0.005


@pytest.mark.parametrize(
    ("sample", "least", "most"), [("sample_1", 1.0, 1.4), ("sample_2", 1.0, 1.0), ("sample_3", 1.6, LIVELIEST)]
)
def test_lively_motors_are_asked_for_more_and_weak_ones_for_no_less(sample: str, least: float, most: float) -> None:
    loop = armed(sample=sample)
    for stroke in range(6):
        samples = go(loop, 60.0 if stroke % 2 else 80.0, 0.8)
    assert least <= samples[-1].state.liveliness <= most
    resting = go(loop, 80.0, 0.5)
    assert resting[-1].state.liveliness == resting[250].state.liveliness


def test_what_a_lost_device_showed_is_not_asked_of_the_next() -> None:
    loop = armed(sample="sample_3")
    for gap_mm in (60.0, 80.0):
        samples = go(loop, gap_mm, 0.8)
    assert samples[-1].state.liveliness > 1.0
    assert Stepper(CONFIG, load_scene("coronary")).lose_link(samples[-1].state).liveliness == 1.0
