"""What is believed of a device is told, with its unit and whether it acts."""

import msgspec

from tormagd.assembly.belief import beliefs
from tormagd.assembly.build import build_core
from tormagd.config import Config
from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N
from tormagd.scenes.scene import EVERY_TERM, Terms, load_scene


def test_a_weak_device_that_was_slid_at_speed_is_known_as_such(arm, render) -> None:
    loop = arm("sample_2")
    render(loop, 0.7, 1.0)
    render(loop, 2.0, 2.0)
    told = beliefs(loop.planner, loop.stepper, loop.now_s, EVERY_TERM)
    assert told["scale"].value == loop.planner.believe.strength.fit.scale < 0.95
    assert told["scale"].sd is not None
    assert 0.0 < told["scale"].sd < 0.1
    assert told["relaxed"].value > 0.0
    assert {name for name, it in told.items() if it.acts} >= {"scale", "offset", "sensor_zero", "relaxed", "field_lag"}
    # nothing came that was known ahead, or repeated itself
    assert not told["carriage_lag"].acts
    assert not told["forecast_trust"].acts
    later = beliefs(loop.planner, loop.stepper, loop.now_s + 3600.0, EVERY_TERM)["sensor_zero"]
    assert later.sd is not None
    assert (later.sd > UNKNOWN_SD_N, later.acts) == (True, False)


def test_a_term_that_is_left_out_does_not_act(arm, render) -> None:
    config, left_out = Config(scene="pulse"), Terms(creep=False, scale=False, hysteresis=False)
    loop = arm(core=build_core(config, msgspec.structs.replace(load_scene("pulse"), terms=left_out)), config=config)
    render(loop, 1.5, 1.0)
    told = beliefs(loop.planner, loop.stepper, loop.now_s, left_out)
    assert {name for name, it in told.items() if it.acts} == {
        "offset", "sensor_zero", "acceleration_scale", "relaxed"
    }  # fmt: skip
    assert (told["scale"].value, told["field_lag"].value) == (1.0, 0.0)
