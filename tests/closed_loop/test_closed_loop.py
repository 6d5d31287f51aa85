"""The daemon's core against the simulated device, in virtual time and through protocol bytes (synthetic).

How exactly a force is followed is judged in tests/tools.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from firmware_protocol.codec import DriveMode
from tormagd.config import Config, Rates
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.codes import Limit
from tormagd.scenes.scene import load_scene, scene_path
from tormagd.scenes.signal import asked
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.hand import RecordedHand, ReversingHand, pressing

OPEN_MM = 95.0


def test_a_hand_that_stops_and_turns_meets_no_more_than_was_asked(arm, render) -> None:
    samples = render(arm(hand=ReversingHand()), 1.0, 4.0)[1_500:]
    assert min(abs(sample.truth.handle_mm_s) for sample in samples) < 0.1
    assert all(-0.1 < sample.truth.kinetic_N - 1.0 < 0.08 for sample in samples)
    assert all(abs(sample.truth.force_N) < 1.08 for sample in samples)
    sliding_N = [abs(sample.truth.force_N) for sample in samples if abs(sample.truth.handle_mm_s) > 20.0]
    assert sliding_N == pytest.approx([1.0] * len(sliding_N), abs=0.02)


def test_pause_holds_resume_goes_on_and_disable_opens(armed: ClosedLoop, render) -> None:
    render(armed, 1.2, 1.2)
    armed.command("pause")
    held_mm = armed.simulated.truth.gap_mm
    assert all(sample.truth.gap_mm == pytest.approx(held_mm, abs=0.3) for sample in render(armed, 1.8, 0.4))
    armed.command("resume")
    assert render(armed, 1.8, 0.8)[-1].truth.force_N == pytest.approx(1.8, abs=0.06)
    armed.command("disable")
    opened = list(armed.run(2.2))
    assert (opened[-1].truth.gap_mm, opened[-1].safety.faults) == (pytest.approx(OPEN_MM, abs=0.3), ())
    assert all(sample.output.mode is DriveMode.OFF for sample in opened)
    # disabled is not a fault: it can be armed again without homing
    armed.command("enable")
    assert render(armed, 1.2, 1.2)[-1].truth.force_N == pytest.approx(1.2, abs=0.06)


@pytest.mark.parametrize(("is_every", "planned"), [(True, 500), (False, 100)])
def test_setpoints_wait_for_the_next_plan_where_the_rate_binds(arm: Callable[..., ClosedLoop], is_every, planned):
    rates = Rates(control_hz=500, inference_hz=100, plan_every_setpoint=is_every)
    config = Config(rates=rates)
    samples = list(
        arm("sample_1", core=build_core(config), config=config).run(1.0, lambda now_s: TimedSetpoint(1.0, now_s, 0.1))
    )
    assert len({sample.plan.time_s for sample in samples}) == pytest.approx(planned, abs=1)
    assert samples[-1].plan.stamp_s > samples[-1].time_s - 0.011


SCENE = load_scene("radial_pulse")
CONFIG = Config(scene="radial_pulse", rates=Rates(control_hz=500, inference_hz=83))
PRESSED_S, PULSE_S = 14.0, 5.0


@pytest.fixture(scope="module")
def pad_core() -> Core:
    return build_core(CONFIG)


@pytest.mark.parametrize("plant", ["pad_1", "pad_2"])
def test_a_pulse_is_felt_on_the_pad(arm, pad_core: Core, plant: str) -> None:
    time_s, force_N = asked(SCENE.signal, scene_path("radial_pulse").parent, (3.2, 3.9), PULSE_S, 100)
    loop = arm(plant, pressing(2.0), core=pad_core, config=CONFIG)

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


def test_a_finger_that_presses_too_hard_opens_the_gap_and_is_no_fault(arm, pad_core: Core) -> None:
    hand = RecordedHand((0.0, 3.0, 4.0), (0.0, 0.0, 4.0))
    last = list(
        arm("pad_1", hand, core=pad_core, config=CONFIG).run(4.5, lambda now_s: TimedSetpoint(3.6, now_s, 0.1))
    )[-1]
    assert last.truth.force_N > 1.5 * SCENE.force.most_N
    assert Limit.OVER_FORCE in last.output.limits
    assert last.truth.gap_mm > 94.0
    assert not last.safety.faults
