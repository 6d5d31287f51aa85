"""What docs/scenes.md says beside the decisions belongs to them, and to models and devices as they are."""

import json

import pytest
from evidence import FOLDER
from motor_parts import moved
from rate_error import error_N, model_and_friction
from unmet_scene import OTHERS, SCENE, missed_N
from wrong_model import ALLOWED

from tormagd.scenes.measured import is_met, measured
from tormagd.scenes.scene import load_scene
from tormagd.simulation.parameters import load_plant

SCENES = {scene.name: scene for scene in measured().scenes}


def test_the_predictions_are_those_of_the_decisions_and_hold() -> None:
    """`python tools/evidence.py wrong_model` measures them again."""
    found = json.loads((FOLDER / "wrong_model.json").read_text(encoding="utf-8"))["figures"]
    hold, pulse = found["cheapest"], found["fullest"]
    added_N = sum(item.frozen_added_N for item in SCENES[hold["scene"]].terms)
    times = SCENES[pulse["scene"]].cost_full_us_s / SCENES[pulse["scene"]].cost_us_s - 1.0
    assert (hold["predicted_N"], pulse["predicted"]) == (pytest.approx(added_N), pytest.approx(times))
    assert max(hold["off"], pulse["off"]) <= ALLOWED


def test_a_handle_that_teaches_what_the_device_is_meets_what_is_not_met() -> None:
    tolerance_N = load_scene(SCENE).force.tolerance_rms_N
    assert not is_met(SCENES[SCENE].judged, tolerance_N)
    as_it_is, known = (missed_N(other, ("sample_1",))["sample_1"] for other in (OTHERS[0], OTHERS[-1]))
    assert known < tolerance_N < as_it_is


def test_the_figures_of_the_motors_parts_and_of_the_rates_are_of_today() -> None:
    """`python tools/evidence.py motor rates` measures them again."""
    motor, rates = (
        json.loads((FOLDER / f"{part}.json").read_text(encoding="utf-8"))["figures"] for part in ("motor", "rates")
    )
    assert moved(load_plant("sample_3"), "friction") == pytest.approx(
        motor["motion"]["friction"]["sample_3"], rel=0.2, abs=0.005
    )
    model, friction = model_and_friction()
    assert error_N(model, friction, 2.5) == pytest.approx(rates["error_N"]["2.5"], abs=1e-4)
