"""The governor: every difference between force asked and force rendered has a reason, and none of them jumps."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.control.device_fit import DeviceFit
from tormagd.control.governor import (
    AHEAD_S,
    LEAST_WAY,
    PATH_S,
    WAY_S,
    Governed,
    Governor,
    GovernorState,
    TimedSetpoint,
    _previewed_N,
)
from tormagd.control.periodicity import NOTHING_LEARNED
from tormagd.control.portrait import Portrait
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import Force, Terms

PORTRAIT = Portrait(
    np.linspace(95.0, 45.0, 19).tolist(), np.linspace(0.4, 2.2, 19).tolist(), np.linspace(0.01, 0.1, 19).tolist()
)
SCENE = Force(least_N=0.0, most_N=2.0, resolution_N=0.1, tolerance_rms_N=0.05)
GAP_SPEED_MM_S = 38.0
AFTER_S = np.array(PATH_S)
VALID_S = 0.1


GOVERNOR = Governor(PORTRAIT, SCENE, GAP_SPEED_MM_S)


def decide(
    state: GovernorState,
    now_s: float,
    setpoint: TimedSetpoint | None,
    *,
    scene: Force = SCENE,
    lag_s: float = 0.0,
    portrait: Portrait = PORTRAIT,
) -> tuple[GovernorState, Governed]:
    """One decision on the device of these tests."""
    governor = Governor(portrait, scene, GAP_SPEED_MM_S)
    return governor.govern(state, now_s, setpoint, DeviceFit(), lag_s)


def path_N(governed: Governed) -> npt.NDArray[np.float64]:
    """The force to come."""
    return np.array(governed.path_N)


def stream_of(forces: list[float], period_s: float = 0.01, **keywords: Any) -> tuple[GovernorState, Governed]:
    """The last decision on setpoints that came one per period."""
    state = GovernorState(0.0, 0.4)
    for number, force in enumerate(forces, 1):
        now_s = number * period_s
        state, governed = decide(state, now_s, TimedSetpoint(force, now_s, VALID_S), **keywords)
    return state, governed


@pytest.mark.parametrize(
    ("asked", "scene_range", "rendered", "limits"),
    [
        (1.0, (0.0, 2.0), 1.0, ()),
        (0.4, (0.0, 2.0), 0.4, ()),
        (2.0, (0.0, 2.0), 2.0, ()),
        (0.1, (0.0, 2.0), 0.4, (Limit.F_MIN,)),
        (0.1, (0.5, 2.0), 0.5, (Limit.RANGE,)),
        (2.5, (0.0, 2.0), 2.0, (Limit.RANGE,)),
        (2.5, (0.0, 3.0), 2.2, (Limit.F_MAX,)),
        (3.5, (0.0, 3.0), 2.2, (Limit.RANGE, Limit.F_MAX)),
        (0.1, (0.2, 3.0), 0.4, (Limit.RANGE, Limit.F_MIN)),
    ],
)
def test_range_and_reach(
    asked: float, scene_range: tuple[float, float], rendered: float, limits: tuple[Limit, ...]
) -> None:
    scene = Force(least_N=scene_range[0], most_N=scene_range[1], resolution_N=0.1, tolerance_rms_N=0.05)
    _, governed = decide(GovernorState(0.0, 0.4), 1.0, TimedSetpoint(asked, 1.0, VALID_S), scene=scene)
    assert governed.force_N == pytest.approx(rendered)
    assert governed.limits == limits


def test_without_a_setpoint_the_least_force_is_rendered() -> None:
    _, governed = decide(GovernorState(0.0, 0.4), 1.0, None)
    assert (governed.force_N, governed.age_s, governed.limits) == (0.4, None, (Limit.NO_SETPOINT,))
    assert np.all(path_N(governed) == 0.4)


def test_a_stale_setpoint_decays_along_the_ramp_and_not_below_the_least() -> None:
    setpoint = TimedSetpoint(1.6, 1.0, VALID_S)
    state, _ = decide(GovernorState(0.99, 1.6), 1.0, setpoint)
    state, valid = decide(state, 1.1 - 1e-9, setpoint)
    assert valid.limits == ()
    last_N = 1.6
    for tick in range(1, 1_000):
        now_s = 1.1 + tick * 1e-3
        state, governed = decide(state, now_s, setpoint)
        assert governed.limits == (Limit.STALE,)
        assert governed.age_s == pytest.approx(now_s - 1.0)
        assert np.all(path_N(governed) == governed.force_N)
        assert last_N - governed.force_N <= SCENE.release_N_s * 1e-3 + 1e-8
        assert governed.force_N == pytest.approx(max(0.4, 1.6 - SCENE.release_N_s * tick * 1e-3))
        last_N = governed.force_N
    assert last_N == 0.4


def test_a_setpoint_that_goes_stale_on_a_slope_is_let_go_from_where_the_force_is() -> None:
    """It was carried on along its slope; the ramp begins there, not at the setpoint."""
    state, governed = stream_of([1.0 + 0.02 * number for number in range(20)])
    for tick in range(1, 400):
        last_N = governed.path_N[0]
        state, governed = decide(state, 0.2 + tick * 1e-3, TimedSetpoint(1.38, 0.2, VALID_S))
        assert last_N - governed.path_N[0] <= SCENE.release_N_s * 1e-3 + 1e-8
    assert governed.path_N[0] < 1.0


@pytest.mark.parametrize("ahead_N", [(), (1.0,) * 40])
@pytest.mark.parametrize(("before_N", "after_N"), [(1.6, 0.8), (0.8, 1.6)])
def test_from_one_holder_to_the_next_the_force_goes_along_the_ramp(
    before_N: float, after_N: float, ahead_N: tuple[float, ...]
) -> None:
    state, governed = decide(GovernorState(0.0, before_N), 0.001, TimedSetpoint(before_N, 0.001, VALID_S))
    reached = 0
    for tick in range(2, 1_000):
        now_s, last_N = tick * 1e-3, governed.force_N
        preview_N = tuple(after_N * share for share in ahead_N)
        setpoint = TimedSetpoint(
            after_N, now_s, VALID_S, preview_N=preview_N, preview_dt_s=0.002, holder=1, is_contested=True
        )
        state, governed = decide(state, now_s, setpoint)
        assert abs(governed.force_N - last_N) <= SCENE.release_N_s * 1e-3 + 1e-9
        assert Limit.OTHER_SOURCE in governed.limits
        is_there = abs(governed.force_N - after_N) <= 1e-12
        assert (Limit.TAKEOVER in governed.limits) != is_there
        reached = reached or tick * is_there
    assert reached == pytest.approx(0.8 / SCENE.release_N_s * 1e3, abs=5)
    # and it is followed as any other from then on
    state, governed = decide(state, 1.001, TimedSetpoint(1.2, 1.001, VALID_S, holder=1))
    assert (governed.force_N, governed.limits) == (1.2, ())


def test_a_takeover_after_a_silence_begins_from_the_decayed_force() -> None:
    state, _ = decide(GovernorState(0.0, 1.6), 0.001, TimedSetpoint(1.6, 0.001, VALID_S))
    for tick in range(2, 301):
        state, governed = decide(state, tick * 1e-3, TimedSetpoint(1.6, 0.001, VALID_S))
    decayed_N = governed.force_N
    state, governed = decide(state, 0.301, TimedSetpoint(1.6, 0.301, VALID_S, holder=1))
    assert governed.force_N == pytest.approx(decayed_N + SCENE.release_N_s * 1e-3)


def test_another_holders_forces_teach_no_slope_and_no_period() -> None:
    state, _ = stream_of([1.0, 1.1, 1.2])
    assert state.slope_N_s != 0.0
    state, _ = decide(state, 0.04, TimedSetpoint(1.0, 0.04, VALID_S, holder=1))
    assert state.slope_N_s == 0.0


@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.sampled_from([0.0, 0.02, 0.2, 2.0]), st.floats(1e-4, 0.01)),
        min_size=1,
        max_size=100,
    )
)
def test_no_loss_of_force_that_was_not_asked_for_is_faster_than_the_ramp(
    events: list[tuple[int, float, float]],
) -> None:
    """Each holder asks for a constant force; publishers fall silent, come late, and take over from each other."""
    state, now_s = GovernorState(0.0, 2.0), 0.0
    for holder, age_s, elapsed_s in events:
        now_s += elapsed_s
        before_N = state.asked_N
        state, governed = decide(state, now_s, TimedSetpoint(0.5 + 0.5 * holder, now_s - age_s, VALID_S, holder=holder))
        # a first publisher takes over from nobody, and one that comes back says itself what it wants
        if state.is_passing or Limit.STALE in governed.limits:
            assert before_N - state.asked_N <= SCENE.release_N_s * elapsed_s + 1e-9
        assert state.asked_N == governed.path_N[0]


def test_a_publisher_that_comes_back_is_followed_again_without_a_slope_from_before() -> None:
    state, _ = stream_of([1.0, 1.1, 1.2])
    state, _ = decide(state, 0.5, TimedSetpoint(1.2, 0.03, VALID_S))
    _, governed = decide(state, 0.6, TimedSetpoint(1.5, 0.6, VALID_S))
    assert governed.limits == ()
    assert governed.force_N == 1.5
    assert np.all(path_N(governed) == 1.5)


def test_a_slope_is_learned_and_carried_ahead() -> None:
    state, governed = stream_of([1.0 + 0.01 * k for k in range(40)], period_s=0.01)
    assert state.slope_N_s == pytest.approx(1.0, rel=1e-3)
    assert path_N(governed) == pytest.approx(1.39 + AFTER_S, abs=1e-3)
    last = TimedSetpoint(1.39, 0.4, VALID_S)
    for waited_s, ahead_N in ((0.0, 1.39), (0.01, 1.40), (AHEAD_S, 1.44), (0.09, 1.44)):
        _, later = decide(state, 0.4 + waited_s, last)
        assert path_N(later)[0] == pytest.approx(ahead_N, abs=1e-3)
        assert later.force_N == pytest.approx(1.39)


@settings(max_examples=100, deadline=None)
@given(
    forces=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=40),
    period_s=st.floats(1e-6, 0.2),
    lag_s=st.floats(0.0, 0.05),
)
def test_the_slope_is_one_that_the_gap_speed_can_render(forces: list[float], period_s: float, lag_s: float) -> None:
    state, governed = stream_of(forces, period_s, lag_s=lag_s)
    steepest = GAP_SPEED_MM_S * max(PORTRAIT.slope_N_mm)
    assert abs(state.slope_N_s) <= steepest + 1e-9
    assert np.all((path_N(governed) >= PORTRAIT.least_N) & (path_N(governed) <= SCENE.most_N))
    assert PORTRAIT.least_N <= governed.force_N <= SCENE.most_N


def test_a_jump_at_a_flat_force_gives_the_slope_renderable_there() -> None:
    flat = Portrait([95.0, 70.0, 45.0], [0.4, 1.0, 2.2], [0.001, 0.001, 0.1])
    state, _ = stream_of([1.0, 0.4, 1.0, 0.4, 0.5], period_s=0.01, portrait=flat)
    assert abs(state.slope_N_s) <= GAP_SPEED_MM_S * 0.001 + 1e-12


def test_setpoints_with_equal_stamps_have_no_slope_between_them() -> None:
    before, _ = stream_of([1.0, 1.02, 1.04])
    state, governed = decide(before, 0.031, TimedSetpoint(1.5, 0.03, VALID_S))
    assert governed.force_N == 1.5
    assert state.slope_N_s == before.slope_N_s


def test_a_stamp_ahead_of_the_clock_is_of_no_age() -> None:
    state, _ = stream_of([1.0 + 0.01 * k for k in range(40)])
    _, governed = decide(state, 0.41, TimedSetpoint(1.4, 0.45, VALID_S))
    assert governed.age_s == pytest.approx(-0.04)
    assert path_N(governed)[0] == pytest.approx(1.4)
    assert governed.limits == ()


def test_a_clock_that_stands_still_or_goes_back_lets_nothing_jump() -> None:
    for now_s in (1.0, 0.5, -10.0):
        _, governed = decide(GovernorState(1.0, 1.5), now_s, None)
        assert governed.force_N == 1.5


def told(
    force_N: Callable[[float], float], seconds: float, *, ahead_s: float = 0.4, lag_s: float = 0.0
) -> tuple[GovernorState, Governed]:
    """The last decision on setpoints that carry what follows, 500 times a second from 0 s on."""
    state, governed = decide(GovernorState(0.0, force_N(0.0)), 0.0, None)
    state = state.replaced(asked_N=force_N(0.0))
    for tick in range(1, round(500 * seconds) + 1):
        now_s = tick / 500
        ahead_N = tuple(force_N(now_s + 0.002 * place) for place in range(1, round(500 * ahead_s) + 1))
        setpoint = TimedSetpoint(force_N(now_s), now_s, VALID_S, preview_N=ahead_N, preview_dt_s=0.002)
        state, governed = decide(state, now_s, setpoint, lag_s=lag_s)
    return state, governed


def swing_N(time_s: float) -> float:
    """As slow as the gap of these tests can follow."""
    return 1.5 + 0.05 * math.sin(2.0 * math.pi * 2.0 * time_s)


@pytest.mark.parametrize("seconds", [0.3, 0.5, 0.82])
@pytest.mark.parametrize("ahead_s", [0.07, 0.4])
def test_a_preview_is_what_comes(seconds: float, ahead_s: float) -> None:
    """A swing that no slope foresees; the path goes along it."""
    _, governed = told(swing_N, seconds, ahead_s=ahead_s)
    assert path_N(governed) == pytest.approx([swing_N(seconds + after_s) for after_s in PATH_S], abs=2e-3)
    assert governed.force_N == governed.path_N[0]
    assert (governed.limits, governed.foresight) == ((), 1.0)


def step_N(time_s: float) -> float:
    """Too fast for any gap."""
    return 1.2 if time_s < 1.0 else 1.8


def test_what_is_too_fast_is_missed_before_and_after() -> None:
    """The carriages set out before a step that they know of, and the limit says that they are too slow for it."""
    _, long_before = told(step_N, 0.6)
    assert path_N(long_before) == pytest.approx(1.2)
    _, there = told(step_N, 1.0)
    assert 1.4 < there.force_N < 1.6
    assert there.limits == (Limit.RATE,)
    _, long_after = told(step_N, 1.4)
    assert path_N(long_after) == pytest.approx(1.8, abs=2e-3)
    assert long_after.limits == ()
    # of what is not known nobody can be ahead
    _, surprised = told(step_N, 0.88, ahead_s=0.05)
    assert surprised.force_N == pytest.approx(1.2)


def test_late_carriages_set_out_sooner() -> None:
    _, prompt = told(step_N, 0.75)
    _, late = told(step_N, 0.75, lag_s=0.03)
    assert late.force_N > prompt.force_N + 1e-3


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=60), st.floats(1e-4, 1.0), st.floats(0.0, 0.03))
def test_no_path_is_faster_than_the_gap_or_beyond_what_was_asked(
    ahead_N: list[float], spacing_s: float, lag_s: float
) -> None:
    """However the preview leaps, and whatever it says: the path goes on from where the last one was."""
    state, steepest_N_s = GovernorState(0.0, 1.0), GAP_SPEED_MM_S * max(PORTRAIT.slope_N_mm)
    for tick in range(1, 6):
        before_N, now_s = state.asked_N, 0.004 * tick
        leap = tuple(ahead_N[tick:] + ahead_N[:tick])
        setpoint = TimedSetpoint(leap[0], now_s, VALID_S, preview_N=leap, preview_dt_s=spacing_s)
        state, governed = decide(state, now_s, setpoint, lag_s=lag_s)
        assert abs(governed.path_N[0] - before_N) <= steepest_N_s * 0.004 + 1e-9
        assert np.all(np.abs(np.diff(path_N(governed))) <= steepest_N_s * 0.005 + 1e-9)
        assert np.all((path_N(governed) >= PORTRAIT.least_N) & (path_N(governed) <= SCENE.most_N))


def test_a_preview_beyond_the_range_is_held_at_its_ends() -> None:
    _, above = told(lambda time_s: 3.0, 1.5)
    assert path_N(above) == pytest.approx(SCENE.most_N)
    _, below = told(lambda time_s: 0.0, 1.5)
    assert path_N(below) == pytest.approx(PORTRAIT.least_N)


def test_a_short_preview_goes_on_as_it_ran_and_not_for_long() -> None:
    rising = TimedSetpoint(1.0, 0.5, 10.0, preview_N=(1.005, 1.01), preview_dt_s=5e-3)
    state, soon = decide(GovernorState(0.499, 1.0), 0.5, rising)
    assert np.all(np.diff(path_N(soon)) > 0.0)
    # no further than it was known
    assert path_N(soon)[-1] < 1.02
    for tick in range(1, 100):
        state, late = decide(state, 0.5 + 0.01 * tick, rising)
    assert path_N(late) == pytest.approx(np.full(len(PATH_S), 1.02))


def test_a_preview_does_not_outlive_its_validity() -> None:
    setpoint = TimedSetpoint(1.5, 0.5, VALID_S, preview_N=(1.5,) * 200, preview_dt_s=2e-3)
    _, governed = decide(GovernorState(0.699, 1.5), 0.7, setpoint)
    assert governed.limits == (Limit.STALE,)
    assert np.all(path_N(governed) < 1.5)


def beats_N(time_s: float) -> float:
    """A pulse of 1.1 Hz with a notch."""
    phase = 2.0 * math.pi * 1.1 * time_s
    return 1.4 + 0.15 * math.sin(phase) + 0.08 * math.sin(2.0 * phase + 1.0) + 0.04 * math.sin(3.0 * phase)


SWIFT = Governor(PORTRAIT, SCENE, 3.0 * GAP_SPEED_MM_S)
"Its gap is fast enough for this pulse."


def beaten(seconds: float, governor: Governor = GOVERNOR) -> GovernorState:
    """The state after so much of the pulse, 500 times a second, without a preview."""
    state = GovernorState(0.0, 0.4)
    for tick in range(1, round(500 * seconds) + 1):
        state, _ = governor.govern(state, tick / 500, beat(tick / 500), DeviceFit(), 0.0)
        state = governor.foresee(state)
    return state


def beat(time_s: float) -> TimedSetpoint:
    return TimedSetpoint(beats_N(time_s), time_s, VALID_S)


@pytest.fixture(scope="module")
def learned() -> GovernorState:
    return beaten(10.0)


@pytest.mark.parametrize(("lag_s", "share"), [(0.0, 0.3), (0.01, 0.75)])
def test_a_force_that_repeats_itself_is_foreseen(lag_s: float, share: float) -> None:
    worst_N = extrapolated_N = 0.0
    state = beaten(10.0, SWIFT)
    for tick in range(5_001, 5_501):
        now_s = tick / 500
        state, governed = SWIFT.govern(SWIFT.foresee(state), now_s, beat(now_s), DeviceFit(), lag_s)
        _, blind = SWIFT.govern(state.replaced(periodicity=NOTHING_LEARNED), now_s, beat(now_s), DeviceFit(), 0.0)
        assert governed.foresight > 0.9
        assert governed.limits == ()
        # what carriages that come later by the lag are sent to now is rendered then
        wanted = [beats_N(now_s + lag_s + ahead_s) for ahead_s in PATH_S]
        worst_N = max(worst_N, float(np.abs(path_N(governed) - wanted).max()))
        extrapolated_N = max(extrapolated_N, float(np.abs(path_N(blind) - wanted).max()))
    assert worst_N < share * extrapolated_N


def test_of_what_is_foreseen_a_slow_gap_makes_the_best(learned: GovernorState) -> None:
    """It turns before the force does, and is asked for no more than it can do."""
    fastest_N_s = GAP_SPEED_MM_S * (PORTRAIT.force_N[-1] - PORTRAIT.force_N[0]) / (95.0 - 45.0)
    state, follower_N = learned, learned.asked_N
    missed_N, followed_N = [], []
    for tick in range(5_001, 5_956):
        now_s = tick / 500
        state, governed = decide(GOVERNOR.foresee(state), now_s, beat(now_s))
        assert np.all(np.abs(np.diff(path_N(governed))) <= fastest_N_s * np.diff(PATH_S) + 0.01)
        assert governed.force_N == pytest.approx(beats_N(now_s))
        step_N = fastest_N_s / 500
        follower_N += min(max(beats_N(now_s) - follower_N, -step_N), step_N)
        missed_N.append(governed.path_N[0] - beats_N(now_s))
        followed_N.append(follower_N - beats_N(now_s))
    assert np.std(missed_N) < 0.8 * np.std(followed_N)


def test_a_lag_is_made_up_for_as_far_as_it_is_known_what_comes() -> None:
    state, _ = stream_of([1.0 + 0.01 * k for k in range(40)])
    live = TimedSetpoint(1.39, 0.4, VALID_S)
    _, extrapolated = decide(state, 0.4, live, lag_s=0.02)
    assert extrapolated.foresight == 0.0
    assert path_N(extrapolated)[0] == pytest.approx(1.39)


def test_no_forecast_holds_a_force_of_a_stale_setpoint(learned: GovernorState) -> None:
    last = TimedSetpoint(beats_N(10.0), 10.0, VALID_S)
    state = learned
    for tick in range(1, 1_000):
        now_s = 10.0 + tick * 1e-3
        state, governed = decide(state, now_s, last)
        if now_s - 10.0 <= VALID_S:
            continue
        assert governed.limits == (Limit.STALE,)
        assert governed.foresight == 0.0
        assert np.all(path_N(governed) == governed.force_N)
        assert state.periodicity == NOTHING_LEARNED
    assert state.asked_N == PORTRAIT.least_N


def test_a_silent_stream_is_not_believed_to_go_on(learned: GovernorState) -> None:
    """However long its last setpoint is valid."""
    last = TimedSetpoint(beats_N(10.0), 10.0, 60.0)
    _, soon = decide(learned, 10.05, last)
    assert soon.foresight > 0.9
    _, late = decide(learned, 10.2, last)
    assert late.foresight == 0.0
    _, blind = decide(learned.replaced(periodicity=NOTHING_LEARNED), 10.2, last)
    assert np.all(path_N(late) == path_N(blind))


def test_what_a_long_preview_says_is_not_foreseen(learned: GovernorState) -> None:
    state, _ = decide(learned, 10.002, TimedSetpoint(1.4, 10.002, VALID_S, preview_N=(1.4,) * 200, preview_dt_s=2e-3))
    assert state.periodicity == NOTHING_LEARNED


def test_past_its_end_a_short_preview_of_what_repeats_itself_is_foreseen() -> None:
    """With 40 ms of a pulse known, the gap is sent to what comes in 90."""
    missed: dict[bool, list[float]] = {True: [], False: []}
    for is_foreseen, found in missed.items():
        governor = Governor(PORTRAIT, SCENE, GAP_SPEED_MM_S, Terms(forecast=is_foreseen))
        state = GovernorState(0.0, beats_N(0.0))
        for tick in range(1, 5_000):
            now_s = tick * 2e-3
            ahead_N = tuple(beats_N(now_s + 2e-3 * step) for step in range(1, 21))
            setpoint = TimedSetpoint(beats_N(now_s), now_s, VALID_S, preview_N=ahead_N, preview_dt_s=2e-3)
            state, _ = governor.govern(governor.foresee(state), now_s, setpoint, DeviceFit(), 0.0)
            if now_s > 6.0:
                wanted_N = _previewed_N(setpoint, 0.0, 0.0, 10.0, state.periodicity)
                found.append(wanted_N[LEAST_WAY - 1] - beats_N(now_s + WAY_S[LEAST_WAY - 1]))
    assert np.std(missed[True]) < 0.5 * np.std(missed[False])


def test_touches_that_nobody_foresees_are_gone_for() -> None:
    """Random ones of a newton, each as long as the pause behind it, and half of what the gap would need."""
    random = np.random.default_rng(8)
    state, now_s = GovernorState(0.0, 0.7), 0.0
    for _ in range(20):
        for force_N in (0.7, random.uniform(1.2, 1.9)):
            for _ in range(round(100 * random.uniform(0.2, 0.5))):
                now_s += 0.01
                setpoint = TimedSetpoint(force_N, now_s, VALID_S)
                state, governed = GOVERNOR.govern(GOVERNOR.foresee(state), now_s, setpoint, DeviceFit(), 0.0)
                assert (governed.force_N, governed.limits) == (force_N, ())


events = st.tuples(
    st.none() | st.floats(0.0, 1_000.0),
    st.lists(st.floats(0.0, 1_000.0), max_size=20),
    st.floats(-2.0, 2.0) | st.just(0.0) | st.just(1e6),
    st.floats(1e-3, 60.0),
    st.floats(0.0, 0.5) | st.just(0.0) | st.just(1e-9) | st.just(1e5),
)


@settings(max_examples=150, deadline=None)
@given(history=st.lists(events, min_size=1, max_size=30))
def test_nan_never_travels(history: list[tuple[float | None, list[float], float, float, float]]) -> None:
    """First setpoints, equal stamps, huge gaps, stamps ahead and behind, in any order."""
    state, now_s = GovernorState(0.0, PORTRAIT.least_N), 0.0
    for force_N, preview, age_s, valid_s, elapsed_s in history:
        now_s += elapsed_s
        setpoint = None
        if force_N is not None:
            setpoint = TimedSetpoint(
                force_N, now_s - age_s, valid_s, preview_N=tuple(preview), preview_dt_s=max(valid_s / 20.0, 1e-6)
            )
        state, governed = decide(state, now_s, setpoint)
        assert math.isfinite(state.slope_N_s)
        assert PORTRAIT.least_N <= governed.force_N <= PORTRAIT.most_N
        assert np.all((path_N(governed) >= PORTRAIT.least_N) & (path_N(governed) <= PORTRAIT.most_N))
        assert math.isfinite(state.asked_N)
        is_stale = setpoint is not None and now_s - setpoint.stamp_s > valid_s
        assert (Limit.STALE in governed.limits) == is_stale
        assert (Limit.NO_SETPOINT in governed.limits) == (setpoint is None)
