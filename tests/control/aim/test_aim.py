"""`plan`: from setpoint to gap with the shipped model, and a trim that learns the model's error only where it can."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.config import Config
from tormagd.assembly.build import Core
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Handle, Measured
from tormagd.control.records import TimedSetpoint
from tormagd.control.believe.carriage_lag import AGE_S, CarriageLag, MAX_LAG_S
from tormagd.control.aim.floors import LAW_SHARE
from tormagd.control.believe.believe import Learned, NOTHING_LEARNED
from tormagd.control.records import Outside, Plan
from tormagd.control.plan import PlanState
from tormagd.inverse.solution import FieldSolution, Reach
from tormagd.model.displacement import MOBILISED_MM, MOVING_MM_S, Turn
from tormagd.safety.codes import Limit

PERIOD_S = 0.004
CONFIG = Config()
TURN = Turn(1.0, 0.0, 100.0)


def moving(gap_mm: float = 78.1, force_N: float = 1.0871, **changes: object) -> Measured:
    """A homed device whose handle has long moved, which gives what the shipped model says. Its Sense never ages."""
    handle = Handle(MOBILISED_MM, 42.0, TURN, 42.0)
    estimate = Measured(1, True, 0.0, gap_mm / 2.0, gap_mm / 2.0, 0.0, 0.0, force_N, handle, 100.0, math.inf, 0.0)
    return estimate.replaced(**changes)


def planned(core: Core, force_N: float, estimate: Measured | None = None, state: PlanState | None = None) -> PlanState:
    """The state after a fresh setpoint."""
    state = state or core.planner.start(0.0)
    now_s = state.plan.time_s + PERIOD_S
    if estimate is not None:  # the device says something new
        estimate = estimate.replaced(number=state.shown.read + 1)
    return core.planner.plan(state, now_s, TimedSetpoint(force_N, now_s, 0.1), estimate)


def test_starts_with_the_gap_open(core) -> None:
    plan = core.planner.start(3.0).plan
    assert (plan.gap_mm, plan.gap_speed_mm_s, plan.time_s) == (95.0, 0.0, 3.0)
    assert plan.governed_N == core.planner.portrait.least_N
    assert plan.limits == (Limit.NO_SETPOINT,)


RESTING = moving(handle=Handle(MOBILISED_MM, 0.0, TURN, 42.0))


@pytest.mark.parametrize("estimate", [None, RESTING], ids=["no device", "at rest"])
def test_without_a_setpoint_the_gap_stays_open(core, estimate: Measured | None) -> None:
    state = core.planner.start(0.0)
    for tick in range(1, 20):
        state = core.planner.plan(state, tick * PERIOD_S, None, estimate)
    assert state.plan.gap_mm == pytest.approx(95.0, abs=1.0)
    assert state.plan.setpoint_N is None
    assert state.plan.number == 19


@pytest.mark.parametrize("rate_mm_s", [0.0, 1.0, 4.9])
@pytest.mark.parametrize("force_N", [0.6, 1.0, 1.8])
def test_a_handle_that_rests_does_not_close_the_gap(core, rate_mm_s: float, force_N: float) -> None:
    """At rest the force is the hand's choice: the gap waits where it is right once the handle moves on."""
    resting = moving(handle=Handle(MOBILISED_MM, rate_mm_s, TURN, 42.0))
    gap = planned(core, force_N, moving()).plan.gap_mm
    assert planned(core, force_N, resting).plan.gap_mm == pytest.approx(gap, abs=0.1)
    # nothing is known of a handle that was never seen: it is planned for as one that moves slowly
    assert planned(core, force_N, None).plan.gap_mm == pytest.approx(gap, abs=1.5)


def test_a_creeping_handle_is_planned_for_with_its_static_friction(core) -> None:
    creeping = moving(handle=Handle(MOBILISED_MM, 0.5, TURN, 0.5))
    assert planned(core, 1.5, creeping).plan.gap_mm > planned(core, 1.5, moving()).plan.gap_mm + 2.0


def test_the_portrait_rises_and_agrees_with_its_slope(core) -> None:
    portrait = core.planner.portrait
    assert np.all(np.diff(portrait.force_N) > 0.0)
    assert 0.6 < portrait.least_N < 0.7
    assert portrait.most_N > 2.0
    assert min(portrait.slope_N_mm) >= 0.0
    # the slope is dF/dgap: integrated over the range it gives the force range back
    step_mm = 50.0 / (len(portrait.force_N) - 1)
    swept_N = float(np.trapezoid(portrait.slope_N_mm, dx=step_mm))
    assert swept_N == pytest.approx(portrait.most_N - portrait.least_N, rel=0.01)
    assert portrait.force_rate_N_s(1.5, 38.0) == pytest.approx(38.0 * portrait.slope_at_N_mm(1.5))


def test_more_force_takes_a_smaller_gap(core) -> None:
    gaps = [planned(core, force).plan.gap_mm for force in np.arange(0.7, 1.81, 0.1)]
    assert all(closer < further for further, closer in pairwise(gaps))
    assert 45.0 <= gaps[-1] < gaps[0] <= 95.0


@pytest.mark.parametrize("force_N", [0.7, 1.0, 1.5, 1.8])
def test_the_planned_gap_gives_the_force_by_the_portrait(core, force_N: float) -> None:
    plan = planned(core, force_N, moving()).plan
    portrait = core.planner.portrait
    assert np.interp(plan.gap_mm, portrait.gap_mm[::-1], portrait.force_N[::-1]) == pytest.approx(force_N, abs=0.03)
    assert plan.governed_N == pytest.approx(force_N)
    assert plan.confidence > 0.5


@pytest.mark.parametrize(("force_N", "limit"), [(0.05, Limit.F_MIN), (2.5, Limit.RANGE)])
def test_what_cannot_be_given_is_said_once(core, force_N: float, limit: Limit) -> None:
    limits = planned(core, force_N, moving()).plan.limits
    assert limits.count(limit) == 1
    assert len(set(limits)) == len(limits)


def test_a_device_that_gives_more_than_was_asked_at_its_open_gap_is_said(core) -> None:
    """Where the element gives 1.6 times the model's force, 0.7 N are less than the open gap gives."""
    state = core.planner.start(0.0).replaced(shown=Learned(DeviceFit(scale=1.6)))
    plan = planned(core, 0.7, None, state).plan
    assert Limit.F_MIN in plan.limits
    assert plan.gap_mm == pytest.approx(95.0, abs=0.1)
    assert Limit.F_MIN not in planned(core, 0.7).plan.limits


def test_the_gap_moves_ahead_along_the_setpoints_slope(core) -> None:
    state = core.planner.start(0.0)
    for _ in range(40):
        state = planned(core, 1.0 + 0.5 * state.plan.time_s, moving(), state)
    slope = core.planner.portrait.slope_at_N_mm(state.plan.governed_N)
    assert state.plan.gap_speed_mm_s == pytest.approx(-0.5 / slope, rel=0.1)


@settings(max_examples=30, deadline=None)
@given(forces=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=10))
def test_the_gap_speed_is_one_the_carriages_have(core, forces: list[float]) -> None:
    state = core.planner.start(0.0)
    for force in forces:
        state = planned(core, force, moving(), state)
        assert abs(state.plan.gap_speed_mm_s) <= CONFIG.position.gap_speed_mm_s
        assert 45.0 <= state.plan.gap_mm <= 95.0


def test_a_preview_gives_the_gaps_speed_and_acceleration(core) -> None:
    """Where the force turns round, the speed is none and only the acceleration tells what comes."""

    def force_N(time_s: float) -> float:
        return 1.5 + 0.1 * math.cos(2.0 * math.pi * 3.0 * (time_s - 0.2))

    state = core.planner.start(0.0)
    state = state.replaced(governor=state.governor.replaced(asked_N=force_N(0.0)))
    for tick in range(1, 101):
        now_s = 2e-3 * tick
        ahead_N = tuple(force_N(now_s + 2e-3 * step) for step in range(1, 40))
        setpoint = TimedSetpoint(force_N(now_s), now_s, 0.1, preview_N=ahead_N, preview_dt_s=2e-3)
        state = core.planner.plan(state, now_s, setpoint, None)
    plan = state.plan
    curve_N_s2 = -0.1 * (2.0 * math.pi * 3.0) ** 2
    # within 4 ms of the turn: the way is planned in steps of 10
    assert plan.gap_speed_mm_s == pytest.approx(0.0, abs=2.5)
    assert plan.gap_acceleration_mm_s2 == pytest.approx(-curve_N_s2 / core.planner.portrait.slope_at_N_mm(1.6), rel=0.2)
    assert planned(core, 1.6, moving()).plan.gap_acceleration_mm_s2 == pytest.approx(0.0, abs=1e-6)


def swung(core: Core, late_s: float, *, is_known: bool, seconds: float = 10.0) -> PlanState:
    """The state after a swing that the gap follows that much too late."""
    portrait = core.planner.portrait
    # late carriages are only sent along swings that they can follow
    swings_Hz = 1.0 if is_known else 2.0

    def force_N(time_s: float) -> float:
        return 1.5 + 0.1 * math.sin(2.0 * math.pi * swings_Hz * time_s)

    def gap_mm(time_s: float) -> float:
        return portrait.gap_mm_at(force_N(time_s))

    state = core.planner.start(0.0)
    for tick in range(1, round(seconds / PERIOD_S)):
        now_s = tick * PERIOD_S
        # it starts as much sooner as has been learned, and is measured before the plan
        come_s = now_s - AGE_S - late_s + state.shown.lateness.lag_s
        side_mm_s = (gap_mm(come_s) - gap_mm(come_s - 1e-3)) / 2e-3
        # the handle rests: the trim learns nothing
        estimate = moving(gap_mm(come_s), left_mm_s=side_mm_s, right_mm_s=side_mm_s, handle=RESTING.handle)
        ahead = tuple(force_N(now_s + 2e-3 * k) for k in range(1, 40)) if is_known else ()
        setpoint = TimedSetpoint(force_N(now_s), now_s, 0.1, preview_N=ahead, preview_dt_s=2e-3)
        state = core.planner.foresee(core.planner.plan(state, now_s, setpoint, estimate))
    return state


@pytest.mark.parametrize(("late_s", "learned_s"), [(0.015, 0.017), (0.0, 0.002), (-0.01, 0.0), (0.06, MAX_LAG_S)])
def test_a_lag_is_learned_where_what_comes_is_known(core, late_s: float, learned_s: float) -> None:
    """And half a plan's period besides: by so much the governor's gap goes before what is previewed."""
    assert swung(core, late_s, is_known=True).shown.lateness.lag_s == pytest.approx(learned_s, abs=1e-3)


def test_a_gap_on_its_way_after_a_jump_is_not_late(core) -> None:
    state = core.planner.start(0.0)
    state = state.replaced(governor=state.governor.replaced(asked_N=1.5))
    for tick in range(1, 500):
        now_s = tick * PERIOD_S
        setpoint = TimedSetpoint(1.5, now_s, 0.1, preview_N=(1.5,) * 40, preview_dt_s=2e-3)
        travelling = moving(85.0, left_mm_s=-15.0, right_mm_s=-15.0, handle=RESTING.handle)
        state = core.planner.plan(state, now_s, setpoint, travelling)
    assert state.shown.lateness.lag_s == 0.0


def test_without_a_preview_a_lag_is_learned_once_the_swing_is_foreseen(core) -> None:
    early = swung(core, 0.015, is_known=False, seconds=1.0)
    assert (early.plan.foresight, early.shown.lateness.lag_s) == (0.0, 0.0)
    late = swung(core, 0.015, is_known=False, seconds=20.0)
    assert late.plan.foresight > 0.9
    assert late.shown.lateness.lag_s == pytest.approx(0.015, abs=2e-3)


def learned(core: Core, seconds: float, estimate: Measured, shown: Learned = NOTHING_LEARNED) -> PlanState:
    """The state after the same estimate for a while, but for the noise that a live sensor has."""
    state = core.planner.start(0.0).replaced(shown=shown)
    for number in range(round(seconds / PERIOD_S)):
        noise_N = 0.003 * (-1) ** number
        state = planned(core, 1.0, estimate.replaced(force_N=estimate.force_N + noise_N), state)
    return state


@pytest.mark.parametrize(
    ("estimate", "is_doubted"),
    [(RESTING, False), (moving(), False), (moving(force_N=20.0), True)],
    ids=["at rest", "sliding", "a sensor that is not believed"],
)
def test_what_is_known_of_the_lag_outlasts_what_the_sensor_teaches(core, estimate: Measured, is_doubted: bool) -> None:
    shown = learned(core, 1.2, estimate, Learned(lateness=CarriageLag(0.02))).shown
    assert shown.sensor.is_doubted == is_doubted
    assert (shown.read, shown.lateness.lag_s) == (299, 0.02)


def test_the_device_is_learned_from_measured_over_predicted_force(core) -> None:
    state = learned(core, 8.0, moving(force_N=1.2 * 1.08))
    assert state.plan.predicted_N == pytest.approx(1.2 * 1.08, rel=0.01)
    assert state.trim == pytest.approx(1.2, rel=0.02)
    assert Limit.TRIM not in state.plan.limits
    # a model that is too low in force is corrected by a wider gap
    assert state.plan.gap_mm > learned(core, 8.0, moving()).plan.gap_mm + 3.0


@pytest.mark.parametrize(
    "estimate",
    [
        None,
        moving(force_N=1.4, is_homed=False),
        moving(force_N=1.4, handle=Handle(MOBILISED_MM - 0.01, 42.0, TURN)),
        moving(force_N=1.4, handle=Handle(MOBILISED_MM, MOVING_MM_S - 0.01, TURN)),
        moving(force_N=1.4, handle=Handle(MOBILISED_MM, 0.0, TURN)),
    ],
    ids=["no measurement", "not homed", "not mobilised", "too slow", "at rest"],
)
def test_what_teaches_nothing_leaves_the_device_as_it_is(core, estimate: Measured | None) -> None:
    known = DeviceFit(scale=1.1, scale_variance=1e-4)
    state = core.planner.start(0.0).replaced(shown=Learned(known))
    for _ in range(20):
        state = planned(core, 1.0, estimate, state)
    assert state.device == known


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_handle_that_has_stopped_teaches_nothing_of_a_gap_that_goes_on(core, goes_on: bool) -> None:
    """Its rate is filtered, and known for slower only later."""
    state, devices = learned(core, 2.0, moving(sensed_s=0.0)), []
    for number in range(20):
        now_s = state.plan.time_s + PERIOD_S
        at_mm, gap_mm = 100.0 + 5.0 * PERIOD_S * number * goes_on, 78.1 - 0.3 * number
        slower = Handle(MOBILISED_MM, 5.0, Turn(1.0, 0.0, at_mm), 42.0)
        estimate = moving(gap_mm, sensed_s=now_s, handle_mm=at_mm, handle=slower)
        state = planned(core, 1.0, estimate, state)
        devices.append(state.device)
    assert (devices[10] == devices[-1]) is not goes_on


def test_one_reading_teaches_once(core) -> None:
    state = planned(core, 1.0, moving(force_N=1.4))
    again = core.planner.plan(state, state.plan.time_s + PERIOD_S, None, moving(force_N=1.4, number=state.shown.read))
    assert again.device == state.device


def test_what_a_force_says_before_break_away_is_not_predicted(core) -> None:
    before = moving(handle=Handle(MOBILISED_MM - 0.01, 42.0, TURN))
    assert planned(core, 1.0, before).plan.predicted_N is None


def test_the_model_is_never_asked_outside_what_it_was_shown(core) -> None:
    """A setpoint may be meant for any motion; the model answers for the nearest that it knows, and the plan says so."""
    fast = planned_for(core, rate_mm_s=1_000.0)
    assert Limit.MODEL_RANGE in fast.limits
    (replaced,) = fast.outside
    assert (replaced.quantity, replaced.asked) == ("rate_mm_s", 1_000.0)
    assert 295.0 < replaced.used < 320.0
    assert fast.gap_mm == planned_for(core, rate_mm_s=replaced.used).gap_mm
    early = planned_for(core, displacement_mm=0.1)
    assert early.outside == (Outside("displacement_mm", 0.1, MOBILISED_MM),)
    assert early.gap_mm == planned_for(core).gap_mm
    assert planned_for(core).outside == ()


def planned_for(core: Core, **motion: float) -> Plan:
    """1 N that is meant for a motion of the handle."""
    setpoint = TimedSetpoint(1.0, PERIOD_S, 0.1, **motion)
    return core.planner.plan(core.planner.start(0.0), PERIOD_S, setpoint, None).plan


class WrongSolver:
    """A search that answers with one field, whatever is asked."""

    def __init__(self, field_mT: float) -> None:
        self._field_mT = field_mT

    def solve(self, *_: object) -> FieldSolution:
        return FieldSolution(self._field_mT, 1.0, 1.0, 1, Reach.INSIDE)


@pytest.mark.parametrize("wrong_mT", [1.0, 780.0])
def test_the_force_law_stands_around_the_search(make_core: Callable[[], Core], wrong_mT: float) -> None:
    core = make_core()
    right = planned(core, 1.0, moving()).plan
    core.planner._search = WrongSolver(wrong_mT)
    wrong = planned(core, 1.0, moving()).plan
    assert wrong.field_mT == pytest.approx(right.field_mT, rel=LAW_SHARE + 0.01)
    (replaced,) = wrong.outside
    assert replaced == Outside("field_mT", wrong_mT, wrong.field_mT)
    assert Limit.MODEL_RANGE in wrong.limits


def test_a_device_that_has_shown_nothing_is_taken_for_a_strong_one(core) -> None:
    """The gap stays where the strongest believable device would keep to the ceiling; turning the handle shows which it
    is, and the ceiling moves."""
    new = planned(core, 2.0, RESTING).plan
    assert Limit.CEILING in new.limits
    assert new.gap_mm == new.least_gap_mm
    known = planned(core, 2.0, RESTING, learned(core, 2.0, moving())).plan
    assert Limit.CEILING not in known.limits
    assert known.gap_mm < new.gap_mm - 0.5


def test_positions_before_homing_predict_nothing(core) -> None:
    assert planned(core, 1.0, moving(is_homed=False)).plan.predicted_N is None
    assert planned(core, 1.0, moving()).plan.predicted_N is not None


TURNING = moving(is_homed=False, handle=Handle(MOBILISED_MM / 2.0, 42.0, TURN, 42.0))


def gap_mm(core: Core, estimate: Measured | None, rate_mm_s: float | None, now_s: float = PERIOD_S) -> float:
    """The plan's, where the setpoint states this rate."""
    setpoint = TimedSetpoint(1.0, PERIOD_S, 0.1, rate_mm_s=rate_mm_s)
    return core.planner.plan(core.planner.start(0.0), now_s, setpoint, estimate).plan.gap_mm


def test_a_publishers_own_motion_is_used_until_the_handle_slides(core) -> None:
    slow = moving(force_N=0.0, is_homed=False, handle=Handle(MOBILISED_MM, 8.0, TURN, 8.0))
    assert gap_mm(core, None, 8.0) == gap_mm(core, slow, None) == gap_mm(core, TURNING, -8.0)
    sliding = moving(is_homed=False)
    assert gap_mm(core, sliding, 8.0) == gap_mm(core, sliding, None) != gap_mm(core, slow, None)


def test_a_stale_setpoints_motion_is_not_used_any_more(core) -> None:
    assert gap_mm(core, TURNING, 8.0, now_s=0.09) != gap_mm(core, TURNING, None, now_s=0.09)
    assert gap_mm(core, TURNING, 8.0, now_s=0.2) == gap_mm(core, TURNING, None, now_s=0.2)


estimates = st.none() | st.builds(
    moving,
    gap_mm=st.floats(-200.0, 400.0),
    force_N=st.floats(-33.0, 33.0),
    is_homed=st.booleans(),
    handle=st.builds(
        Handle,
        displacement_mm=st.floats(0.0, MOBILISED_MM),
        rate_mm_s=st.floats(-2_000.0, 2_000.0),
        turn=st.sampled_from([Turn(-1.0, 0.0, 0.0), Turn(1.0, 0.0, 0.0)]),
        sliding_mm_s=st.floats(0.0, 2_000.0),
    ),
)
setpoints = st.none() | st.builds(
    TimedSetpoint,
    force_N=st.floats(0.0, 1_000.0),
    stamp_s=st.floats(-10.0, 100.0),
    valid_for_s=st.floats(1e-6, 60.0),
    displacement_mm=st.none() | st.floats(-1e9, 1e9),
    rate_mm_s=st.none() | st.floats(-1e9, 1e9),
    preview_N=st.lists(st.floats(0.0, 1_000.0), max_size=10).map(tuple),
    preview_dt_s=st.floats(1e-9, 1.0),
)


@settings(max_examples=80, deadline=None)
@given(history=st.lists(st.tuples(st.floats(0.0, 20.0), setpoints, estimates), min_size=1, max_size=8))
def test_nan_never_travels(core, history: list[tuple[float, TimedSetpoint | None, Measured | None]]) -> None:
    state, now_s = core.planner.start(0.0), 0.0
    for elapsed_s, setpoint, estimate in history:
        now_s += elapsed_s
        heard = None if estimate is None else estimate.replaced(number=state.shown.read + 1)
        last, state = state, core.planner.plan(state, now_s, setpoint, heard)
        plan = state.plan
        numbers = (plan.governed_N, plan.field_mT, plan.gap_mm, plan.gap_speed_mm_s, plan.confidence, state.trim)
        lag_s = state.shown.lateness.lag_s
        assert all(math.isfinite(value) for value in (*numbers, plan.gap_acceleration_mm_s2, lag_s))
        assert plan.predicted_N is None or math.isfinite(plan.predicted_N)
        assert 45.0 <= plan.gap_mm <= 95.0
        assert CONFIG.trim.least <= state.device.scale <= CONFIG.trim.most
        assert all(math.isfinite(getattr(state.device, name)) for name in DeviceFit.__match_args__)
        assert plan.governed_N <= max(core.scene.force.most_N, state.device.force_N(core.planner.portrait.least_N))
        assert plan.gap_mm >= plan.least_gap_mm
        assert 0.0 <= lag_s <= MAX_LAG_S
        assert plan.number == last.plan.number + 1


def test_a_replay_gives_the_same_state(core) -> None:
    first, again = (swung(core, 0.015, is_known=False, seconds=3.0) for _ in range(2))
    assert first.plan.foresight > 0.0
    assert first == again


def test_the_same_inputs_give_the_same_plan(core) -> None:
    state = learned(core, 0.1, moving())
    assert planned(core, 1.3, moving(), state) == planned(core, 1.3, moving(), state)
