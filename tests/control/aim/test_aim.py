"""From a force to a gap with the shipped model: by what it knows, within what the gap does, never beyond a floor."""

import math
from bisect import bisect_right
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.config import Config
from tormagd.control.aim.portrait import CEILING, LAW_SHARE, Portrait
from tormagd.control.assembly.build import build_core
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Ask, Belief, Handle, Measured, Outside, Plan, TimedSetpoint
from tormagd.control.safety.codes import Limit
from tormagd.element.inverse.solution import FieldSolution, Reach
from tormagd.element.model.displacement import MOBILISED_MM, Turn
from tormagd.element.physics.errors import DomainError

PERIOD_S = 0.004
CONFIG = Config()
TURN = Turn(1.0, 0.0, 100.0)
RESTING = {"handle": Handle(MOBILISED_MM, 0.0, TURN, 42.0)}


@pytest.fixture
def first(core, planned):
    def plan(force_N: float, measured: Measured | None = None, **setpoint: object) -> Plan:
        return planned(core.planner(), force_N, measured, **setpoint)

    return plan


def test_starts_with_the_gap_open(core) -> None:
    plan = core.planner(3.0).planned
    assert (plan.gap_mm, plan.gap_speed_mm_s, plan.time_s, plan.governed_N, plan.limits) == (
        95.0,
        0.0,
        3.0,
        core.portrait.min_N,
        (Limit.NO_SETPOINT,),
    )


@pytest.mark.parametrize("is_there", [False, True], ids=["no device", "at rest"])
def test_without_a_setpoint_the_gap_stays_open(planner, moving, is_there: bool) -> None:
    for tick in range(1, 20):
        plan = planner.plan(tick * PERIOD_S, None, moving(**RESTING) if is_there else None)
    assert (plan.gap_mm, plan.setpoint_N, plan.number) == (pytest.approx(95.0, abs=1.0), None, 19)
    assert Limit.F_MIN not in plan.limits


@pytest.mark.parametrize("rate_mm_s", [0.0, 1.0, 4.9])
@pytest.mark.parametrize("force_N", [0.6, 1.0, 1.8])
def test_a_handle_that_rests_does_not_close_the_gap(first, moving, rate_mm_s: float, force_N: float) -> None:
    resting = moving(handle=Handle(MOBILISED_MM, rate_mm_s, TURN, 42.0))
    gap_mm = first(force_N, moving()).gap_mm
    assert first(force_N, resting).gap_mm == pytest.approx(gap_mm, abs=0.1)
    # a handle that was never seen is planned for as one that moves slowly
    assert first(force_N).gap_mm == pytest.approx(gap_mm, abs=1.5)


def test_the_portrait_rises_and_agrees_with_its_slope(core) -> None:
    portrait = core.portrait
    assert np.all(np.diff(portrait.force_N) > 0.0)
    assert 0.6 < portrait.min_N < 0.7
    assert portrait.max_N > 2.0
    assert min(portrait.slope_N_mm) >= 0.0
    # the slope is dF/dgap: integrated over the range it gives the force range back
    step_mm = 50.0 / (len(portrait.force_N) - 1)
    swept_N = float(np.trapezoid(portrait.slope_N_mm, dx=step_mm))
    assert swept_N == pytest.approx(portrait.max_N - portrait.min_N, rel=0.01)
    assert portrait.force_rate_N_s(1.5, 38.0) == pytest.approx(38.0 * portrait.slope_at_N_mm(1.5))


@pytest.mark.parametrize("force_N", [0.7, 1.0, 1.5, 1.8])
def test_the_planned_gap_gives_the_force_by_the_portrait(core, first, moving, force_N: float) -> None:
    plan, portrait = first(force_N, moving()), core.portrait
    assert np.interp(plan.gap_mm, portrait.gap_mm[::-1], portrait.force_N[::-1]) == pytest.approx(force_N, abs=0.03)
    assert plan.governed_N == pytest.approx(force_N)
    assert plan.confidence > 0.5


@pytest.mark.parametrize(("force_N", "limit"), [(0.05, Limit.F_MIN), (2.5, Limit.RANGE)])
def test_what_cannot_be_given_is_said_once(first, moving, force_N: float, limit: Limit) -> None:
    limits = first(force_N, moving()).limits
    assert limit in limits
    assert len(set(limits)) == len(limits)


def test_a_device_that_gives_more_than_was_asked_at_its_open_gap_is_said(planner, planned, first) -> None:
    planner.believe.teach(Learned(DeviceFit(scale=1.6)))
    plan = planned(planner, 0.7)
    assert Limit.F_MIN in plan.limits
    assert plan.gap_mm == pytest.approx(95.0, abs=0.1)
    assert Limit.F_MIN not in first(0.7).limits


def test_the_trim_is_the_devices_force_over_the_models_where_the_plan_leads(planner, planned) -> None:
    planner.believe.teach(Learned(DeviceFit(1.25, 0.2)))
    assert planned(planner, 1.2).trim == pytest.approx(1.2 / 0.8)


def test_a_plan_is_reached_from_the_one_before_though_its_preview_comes_and_goes(core, planner, planned) -> None:
    tells = {"preview_N": (1.2,) * 20 + (1.9,) * 180, "preview_dt_s": 0.002}
    gaps_mm = [planned(planner, 1.2, **tells if number % 20 < 10 else {}).gap_mm for number in range(100)]
    assert np.abs(np.diff(gaps_mm)).max() <= core.gap_speeds.closing_mm_s * PERIOD_S + 1e-9
    assert gaps_mm[0] - min(gaps_mm) > 0.5


def test_a_preview_gives_the_gaps_speed_and_acceleration(core, planner, first, moving) -> None:

    def force_N(time_s: float) -> float:
        return 1.5 + 0.1 * math.cos(2.0 * math.pi * 3.0 * (time_s - 0.2))

    planner.governor.asked_N = force_N(0.0)
    planner.governor.from_mm = planner.governor.sent_mm = core.portrait.gap_mm_at(force_N(0.0))
    for tick in range(1, 101):
        now_s = 2e-3 * tick
        ahead_N = tuple(force_N(now_s + 2e-3 * step) for step in range(1, 40))
        setpoint = TimedSetpoint(force_N(now_s), now_s, 0.1, preview_N=ahead_N, preview_dt_s=2e-3)
        plan = planner.plan(now_s, setpoint, None)
    curve_N_s2 = -0.1 * (2.0 * math.pi * 3.0) ** 2
    # within 4 ms of the turn: the path is planned in steps of 10
    assert (plan.gap_speed_mm_s, plan.gap_acceleration_mm_s2) == (
        pytest.approx(0.0, abs=2.5),
        pytest.approx(-curve_N_s2 / core.portrait.slope_at_N_mm(1.6), rel=0.2),
    )
    assert first(1.6, moving()).gap_acceleration_mm_s2 == pytest.approx(0.0, abs=1e-6)


def test_the_model_is_never_asked_outside_what_it_was_shown(first) -> None:
    fast = first(1.0, rate_mm_s=1_000.0)
    assert Limit.MODEL_RANGE in fast.limits
    (replaced,) = fast.outside
    assert (replaced.quantity, replaced.asked) == ("rate_mm_s", 1_000.0)
    assert 295.0 < replaced.used < 320.0
    assert fast.gap_mm == first(1.0, rate_mm_s=replaced.used).gap_mm
    early = first(1.0, displacement_mm=0.1)
    assert (early.outside, early.gap_mm) == ((Outside("displacement_mm", 0.1, MOBILISED_MM),), first(1.0).gap_mm)
    assert first(1.0).outside == ()


def test_where_the_field_lags_and_the_force_relaxes_the_gap_makes_up_for_both(planned, moving) -> None:
    planner = build_core(CONFIG).planner()
    for force_N, begins_mm in ((1.6, 100), (0.9, 150), (1.3, 200)):
        for at_mm in range(begins_mm, begins_mm + 50):
            handle = Handle(MOBILISED_MM, 42.0, Turn(1.0, 0.0, at_mm), 42.0)
            there = moving(planner.planned.gap_mm, sensed_s=-1.0, handle_mm=float(at_mm), handle=handle)
            plan = planned(planner, force_N, there)
        assert plan.predicted_N == pytest.approx(force_N, abs=0.004)


class WrongSolver:
    def __init__(self, field_mT: float) -> None:
        self._field_mT = field_mT

    def solve(self, *_: object) -> FieldSolution:
        return FieldSolution(self._field_mT, 1.0, 1.0, 1, Reach.INSIDE)


@pytest.mark.parametrize("wrong_mT", [1.0, 780.0])
def test_the_force_law_stands_around_the_search(core, planned, first, moving, wrong_mT: float) -> None:
    misled = core._replace(element=core.element._replace(search=WrongSolver(wrong_mT)))
    wrong = planned(misled.planner(), 1.0, moving())
    assert wrong.field_mT == pytest.approx(first(1.0, moving()).field_mT, rel=LAW_SHARE + 0.01)
    assert wrong.outside == (Outside("field_mT", wrong_mT, wrong.field_mT),)
    assert Limit.MODEL_RANGE in wrong.limits


TURNING = {"is_homed": False, "handle": Handle(MOBILISED_MM / 2.0, 42.0, TURN, 42.0)}


def test_a_publishers_own_motion_is_used_until_the_handle_slides(first, moving) -> None:
    turning, sliding = moving(**TURNING), moving(is_homed=False)
    slow_mm = first(1.0, moving(is_homed=False, force_N=0.0, handle=Handle(MOBILISED_MM, 8.0, TURN, 8.0))).gap_mm
    assert first(1.0, rate_mm_s=8.0).gap_mm == slow_mm == first(1.0, turning, rate_mm_s=-8.0).gap_mm
    assert first(1.0, sliding, rate_mm_s=8.0).gap_mm == first(1.0, sliding).gap_mm != slow_mm


@pytest.mark.parametrize(("waited_s", "is_used"), [(0.09, True), (0.2, False)])
def test_a_stale_setpoints_motion_is_not_used_any_more(core, moving, waited_s: float, is_used: bool) -> None:
    gaps_mm = {
        core.planner().plan(waited_s, TimedSetpoint(1.0, PERIOD_S, 0.1, rate_mm_s=rate_mm_s), moving(**TURNING)).gap_mm
        for rate_mm_s in (8.0, None)
    }
    assert len(gaps_mm) == 1 + is_used


fits = st.builds(
    DeviceFit, st.floats(0.6, 2.0), st.floats(-0.2, 0.3), st.floats(0.0, 0.03), st.just(0.0), st.floats(0.0, 0.01)
)


@given(device=fits, unseen=st.none() | fits, asked_N=st.floats(0.0, 5.0))
def test_the_most_open_of_the_guards_wins_at_a_speed_that_there_is(
    core, device: DeviceFit, unseen: DeviceFit | None, asked_N: float
) -> None:
    belief = Belief(device, device, unseen, 0.0, None, (), 0.0)
    planner = core.planner()
    ask = Ask(asked_N, [asked_N, *[0.5] * 6], None, ())
    plan = planner.aim.update(0.1, None, ask, belief, planner.believe.memory, None)
    ceiling_N, scales = CEILING * core.scene.force.most_N, (CONFIG.trim.least, CONFIG.trim.most)
    for guard in (device, unseen):
        assert guard is None or plan.gap_mm >= core.portrait.gap_mm_at(guard.surely_within_N(ceiling_N, scales))
    assert plan.gap_mm >= plan.min_gap_mm
    assert -core.gap_speeds.closing_mm_s <= plan.gap_speed_mm_s <= CONFIG.position.gap_speed_mm_s


@given(
    least_N=st.floats(0.1, 1.0),
    gains_N=st.lists(st.floats(1e-9, 1.0), min_size=1, max_size=60),
    share=st.floats(-0.5, 1.5),
    place=st.integers(0),
)
def test_a_force_is_found_as_bisection_finds_it(least_N: float, gains_N: list[float], share: float, place: int) -> None:
    forces_N = list(accumulate(gains_N, initial=least_N))
    gaps_mm = np.linspace(40.0, 15.0, len(forces_N)).tolist()
    shown = Portrait(gaps_mm, forces_N, [*gains_N, 2.0 * gains_N[-1]])
    at_a_point = forces_N[place % len(forces_N)]
    for force_N in (
        shown.min_N + share * (shown.max_N - shown.min_N),
        at_a_point,
        math.nextafter(at_a_point, -math.inf),
        math.nextafter(at_a_point, math.inf),
        -1e300,
        1e300,
    ):
        next_to = min(bisect_right(forces_N, force_N), len(forces_N) - 1)
        gap_mm, slope_N_mm = shown.gap_and_slope_at(force_N)
        assert (slope_N_mm, gap_mm) == (shown.slope_N_mm[next_to], shown.gap_mm_at(force_N))
        assert math.isclose(gap_mm, np.interp(force_N, forces_N, shown.gap_mm), rel_tol=1e-12)
        assert math.isclose(shown.slope_at_N_mm(force_N), np.interp(force_N, forces_N, shown.slope_N_mm), rel_tol=1e-9)


def test_points_between_which_no_slope_is_are_refused_and_equal_ones_are_not() -> None:
    with pytest.raises(DomainError, match=r"^values = 5e-324 is not allowed: 0, or 1e-200 from there$"):
        Portrait([95.0, 70.0, 45.0], [0.0, 5e-324, 2.0], [0.1, 0.1, 0.1])
    flat = Portrait([95.0, 70.0, 45.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    assert (flat.gap_mm_at(0.9), flat.gap_mm_at(1.1)) == (95.0, 45.0)
