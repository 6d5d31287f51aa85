"""Every term can be left out at construction; then it is neither learned nor used."""

import math

import msgspec
import pytest

from tormagd.config import Config
from tormagd.control.ask.forecast import Forecast
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.strength import UNSEEN
from tormagd.control.core import Planner
from tormagd.control.records import Handle, Plan, TimedSetpoint
from tormagd.control.safety.codes import Limit
from tormagd.element.model.displacement import MOBILISED_MM, Turn
from tormagd.ground.plain_values import plain
from tormagd.scenes.scene import EVERY_TERM, Scene, load_scene

pytestmark = pytest.mark.usefixtures("forgetful")

PERIOD_S = 0.004


def scene_without(*names: str) -> Scene:
    return msgspec.structs.replace(load_scene("coronary"), terms=EVERY_TERM.without(*names))


def core_without(*names: str) -> Core:
    return build_core(Config(), scene_without(*names))


@pytest.fixture(scope="session")
def told(moving, planned):
    def tell(planner: Planner, asked_N: float, rate_mm_s: float = 42.0, **setpoint: object) -> Plan:
        at_mm = 100.0 + rate_mm_s * (planner.planned.time_s + PERIOD_S)
        handle = Handle(MOBILISED_MM, rate_mm_s, Turn(1.0, 0.0, at_mm), rate_mm_s)
        force_N = 1.2 + 0.002 * ((planner.believe.read + 1) % 2)  # a sensor that stands still is not believed
        plan = planned(planner, asked_N, moving(78.0, force_N, handle=handle, handle_mm=at_mm), **setpoint)
        planner.governor.foresee()
        return plan

    return tell


@pytest.fixture(scope="session")
def after(told):
    def run(core: Core, plans: int, rate_mm_s: float = 42.0, force_N: float = 1.0) -> Planner:
        planner = core.planner()
        for _ in range(plans):
            told(planner, force_N, rate_mm_s)
        return planner

    return run


def test_without_the_rate_one_table_answers_and_no_network_is_asked(after) -> None:
    unlearned = ("scale", "offset", "creep")
    full, core = core_without(*unlearned), core_without("rate", *unlearned)
    assert core.solver.solver == "portrait"
    gaps_mm, differing_mm = (
        [after(each, 2, rate).planned.gap_mm for rate in (2.0, 42.0, 250.0)] for each in (core, full)
    )
    assert max(gaps_mm) == min(gaps_mm)
    assert max(differing_mm) - min(differing_mm) > 0.2
    for force_N in (0.7, 1.0, 1.5):
        plan = core.planner().plan(PERIOD_S, TimedSetpoint(force_N, PERIOD_S, 0.1), None)
        assert (plan.gap_mm, plan.confidence) == (pytest.approx(core.portrait.gap_mm_at(force_N), abs=1e-6), 1.0)
    assert Limit.F_MIN in core.planner().plan(PERIOD_S, TimedSetpoint(0.1, PERIOD_S, 0.1), None).limits


def test_a_search_that_is_named_runs_all_the_same() -> None:
    scene = load_scene("pulse")
    core = build_core(Config(scene="pulse"), msgspec.structs.replace(scene, terms=EVERY_TERM.without("rate")))
    assert core.solver.solver == scene.solver.name == "nearest"


def test_scale_and_offset_are_learned_each_on_its_own(after) -> None:
    fits = {names: after(core_without(*names), 100).believe.device for names in ((), ("scale",), ("offset",))}
    assert fits[()].scale != 1.0
    assert fits[()].offset_N != 0.0
    assert (fits[("scale",)].scale, fits[("scale",)].scale_variance, fits[("offset",)].offset_N) == (
        1.0,
        pytest.approx(UNSEEN.scale_variance),
        0.0,
    )
    assert [fit.force_N(1.0871) for fit in fits.values()] == pytest.approx([1.2] * 3, abs=0.04)
    neither = after(core_without("scale", "offset"), 100).believe
    assert neither.device == UNSEEN
    assert neither.read > 0


def test_without_the_creep_term_nothing_slow_is_learned(after) -> None:
    assert after(core_without(), 100, rate_mm_s=2.0).believe.slow.factor > 1.0
    slow = after(core_without("creep"), 100, rate_mm_s=2.0).believe.slow
    assert (slow.factor, slow.learned) == (1.0, 0.0)


def test_without_the_forecast_a_force_is_held_until_the_next_and_nothing_is_remembered(told) -> None:
    def motion(core: Core) -> tuple[float, float, object]:
        planner = core.planner()
        for number in range(50):
            plan = told(planner, 1.0 + 0.002 * number)
        return planner.governor.slope_N_s, plan.gap_speed_mm_s, plain(planner.governor.forecast)

    slope_N_s, speed_mm_s, remembered = motion(core_without())
    assert slope_N_s == pytest.approx(0.5, rel=0.05)
    assert speed_mm_s < -5.0
    assert remembered != plain(Forecast())
    assert motion(core_without("forecast")) == (0.0, 0.0, plain(Forecast()))


@pytest.mark.parametrize("names", [(), ("motor",)])
def test_without_the_motor_late_carriages_stay_late(moving, planned, names: tuple[str, ...]) -> None:
    core = core_without(*names)
    planner = core.planner()
    planner.governor.asked_N = 1.0
    planner.governor.from_mm = planner.governor.sent_mm = core.portrait.gap_mm_at(1.0)
    for number in range(1, 101):
        force_N = 1.0 + 0.5 * PERIOD_S * number
        late = moving(core.portrait.gap_mm_at(force_N) + 0.3, 1.0, left_mm_s=-7.0, right_mm_s=-7.0, sensed_s=-math.inf)
        preview_N = tuple(force_N + 0.5 * 0.002 * step for step in range(1, 35))
        planned(planner, force_N, late, preview_N=preview_N, preview_dt_s=0.002)
    lag_s = planner.believe.carriages.lag_s
    assert lag_s == 0.0 if names else lag_s > 0.002


def test_without_the_motor_what_is_known_of_it_is_not_looked_at(told) -> None:
    ahead = {"preview_N": tuple(1.0 + 0.1 * (step > 15) for step in range(35)), "preview_dt_s": 0.002}

    def gap_mm(core: Core, lag_s: float) -> float:
        planner = core.planner()
        planner.believe.teach(Learned(lag_s=lag_s))
        return told(planner, 1.0, **ahead).gap_mm

    assert gap_mm(core_without(), 0.02) != gap_mm(core_without(), 0.0)
    assert gap_mm(core_without("motor"), 0.02) == gap_mm(core_without("motor"), 0.0)


@pytest.fixture
def duties(make_bench):
    """The first duties of an armed device on its way from 80 mm, nearly all of which is fed forward."""

    def first(target_mm: float, *left_out: str, **motor: float) -> list[float]:
        bench = make_bench(scene_without(*left_out), motor=motor).enabled()
        return [bench.step(target_mm).left_duty for _ in range(3)]

    return first


def test_without_the_motor_nothing_is_fed_forward(duties) -> None:
    for target_mm in (90.0, 60.0):
        full, left = duties(target_mm), duties(target_mm, "motor")
        assert abs(left[0]) < 0.1 * abs(full[0])
        assert all(abs(duty) < abs(whole) for duty, whole in zip(left, full, strict=True))


def test_dry_friction_counts_both_ways_and_the_magnets_pull_where_it_opens(duties) -> None:
    for target_mm, is_opening in ((90.0, True), (60.0, False)):
        full, smooth, free = duties(target_mm), duties(target_mm, coulomb_V=0.0), duties(target_mm, pull_V=0.0)
        assert all(abs(duty) < abs(whole) for duty, whole in zip(smooth, full, strict=True))
        assert all((whole > duty) is is_opening for duty, whole in zip(free, full, strict=True))
        assert is_opening or free == full
