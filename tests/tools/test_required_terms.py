"""The measurement of required terms: what is stored follows from its own numbers, and a case gives them again."""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
import required_terms
from rendering import scene_runs
from rendering.scene_runs import Case, Play, run, run_all
from required_terms import NO_COST, RATES_HZ, SHARE, is_good, measure, spared

from tormagd.scenes.measured import (
    JUDGED,
    Cost,
    Judged,
    MeasuredScene,
    Without,
    is_met,
    measured,
    on_first,
    required,
)
from tormagd.scenes.scene import LEAST_CONTROL_HZ, TERMS, load_scene, shipped_scenes, terms_of
from tormagd_client.endpoints import ConfigError

STORED = measured()


@pytest.mark.parametrize("scene", STORED.scenes, ids=lambda scene: scene.name)
def test_what_is_stored_follows_from_its_own_numbers(scene: MeasuredScene) -> None:
    assert tuple(item.term for item in scene.terms) == TERMS
    assert not set(required(scene.terms, scene.tolerance_N, STORED.share)) & set(scene.left_out)
    assert all(is_good(item, scene.tolerance_N) for item in scene.judged)
    assert {item.plant for item in scene.judged} == {"sample_1", "sample_2", "sample_3"}
    assert scene.cost_us_s > 0.0
    assert scene.cost_us_s < scene.cost_full_us_s or not scene.left_out
    assert is_met(scene.judged, scene.tolerance_N) or not scene.left_out
    assert [at.hz for at in scene.rates] == list(RATES_HZ)
    assert scene.control_hz >= LEAST_CONTROL_HZ
    assert all(is_good(item, scene.tolerance_N) for item in scene.at_chosen.judged)


@pytest.mark.parametrize("scene", STORED.scenes, ids=lambda scene: scene.name)
def test_what_is_stored_is_of_a_shipped_scene_as_it_is(scene: MeasuredScene) -> None:
    assert scene.name in shipped_scenes()
    stated = load_scene(scene.name)
    assert (scene.fingerprint, scene.tolerance_N) == (stated.fingerprint, stated.force.tolerance_rms_N)
    if terms_of(stated).left_out:
        assert terms_of(stated).left_out == scene.left_out


def test_a_case_gives_what_was_stored() -> None:
    """The whole device again, for one scene with what it leaves out: the file belongs to this model and this plant."""
    brain = next(scene for scene in STORED.scenes if scene.name == "brain")
    hz = brain.control_hz, brain.inference_hz
    case = Case("brain", "sample_1", tuple(sorted(brain.left_out)), "", True, *hz, STORED.seconds)
    assert run(case) == pytest.approx(on_first(brain.judged).chosen_N, rel=0.05)


@pytest.mark.parametrize(("scene", "sent_hz"), [("fluoroscopy", 15.0), ("coronary", 83.0)])
def test_a_publisher_sends_as_often_as_its_scene_says(scene: str, sent_hz: float) -> None:
    played = Play(Case(scene, control_hz=500, inference_hz=83))
    sent = {setpoint for now_ms in range(2_000, 4_000) if (setpoint := played.publish(1e-3 * now_ms)) is not None}
    stamps_s, forces_N = np.array(sorted((setpoint.stamp_s, setpoint.force_N) for setpoint in sent)).T
    assert np.diff(stamps_s) == pytest.approx(1.0 / sent_hz, rel=1e-6)
    assert forces_N == pytest.approx(np.interp(stamps_s - played.begins_s, played.time_s, played.force_N))


def test_a_term_is_required_that_costs_more_than_its_share_learning_or_not() -> None:
    terms = (
        Without("rate", 0.011, 0.0, NO_COST),
        Without("creep", 0.0, 0.011, NO_COST),
        Without("motor", 0.0099, -0.5, NO_COST),
    )
    assert (required(terms, 0.05, 0.2), required(terms, 0.025, 0.2)) == (("rate", "creep"), ("rate", "creep", "motor"))


def test_a_choice_is_good_within_the_tolerance_or_beside_the_full_model() -> None:
    assert is_good(Judged("sample_2", True, 0.001, JUDGED * 0.05), 0.05)
    assert not is_good(Judged("sample_2", True, 0.001, 0.041), 0.05)
    assert is_good(Judged("sample_2", True, 0.060, 0.060 + SHARE * 0.05), 0.05)
    assert not is_good(Judged("sample_2", True, 0.060, 0.071), 0.05)


@pytest.fixture
def costless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is chosen takes the same."""
    monkeypatch.setattr(required_terms, "costs", lambda cases: [Cost(1.0, 1.0)] * len(cases))


@pytest.mark.usefixtures("costless")
def test_what_is_only_missed_together_is_put_back() -> None:
    """Two terms that stand in for each other: either may go, and not both."""

    def outcomes(cases: Iterable[Case]) -> dict[Case, float]:
        return {
            case: 0.001
            + 0.004 * ("scale" in case.left_out)
            + 0.1 * ("rate" in case.left_out)
            + 0.1 * ({"scale", "offset"} <= set(case.left_out))
            for case in cases
        }

    found = measure("coronary", outcomes)
    assert set(TERMS) - set(found.left_out) == {"rate", "scale"}
    assert all(item.chosen_N < 0.01 for item in found.judged)


def test_what_was_put_back_is_tried_again() -> None:
    """`scale` counts for more, and is not enough; beside `offset` it is not needed."""
    added_N = {"scale": 0.004, "offset": 0.003}
    terms = tuple(Without(term, added_N.get(term, 0.0), 0.0, NO_COST) for term in TERMS)
    expected = tuple(term for term in TERMS if term != "offset")
    assert spared(terms, 0.05, lambda out: "offset" not in out) == expected


@pytest.mark.usefixtures("costless")
def test_the_lowest_rates_are_taken_that_do_what_the_fastest_do() -> None:

    def outcomes(cases: Iterable[Case]) -> dict[Case, float]:
        """Of samples 2 and 3 the second is missed at the slow plans, and 250 Hz would do best of all."""
        return {
            case: 0.001 * case.control_hz / 1000 + 0.1 * (case.inference_hz == 83 and case.plant == "sample_3")
            for case in cases
        }

    found = measure("coronary", outcomes)
    assert (found.control_hz, found.inference_hz) == (500, 500)


@pytest.mark.usefixtures("costless")
def test_a_scene_that_the_full_model_does_not_meet_leaves_nothing_out() -> None:
    assert measure("coronary", lambda cases: dict.fromkeys(cases, 0.3)).left_out == ()


def test_a_scene_without_a_signal_cannot_be_measured(tmp_path: Path) -> None:
    bare = tmp_path / "bare.toml"
    bare.write_text(
        'name = "bare"\ndescription = ""\n[force]\nleast_N = 0.0\nmost_N = 2.0\nresolution_N = 0.1\n'
        'tolerance_rms_N = 0.05\n[insert]\nname = "MRE-50-40"\nmodel = "torque_mre_50_40"\n'
    )
    with pytest.raises(ConfigError, match="signal is missing"):
        measure(str(bare), lambda cases: {})


REFUSING = Mock(submit=Mock(side_effect=ConnectionError("worker lost")))
"Takes no run at all."


def test_what_is_known_is_not_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_runs, "run", lambda case: 0.01 * len(case.left_out))
    known: dict[Case, float] = {}
    cases = [Case("brain"), Case("brain", left_out=("rate",)), Case("brain")]
    with ThreadPoolExecutor(1) as pool:
        first = run_all(cases, pool, known)
    assert list(first.values()) == [0.0, 0.01]
    assert run_all(cases, REFUSING, known) == first
    changed = {
        "scene": "bronchoscopy",
        "plant": "sample_2",
        "left_out": ("motor",),
        "search": "nearest",
        "is_learning": False,
        "control_hz": 500,
        "inference_hz": 83,
        "seconds": 1.0,
    }
    assert list(changed) == list(Case.__struct_fields__)
    for name, value in changed.items():
        with pytest.raises(ConnectionError):
            run_all([msgspec.structs.replace(cases[0], **{name: value})], REFUSING, known)
