"""The tactile element in the core: how a finger touches it, what its elastomer remembers, what the core refuses."""

from pathlib import Path

import msgspec
import pytest

from tormagd.config import Config
from tormagd.control.assembly.build import SEVERAL_BRANCHES, Core, build_core, choose_solver
from tormagd.control.core import Planner
from tormagd.control.measure import Measure
from tormagd.control.nominal import PRESSED, Pressing
from tormagd.control.records import Handle, Measured, TimedSetpoint
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import Turn
from tormagd.ground.plain_values import plain
from tormagd.scenes.scene import EVERY_TERM, load_scene, scene_path
from tormagd_client.endpoints import ConfigError

CONFIG = Config(scene="radial_pulse")
SCENE = load_scene("radial_pulse")
DEPTH_MM = 2.0
PERIOD_S = 0.1


@pytest.fixture(scope="module")
def pad_core() -> Core:
    return build_core(CONFIG)


def pressed(depth_mm: float, rate_mm_s: float = 0.0, *, gap_mm: float = 78.0, **changes: object) -> Measured:
    handle, half_mm = Handle(depth_mm, rate_mm_s, Turn(1.0, 0.0, 0.0)), gap_mm / 2.0
    return Measured(1, True, 0.0, half_mm, half_mm, 0.0, 0.0, 3.5, handle, depth_mm, 0.0, 0.0).replaced(**changes)


def held(core: Core, seconds: float, force_N: float = 3.5, *, depth_mm: float = DEPTH_MM) -> Planner:
    planner = core.planner()
    for tick in range(1, round(seconds / PERIOD_S) + 1):
        now_s = tick * PERIOD_S
        measured = pressed(depth_mm, gap_mm=planner.planned.gap_mm, sensed_s=-1.0)
        planner.plan(now_s, TimedSetpoint(force_N, now_s, 0.1), measured)
    return planner


def test_a_finger_on_its_way_is_planned_for_at_the_scenes_depth() -> None:
    contact = Pressing(DEPTH_MM)
    fingers = None, pressed(1.0, 1.0), pressed(1.9, -0.5)
    assert [contact.planned(None, None, each) for each in fingers] == [(DEPTH_MM, 0.0), (DEPTH_MM, 0.0), (1.9, -0.5)]
    assert contact.planned(1.5, 0.25, pressed(1.9)) == (1.5, 0.25)
    assert [contact.is_known(pressed(share * PRESSED * DEPTH_MM)) for share in (0.99, 1.0)] == [False, True]
    assert not contact.slides


def test_a_finger_that_draws_back_is_still_pushed_out(measure) -> None:
    finger = Measure(47.5, 0.002, False, 100.0, 1e-3)
    for number in range(1, 60):
        depth_mm = 2.0 - 0.02 * number
        drawn = measure(number, handle_mm=depth_mm, force_N=3.0)
        measured = finger.update((number - 1) * 1e-3, number * 1e-3, drawn, needs_homing=False)
    assert (measured.force_N, measured.handle.displacement_mm, measured.handle.rate_mm_s) == (
        3.0,
        pytest.approx(depth_mm),
        pytest.approx(-20.0, rel=0.4),
    )


def test_a_pad_that_is_held_is_pressed_harder_as_it_relaxes(pad_core: Core) -> None:
    fresh, later = held(pad_core, PERIOD_S), held(pad_core, 60.0)
    relaxed_N, max_N = later.believe.memory.relaxed_N, pad_core.portrait.max_N
    assert fresh.believe.memory.relaxed_N == pytest.approx(0.0, abs=0.01)
    assert 0.15 < relaxed_N < 0.35
    assert later.planned.field_mT > fresh.planned.field_mT + 20.0
    assert later.planned.predicted_N == pytest.approx(3.5, abs=0.01)
    # what the device gives at most has fallen by as much
    assert later.believe.device.force_N(max_N) == pytest.approx(max_N - relaxed_N)


def test_without_the_term_nothing_is_remembered() -> None:
    without = build_core(CONFIG, msgspec.structs.replace(SCENE, terms=EVERY_TERM.without("memory")))
    forgetful = held(without, 60.0)
    assert (forgetful.believe.memory.relaxed_N, forgetful.planned.field_mT) == (
        0.0,
        pytest.approx(held(without, PERIOD_S).planned.field_mT, abs=0.01),
    )


def test_planning_that_begins_anew_has_not_forgotten(pad_core: Core) -> None:
    planner = held(pad_core, 5.0)
    remembered = plain(planner.believe.memory)
    planner.afresh(5.1)
    assert plain(planner.believe.memory) == remembered


def test_a_force_out_of_the_pads_reach_says_so(pad_core: Core) -> None:
    assert Limit.F_MIN in held(pad_core, 0.1, 3.21).planned.limits
    assert Limit.F_MAX in held(pad_core, 20.0, 3.9, depth_mm=1.82).planned.limits


def test_where_the_force_falls_branches_are_compared() -> None:
    assert choose_solver(SCENE, rises=False) is SEVERAL_BRANCHES
    assert choose_solver(SCENE, rises=True).solver == "newton"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"[finger]\ndepth_mm = 2.0": ""}, "element = 'tactile': allowed is [finger]"),
        ({"depth_mm = 2.0": "depth_mm = 5.0"}, "finger.depth_mm = 5: allowed is 0..4.5"),
        ({"depth_mm = 2.0": "depth_mm = 2.0\nmost_mm_s = 9.0"}, "finger.most_mm_s = 9: allowed is -4..4"),
        ({"[finger]": "[handle]\nmost_mm_s = 50.0\n[finger]"}, "allowed is none where element is tactile; [finger]"),
        ({'model = "t': 'thickness_mm = 12.0\nmodel = "t'}, "insert.thickness_mm = 12.0: allowed is none where"),
        ({"tactile_mre_c": "torque_mre_50_40"}, "element = 'tactile': allowed is torque, on which"),
        ({"most_N = 3.9": "most_N = 6.0"}, "force.most_N = 6: allowed is"),
    ],
)
def test_what_a_pad_cannot_serve_is_refused(tmp_path: Path, changes: dict[str, str], said: str) -> None:
    text = Path(scene_path("radial_pulse")).read_text().replace('file = "radial_pulse.csv"', "bandwidth_hz = 0.1")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        build_core(Config(scene=str(tmp_path / "scene.toml")))
    assert said in str(caught.value)
