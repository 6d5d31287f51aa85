"""The measurement of scenes: what is stored follows from its own numbers, and a case gives them again."""

from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from benchmarks import scene_runs
from benchmarks.scene_runs import Case, Play, run, run_all
from benchmarks.scenes import RATES_HZ, case_of, measured_scene

from tormagd.scenes.measured import TOLERATED, WORSE, MeasuredScene, OperatingPoint, allowed_N, measured
from tormagd.scenes.scene import MIN_CONTROL_HZ, load_scene, shipped_scenes
from tormagd_client.endpoints import ConfigError

STORED = measured()


@pytest.mark.parametrize("scene", STORED.scenes, ids=lambda scene: scene.name)
def test_what_is_stored_follows_from_its_own_numbers_and_acts(scene: MeasuredScene) -> None:
    stated = load_scene(scene.name)
    assert (scene.fingerprint, scene.tolerance_N) == (stated.fingerprint, stated.force.tolerance_rms_N)
    assert (stated.bandwidth.control_hz, stated.bandwidth.inference_hz) == (
        scene.chosen.control_hz,
        scene.chosen.inference_hz,
    )
    assert scene.chosen.control_hz >= MIN_CONTROL_HZ
    assert scene.usual.way == OperatingPoint(*RATES_HZ[0], scene.chosen.search)
    decided = [item for item in scene.judged if item.group == "deciding"]
    if scene.chosen != scene.usual.way:
        assert all(item.rms_N <= allowed_N(item.usual_N, scene.tolerance_N) for item in decided)
    assert all(STORED.share(each.way) is not None for each in scene.tried)


def test_every_shipped_scene_is_measured() -> None:
    assert tuple(scene.name for scene in STORED.scenes) == shipped_scenes()


def test_a_case_gives_what_was_stored() -> None:
    brain = next(scene for scene in STORED.scenes if scene.name == "brain")
    case = case_of("brain", brain.chosen, "sample_1", "signal", is_learning=True)
    assert run(case) == pytest.approx(brain.of(brain.chosen).rms_N[0], rel=0.05)


@pytest.mark.parametrize("situation", scene_runs.SITUATIONS)
def test_a_device_is_measured_in_every_situation(situation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_runs, "HOLD_S", 1.0)
    error_N = run(Case("coronary", situation=situation, control_hz=500, inference_hz=83, seconds=1.0))
    assert 0.0 < error_N < load_scene("coronary").force.most_N


@pytest.mark.parametrize(
    ("scene", "situation", "sent_hz"),
    [("fluoroscopy", "signal", 15.0), ("coronary", "signal", 83.0), ("coronary", "seldom", 20.0)],
)
def test_a_publisher_sends_as_often_as_its_scene_says(scene: str, situation: str, sent_hz: float) -> None:
    played = Play(Case(scene, situation=situation, control_hz=500, inference_hz=83))
    sent = {setpoint for now_ms in range(2_000, 4_000) if (setpoint := played.publish(1e-3 * now_ms)) is not None}
    stamps_s, forces_N = np.array(sorted((setpoint.stamp_s, setpoint.force_N) for setpoint in sent)).T
    assert np.diff(stamps_s) == pytest.approx(1.0 / sent_hz, rel=1e-6)
    assert forces_N == pytest.approx(np.interp(stamps_s - played.begins_s, played.time_s, played.force_N))


def test_an_error_is_allowed_within_the_tolerance_or_beside_the_usual_way() -> None:
    assert allowed_N(0.001, 0.05) == TOLERATED * 0.05
    assert allowed_N(0.060, 0.05) == 0.060 + WORSE * 0.05
    assert allowed_N(0.048, 0.05) == 0.05, "what the usual way keeps is kept"


@pytest.mark.parametrize(
    ("situation", "device", "chosen_hz"),
    [
        ("signal", "sample_3", (500, 500)),
        ("contact", "draw 85", (500, 500)),
        ("contact", "draw 105", (500, 83)),
        ("frozen", "", (500, 83)),
    ],
)
def test_the_lowest_rates_are_taken_that_do_what_the_usual_do(
    situation: str, device: str, chosen_hz: tuple[int, int]
) -> None:

    def outcomes(cases: Collection[Case]) -> dict[Case, float]:
        return {
            case: 0.001 + 0.1 * (case.inference_hz == 83 and (case.situation, case.device) == (situation, device))
            for case in cases
        }

    chosen = measured_scene("coronary", outcomes).chosen
    assert (chosen.control_hz, chosen.inference_hz) == chosen_hz


def test_a_scene_that_the_usual_way_does_not_meet_keeps_it() -> None:
    found = measured_scene("coronary", lambda cases: dict.fromkeys(cases, 0.3))
    assert (found.chosen, found.is_met) == (found.usual.way, False)


def test_a_scene_without_a_signal_cannot_be_measured(tmp_path: Path) -> None:
    bare = tmp_path / "bare.toml"
    bare.write_text(
        'name = "bare"\ndescription = ""\n[force]\nleast_N = 0.0\nmost_N = 2.0\nresolution_N = 0.1\n'
        'tolerance_rms_N = 0.05\n[insert]\nname = "MRE-50-40"\nmodel = "torque_mre_50_40"\n'
    )
    with pytest.raises(ConfigError, match="signal is missing"):
        measured_scene(str(bare), lambda cases: {})


REFUSING = Mock(submit=Mock(side_effect=ConnectionError("worker lost")))


def test_what_is_known_is_not_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_runs, "run", lambda case: 0.01 * len(case.search))
    known: dict[Case, float] = {}
    cases = [Case("brain"), Case("brain", search="newton"), Case("brain")]
    with ThreadPoolExecutor(1) as pool:
        first = run_all(cases, pool, known)
    assert list(first.values()) == pytest.approx([0.0, 0.06])
    assert run_all(cases, REFUSING, known) == first
    with pytest.raises(ConnectionError):
        run_all([msgspec.structs.replace(cases[0], situation="steps")], REFUSING, known)
