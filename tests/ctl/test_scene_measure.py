"""`tormagctl scene measure`: what is asked, what counts as an error, what is chosen and kept, and one live run."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from tormagd.ctl import scene_measure
from tormagd.ctl.scene_measure import COMES_S, LASTS_S, Course, Heard, course_of, errors_N
from tormagd.scenes.measured import OperatingPoint, Served, own_way
from tormagd.scenes.scene import Bandwidth, Solver, load_scene, scene_path

RANGE_N = (0.65, 2.0)
SLOW = OperatingPoint(500, 83, "newton")
START_NS = 1_000_000_000
OPEN_MM = 95.0


@pytest.mark.parametrize(
    ("stated", "signal_hz", "seldom_hz", "ahead_s"),
    [({}, 83, 20, 0.0), ({"setpoint_hz": 15.0}, 15, 15, 0.0), ({"is_known_ahead": True}, 83, 20, 0.4)],
)
def test_a_publisher_sends_as_often_as_its_scene_says(
    stated: dict[str, Any], signal_hz: float, seldom_hz: float, ahead_s: float
) -> None:
    scene = load_scene("coronary")
    assert scene.signal is not None
    scene = msgspec.structs.replace(scene, signal=msgspec.structs.replace(scene.signal, **stated))
    course = course_of("coronary", scene, own_way(scene, 500, 83, "newton"), RANGE_N)
    parts = {part.name: part for part in course.parts}
    assert [parts[each].sent_hz for each in ("signal", "seldom", "contact")] == [signal_hz, seldom_hz, signal_hz]
    assert [parts[each].ahead_s for each in ("signal", "contact", "steps")] == [ahead_s, ahead_s, 0.0]
    assert len(course.force_N) == len(course.time_s) == round(1e3 * sum(LASTS_S.values()))
    assert course.force_N.min() == pytest.approx(RANGE_N[0])
    assert course.force_N[round(1e3 * parts["steps"].begins_s)] == pytest.approx(1.73)


def test_a_finger_in_a_pad_meets_no_wall() -> None:
    parts = course_of("radial_pulse", load_scene("radial_pulse"), SLOW, (3.35, 3.9)).parts
    assert [part.name for part in parts] == ["approach", "signal", "seldom", "steps"]


def truth_of(off_N: float, gap_mm: float) -> tuple[Course, Heard]:
    """A plant whose force is off by `off_N` throughout."""
    course = course_of("coronary", load_scene("coronary"), SLOW, RANGE_N)
    t_ns = START_NS + 1e9 * course.time_s
    columns = {"t_ns": t_ns, "force_N": course.force_N + off_N, "gap_mm": np.full(len(t_ns), gap_mm)}
    return course, Heard(columns, {}, START_NS, 0.1, 200.0)


@pytest.mark.parametrize(("off_N", "gap_mm", "seen_N"), [(0.02, 60.0, 0.02), (-0.02, 95.0, 0.02), (0.02, 95.0, 0.0)])
def test_an_error_is_the_plants_and_an_open_gaps_excess_is_none(off_N: float, gap_mm: float, seen_N: float) -> None:
    assert errors_N(*truth_of(off_N, gap_mm), OPEN_MM, 0.0) == pytest.approx(
        dict.fromkeys(("signal", "seldom", "steps", "contact"), seen_N), abs=1e-5
    )


def test_a_step_that_still_comes_does_not_count() -> None:
    course, heard = truth_of(0.0, 60.0)
    begins_s = {part.name: part.begins_s for part in course.parts}["steps"]
    heard.truth["force_N"][(course.time_s >= begins_s) & (course.time_s < begins_s + COMES_S)] += 1.0
    heard.truth["t_ns"] += 0.6e6  # what is seen between two setpoints is no error against the next step
    assert errors_N(course, heard, OPEN_MM, 0.0)["steps"] == pytest.approx(0.0, abs=1e-5)


def test_below_its_standby_a_brake_is_asked_for_that() -> None:
    course, heard = truth_of(0.0, 60.0)
    heard.truth["force_N"] = np.maximum(heard.truth["force_N"], 0.9)
    assert errors_N(course, heard, OPEN_MM, 0.9)["contact"] == pytest.approx(0.0, abs=1e-5)
    assert errors_N(course, heard, OPEN_MM, 0.0)["contact"] > 0.1


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(scene_path("coronary").read_text(encoding="utf-8").replace("2.0", "1.9", 1), encoding="utf-8")
    return path


NEARER = msgspec.structs.replace(SLOW, standby_N=0.849)


@pytest.mark.parametrize(
    ("refuses", "chosen", "nearer_is"),
    [
        ((), SLOW, "offered"),
        ((NEARER,), SLOW, "not offered"),
        ((SLOW,), OperatingPoint(1_000, 500, "newton"), "absent"),
    ],
    ids=str,
)
def test_the_cheapest_way_is_chosen_and_none_is_offered_that_the_other_device_refuses(
    refuses: tuple[OperatingPoint, ...],
    chosen: OperatingPoint,
    nearer_is: str,
    mine: Path,
    ctl: Any,
    checked_here: None,
    monkeypatch: Any,
) -> None:
    def served(name: str, _scene: Any, way: OperatingPoint, sample: int, *_: Any) -> tuple[Served, float]:
        error_N = 0.2 if sample == 3 and way in refuses else 0.01 if way.standby_N else 0.04
        share = 1e-4 * (way.control_hz + way.inference_hz) + len(way.search)
        return Served(way, f"sample_{sample}", {"signal": error_N}, share, 50.0), 200.0

    monkeypatch.setattr(scene_measure, "served", served)
    ended = ctl("--json", "scene", "measure", str(mine)).ended(0)
    assert tuple(ended.result["judged"][0]["way"].values()) == (chosen.control_hz, chosen.inference_hz, chosen.search)
    shown = ctl("scene", "explain", str(mine)).ended(0).out
    assert next(line for line in shown.splitlines() if "chosen" in line).startswith(str(chosen))
    assert len(ended.result["more"]) == 4
    line = next((line for line in shown.splitlines() if line.startswith(str(NEARER))), "absent")
    assert ("absent" if line == "absent" else "not offered" if "not offered" in line else "offered") == nearer_is


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


@pytest.mark.live
def test_a_daemon_is_measured_live_beside_a_simulated_device(tmp_path: Path) -> None:
    found, machine_us = scene_measure.served("coronary", load_scene("coronary"), SLOW, 2, RANGE_N, tmp_path)
    assert found.rms_N.keys() == {"signal", "seldom", "steps", "contact"}
    assert all(0.0 < error_N < RANGE_N[1] for error_N in found.rms_N.values())
    assert 0.0 < found.share < 1.0
    assert machine_us > 0.0
    assert list(tmp_path.glob("*/*.json"))  # so that another run begins with what this one learned
