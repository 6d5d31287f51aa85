"""`tormagctl scene measure`: what is asked, what counts as an error, what is chosen and kept, and one live run."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from tormagd.ctl import scene_measure
from tormagd.ctl.scene_measure import COMES_S, LASTS_S, LEARN_S, Course, Heard, course_of, errors_N
from tormagd.scenes.measured import OperatingPoint, Served
from tormagd.scenes.scene import Bandwidth, Scene, Solver, load_scene, scene_path

RANGE_N = (0.65, 2.0)
SLOW = OperatingPoint(500, 83, "newton")
START_NS = 1_000_000_000
WALL_MM = 30.0


@pytest.mark.parametrize(
    ("stated", "signal_hz", "seldom_hz", "preview_s"),
    [({}, 83, 20, 0.0), ({"setpoint_hz": 15.0}, 15, 15, 0.0), ({"is_known_ahead": True}, 83, 20, 0.4)],
)
def test_a_publisher_sends_as_often_as_its_scene_says(
    stated: dict[str, Any], signal_hz: float, seldom_hz: float, preview_s: float
) -> None:
    scene = load_scene("coronary")
    assert scene.signal is not None
    scene = msgspec.structs.replace(scene, signal=msgspec.structs.replace(scene.signal, **stated))
    course = course_of("coronary", scene, SLOW, RANGE_N)
    parts = {part.name: part for part in course.parts}
    assert [parts[each].sent_hz for each in ("signal", "seldom", "contact")] == [signal_hz, seldom_hz, signal_hz]
    assert (parts["signal"].preview_s, parts["steps"].preview_s) == (preview_s, 0.0)
    assert len(course.force_N) == len(course.time_s) == round(1e3 * sum(LASTS_S.values()))
    assert course.force_N.min() == pytest.approx(RANGE_N[0])
    assert course.force_N[round(1e3 * parts["steps"].begins_s)] == pytest.approx(1.73)


def test_a_finger_in_a_pad_meets_no_wall() -> None:
    parts = course_of("radial_pulse", load_scene("radial_pulse"), SLOW, (3.35, 3.9)).parts
    assert [part.name for part in parts] == ["approach", "signal", "seldom", "steps"]


def truth_of(scene: Scene, off_N: float, gap_mm: float) -> tuple[Course, Heard]:
    """A plant whose force is off by `off_N` throughout; the handle is at the wall when the contact begins."""
    course = course_of("coronary", scene, SLOW, RANGE_N)
    begins_s = course.parts[-1].begins_s
    handle_mm = WALL_MM + scene.handle.most_mm_s * (course.time_s - begins_s)
    wall_N = np.clip(scene.force.most_N * (course.time_s - begins_s) / scene_measure.CONTACT_S, *RANGE_N)
    force_N = off_N + np.where(course.time_s < begins_s, course.force_N, wall_N)
    t_ns = START_NS + 1e9 * course.time_s
    columns = {"t_ns": t_ns, "force_N": force_N, "handle_mm": handle_mm, "gap_mm": np.full(len(t_ns), gap_mm)}
    return course, Heard(columns, {}, START_NS, START_NS + round(1e9 * begins_s), 0.1, 200.0)


@pytest.mark.parametrize(("off_N", "gap_mm", "seen_N"), [(0.02, 60.0, 0.02), (-0.02, 95.0, 0.02), (0.02, 95.0, 0.0)])
def test_an_error_is_the_plants_and_an_open_gaps_excess_is_none(off_N: float, gap_mm: float, seen_N: float) -> None:
    scene = load_scene("coronary")
    found = errors_N(*truth_of(scene, off_N, gap_mm), scene, RANGE_N)
    assert found == pytest.approx(dict.fromkeys(("signal", "seldom", "steps", "contact"), seen_N), abs=2e-3)


def test_what_is_learned_at_first_and_a_step_that_still_comes_do_not_count() -> None:
    scene = load_scene("coronary")
    course, heard = truth_of(scene, 0.0, 60.0)
    begins_s = {part.name: part.begins_s for part in course.parts}
    for name, lasts_s in (("signal", LEARN_S), ("steps", COMES_S)):
        heard.truth["force_N"][(course.time_s >= begins_s[name]) & (course.time_s < begins_s[name] + lasts_s)] += 1.0
    found = errors_N(course, heard, scene, RANGE_N)
    assert (found["signal"], found["steps"]) == (pytest.approx(0.0, abs=2e-3), pytest.approx(0.0, abs=2e-3))


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(scene_path("coronary").read_text(encoding="utf-8").replace("2.0", "1.9", 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(("on_the_other_N", "chosen"), [(0.03, SLOW), (0.2, OperatingPoint(1_000, 500, "newton"))])
def test_the_cheapest_way_is_chosen_unless_the_other_device_refuses_it(
    on_the_other_N: float, chosen: OperatingPoint, mine: Path, ctl: Any, checked_here: None, monkeypatch: Any
) -> None:
    def served(name: str, _scene: Any, way: OperatingPoint, sample: int, _range_N: Any) -> tuple[Served, float]:
        error_N = on_the_other_N if sample == 3 and way == SLOW else 0.01
        share = 1e-4 * (way.control_hz + way.inference_hz) + len(way.search)
        return Served(way, f"sample_{sample}", {"signal": error_N}, share, 50.0), 200.0

    monkeypatch.setattr(scene_measure, "served", served)
    ended = ctl("--json", "scene", "measure", str(mine)).ended(0)
    assert tuple(ended.result["judged"][0]["way"].values()) == (chosen.control_hz, chosen.inference_hz, chosen.search)
    shown = ctl("scene", "explain", str(mine)).ended(0).out
    assert next(line for line in shown.splitlines() if "chosen" in line).startswith(str(chosen))


@pytest.mark.parametrize(
    ("hz", "search", "runs", "first", "count"),
    [
        ((500, 83), "auto", "newton", "1000 / 500 Hz, newton", 4),
        ((1_000, 100), "auto", "newton", "1000 / 500 Hz, newton", 5),
        ((2_000, 83), "nearest", "nearest", "2000 / 500 Hz, newton", 5),
        ((500, 83), "torch", "torch", "1000 / 500 Hz, newton", 5),
        ((500, 83), "auto", "nearest", "1000 / 500 Hz, nearest", 3),
    ],
)
def test_searches_compete_at_rates_about_those_that_a_scene_states(
    hz: tuple[int, int], search: str, runs: str, first: str, count: int
) -> None:
    scene = msgspec.structs.replace(load_scene("coronary"), bandwidth=Bandwidth(*hz), solver=Solver(search))
    ways = scene_measure.ways_of(scene, runs)
    assert (str(ways[0]), len(ways)) == (first, count)


def test_a_scene_without_a_signal_cannot_be_measured(mine: Path, ctl: Any, checked_here: None) -> None:
    text = mine.read_text(encoding="utf-8")
    start = text.index("[signal]")
    mine.write_text(text[:start] + text[text.index("[", start + 1) :], encoding="utf-8")
    assert "signal is missing" in ctl("--json", "scene", "measure", str(mine)).ended(2).error["message"]


@pytest.mark.live
def test_a_daemon_is_measured_live_beside_a_simulated_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_measure, "LASTS_S", LASTS_S | {"approach": 1.0, "signal": 5.0, "seldom": 0.5})
    found, machine_us = scene_measure.served("coronary", load_scene("coronary"), SLOW, 2, RANGE_N)
    assert found.rms_N.keys() == {"signal", "seldom", "steps", "contact"}
    assert all(0.0 < error_N < RANGE_N[1] for error_N in found.rms_N.values())
    assert 0.0 < found.share < 1.0
    assert machine_us > 0.0
