"""The tactile element end to end in virtual time: the daemon's core, the protocol's bytes, a finger in a pad."""

import math

import numpy as np
import pytest

from tormagd.assembly.build import Core, build_core
from tormagd.config import Config, Rates
from tormagd.control.records import TimedSetpoint
from tormagd.lab.tactile.held import Case, hold
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import load_scene, scene_path
from tormagd.scenes.signal import asked
from tormagd.simulation.hand import PressingHand, RecordedHand

SCENE = load_scene("radial_pulse")
CONFIG = Config(scene="radial_pulse", rates=Rates(control_hz=500, inference_hz=83))
PRESSED_S, PULSE_S = 14.0, 5.0


@pytest.fixture(scope="module")
def pad_core() -> Core:
    return build_core(CONFIG)


@pytest.mark.parametrize("plant", ["pad_1", "pad_2"])
def test_a_pulse_is_felt_on_the_pad(arm, pad_core: Core, plant: str) -> None:
    """On the pad of the model, and on a weaker one that relaxes more."""
    time_s, force_N = asked(SCENE.signal, scene_path("radial_pulse").parent, (3.2, 3.9), PULSE_S, 100)
    loop = arm(plant, PressingHand(2.0), core=pad_core, config=CONFIG)

    def publish(now_s: float) -> TimedSetpoint:
        stamp_s = math.floor(100.0 * now_s) / 100.0
        return TimedSetpoint(float(np.interp(stamp_s - PRESSED_S, time_s, force_N)), stamp_s, 0.1)

    list(loop.run(PRESSED_S - loop.now_s, publish))
    errors_N = [
        sample.truth.force_N - float(np.interp(sample.time_s - PRESSED_S, time_s, force_N))
        for sample in loop.run(PULSE_S, publish)
    ]
    assert not loop.stepper.safety.faults
    assert float(np.sqrt(np.mean(np.square(errors_N)))) < 0.8 * SCENE.force.tolerance_rms_N
    assert loop.planner.believe.memory.relaxed_N > 0.1


def test_a_held_force_stays_with_the_memory_and_falls_without() -> None:
    """The first minutes of `tormag-lab tactile-hold --coarse`, frozen."""
    within, without = (hold(Case("pad_1", remembers, False, 200.0, coarse=True)) for remembers in (True, False))
    assert within["force_error"] < 0.01
    assert not within["fault"]
    assert without["last_force_error"] < -0.05


def test_a_hold_of_plans_alone_is_that_of_the_whole_device() -> None:
    whole, coarse = (hold(Case("pad_1", False, False, 10.0, is_coarse)) for is_coarse in (False, True))
    # where the gap comes to rest differs by what friction lets it; how the force falls from there does not
    fell, fell_coarse = (run["last_force_error"] - run["shares"][0] for run in (whole, coarse))
    assert fell == pytest.approx(fell_coarse, abs=1e-4)
    assert whole["last_force_error"] == pytest.approx(coarse["last_force_error"], abs=2e-3)


def test_a_finger_that_presses_too_hard_opens_the_gap_and_is_no_fault(arm, pad_core: Core) -> None:
    """Its force is the finger's own: more than the scene's greatest by far, at any gap."""
    hand = RecordedHand((0.0, 3.0, 4.0), (0.0, 0.0, 4.0))
    last = list(
        arm("pad_1", hand, core=pad_core, config=CONFIG).run(4.5, lambda now_s: TimedSetpoint(3.6, now_s, 0.1))
    )[-1]
    assert last.truth.force_N > 1.5 * SCENE.force.most_N
    assert Limit.OVER_FORCE in last.output.limits
    assert last.truth.gap_mm > 94.0
    assert not last.safety.faults
