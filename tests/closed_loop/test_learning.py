"""What a device shows of itself is learned while a step arrives; what is believed is told (synthetic)."""

import msgspec
import numpy as np
import pytest

from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.control.believe.believe import NOTHING_LEARNED
from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N
from tormagd.control.records import TimedSetpoint
from tormagd.record.stream import beliefs
from tormagd.scenes.scene import EVERY_TERM, Terms, load_scene
from tormagd.simulation.hand import ReversingHand

VALID_S = 0.2
DEVICES = {"sample_2": 0.02, "sample_3": 0.02, "second": 0.05}
"Where a step settles, N. No constant of the learning was chosen on them; the second's laws have other forms."


@pytest.mark.parametrize(("plant", "settles_N"), DEVICES.items())
def test_a_step_of_a_new_device_settles_soon_and_noise_alone_hardly_moves_the_gap(
    arm, render, plant: str, settles_N: float
) -> None:
    loop = arm(plant)
    for overshoots_N in (0.1, 0.08):
        render(loop, 0.7, 2.0)
        forces_N = [abs(each.truth.force_N) for each in render(loop, 2.0, 1.6)]
        assert max(forces_N) < 2.0 + overshoots_N
        assert np.mean(forces_N[1_500:1_600]) == pytest.approx(2.0, abs=settles_N)
    assert render(loop, 1.2, 5.0)[-1].safety.faults == ()
    gaps_mm = np.array([each.plan.gap_mm for each in render(loop, 1.2, 3.0)])
    assert np.std(gaps_mm - np.linspace(gaps_mm[0], gaps_mm[-1], len(gaps_mm))) < 0.1


def test_without_learning_nothing_is_learned_though_the_hand_reverses_and_forces_leap(arm) -> None:
    config = Config(scene="pulse")
    core = build_core(config, msgspec.structs.replace(load_scene("pulse"), terms=Terms(learning=False)))
    loop = arm("sample_3", ReversingHand(1.0), core=core, config=config)
    list(loop.run(2.5, lambda now_s: TimedSetpoint(1.4 + 0.5 * (now_s % 1.0 > 0.5), now_s, VALID_S)))
    assert (loop.planner.believe.learned(), loop.stepper.move.acceleration_scale) == (NOTHING_LEARNED, 1.0)


def test_a_weak_device_that_was_slid_at_speed_is_known_as_such_and_right_at_once_the_next_time(arm, render) -> None:
    loop = arm("sample_2")
    render(loop, 0.7, 1.0)
    render(loop, 2.0, 2.0)
    again = arm("sample_2")
    again.planner.believe.teach(loop.planner.believe.learned())
    forces_N = [abs(each.truth.force_N) for each in render(again, 2.0, 2.5)]
    assert max(forces_N) < 2.0 + 0.06
    assert np.mean(forces_N[1_200:1_300]) == pytest.approx(2.0, abs=0.04)
    told = beliefs(loop.planner, loop.stepper, loop.now_s, EVERY_TERM)
    assert told["scale"].value == loop.planner.believe.fit.scale < 0.95
    assert told["scale"].sd is not None
    assert 0.0 < told["scale"].sd < 0.1
    assert told["relaxed"].value > 0.0
    assert {name for name, it in told.items() if it.acts} >= {"scale", "offset", "sensor_zero", "relaxed", "field_lag"}
    # nothing came that was known ahead, or repeated itself
    assert (told["carriage_lag"].acts, told["forecast_trust"].acts) == (False, False)
    later = beliefs(loop.planner, loop.stepper, loop.now_s + 3600.0, EVERY_TERM)["sensor_zero"]
    assert later.sd is not None
    assert (later.sd > UNKNOWN_SD_N, later.acts) == (True, False)


def test_a_term_that_is_left_out_does_not_act_though_a_preview_tells_what_comes(arm) -> None:
    config, left_out = Config(scene="pulse"), Terms(creep=False, scale=False, memory=False, forecast=False)
    loop = arm(core=build_core(config, msgspec.structs.replace(load_scene("pulse"), terms=left_out)), config=config)
    list(loop.run(1.0, lambda now_s: TimedSetpoint(1.5, now_s, VALID_S, preview_N=(1.5, 1.5), preview_dt_s=0.02)))
    told = beliefs(loop.planner, loop.stepper, loop.now_s, left_out)
    acting = {"offset", "sensor_zero", "carriage_lag", "acceleration_scale"}
    assert {name for name, it in told.items() if it.acts} == acting
    assert (told["scale"].value, told["field_lag"].value) == (1.0, 0.0)
