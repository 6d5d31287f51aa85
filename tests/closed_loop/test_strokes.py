"""Strokes of the gap on the simulated device (synthetic): what magnets that pull and screws that stick do to them."""

import msgspec
import pytest

from tormagd.assembly.build import build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.move.carriages import MAX_ACCELERATION_SCALE, Carriages
from tormagd.simulation.hand import RecordedHand

CONFIG = Config()


AT_REST = RecordedHand((0.0,), (0.0,))
"A handle that moves would bring a force over the scene's, and a fault."


def lag_mm(loop: ClosedLoop) -> float:
    """How far the encoders are off what is expected of them."""
    stepper = loop.stepper
    assert isinstance(stepper.move, Carriages)
    return abs(stepper.move.expected.gap_mm - stepper.measured.gap_mm)  # type: ignore[union-attr]


def test_the_gap_opens_no_faster_than_the_magnets_let_it(arm, hold_gap, gap_ticks) -> None:
    """Without the pull in it the reference runs ahead of carriages that have no more voltage."""
    lags_mm, overshoots_mm = [], []
    for pull_V in (CONFIG.motor.pull_V, 0.0):
        config = msgspec.structs.replace(CONFIG, motor=msgspec.structs.replace(CONFIG.motor, pull_V=pull_V))
        loop = arm(hand=AT_REST, planned=False, config=config, core=build_core(config))
        hold_gap(loop, 47.0, 2.5)
        seen = [(lag_mm(loop), sample.truth.gap_mm) for sample in gap_ticks(loop, 70.0, 1.2)]
        lags_mm.append(max(lag for lag, _ in seen))
        overshoots_mm.append(max(gap for _, gap in seen) - 70.0)
    assert lags_mm[0] < 0.1
    assert lags_mm[0] < 0.3 * lags_mm[1]
    assert overshoots_mm[0] < 0.01 < overshoots_mm[1]


def test_a_step_knows_nothing_of_the_stroke_before_it(arm, hold_gap) -> None:
    """What the integral learned while closing is wrong for opening, and on target no error takes it away."""
    loop = arm(hand=AT_REST, planned=False)
    hold_gap(loop, 57.0, 2.0)
    assert max(abs(loop.stepper.move.left.integral), abs(loop.stepper.move.right.integral)) < 0.002
    gaps_mm = [sample.measured.gap_mm for sample in hold_gap(loop, 58.0, 0.4) + hold_gap(loop, 57.8, 0.4)]
    assert max(gaps_mm) < 58.0 + 1e-3
    assert min(gaps_mm[400:]) > 57.8 - 0.005


@pytest.mark.parametrize(
    ("sample", "least", "most"),
    [("sample_1", 1.0, 1.4), ("sample_2", 1.0, 1.0), ("sample_3", 1.6, MAX_ACCELERATION_SCALE)],
)
def test_lively_motors_are_asked_for_more_and_weak_ones_for_no_less(
    arm, hold_gap, gap_ticks, sample: str, least: float, most: float
) -> None:
    loop = arm(sample, AT_REST, planned=False)
    for stroke in range(6):
        hold_gap(loop, 60.0 if stroke % 2 else 80.0, 0.8)
    move = loop.stepper.move
    assert least <= move.acceleration_scale <= most
    resting = [move.acceleration_scale for _ in gap_ticks(loop, 80.0, 0.5)]
    assert resting[-1] == resting[250]


def test_what_a_lost_device_showed_is_not_asked_of_the_next(arm, hold_gap) -> None:
    loop = arm("sample_3", AT_REST, planned=False)
    for gap_mm in (60.0, 80.0):
        hold_gap(loop, gap_mm, 0.8)
    assert loop.stepper.move.acceleration_scale > 1.0
    loop.stepper.lose_link()
    assert loop.stepper.move.acceleration_scale == 1.0
