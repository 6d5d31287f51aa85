"""The governor: every difference between force asked and force rendered has a reason, and none of them jumps."""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings, strategies as st

from tormagd.control.aim.portrait import Portrait
from tormagd.control.ask.forecast import GRID_S, HORIZON, Forecast
from tormagd.control.ask.governor import AHEAD_S, MIN_TIMES, Governor
from tormagd.control.ask.path import PATH_S, TIMES_S
from tormagd.control.believe.strength import DeviceFit
from tormagd.control.records import Ask, GapSpeeds, TimedSetpoint, Travel
from tormagd.control.safety.codes import Limit
from tormagd.element.physics.errors import DomainError
from tormagd.ground.plain_values import plain, restore
from tormagd.record.stream import KNOWN
from tormagd.scenes.scene import EVERY_TERM, Force, Terms

PORTRAIT = Portrait(
    np.linspace(95.0, 45.0, 19).tolist(), np.linspace(0.4, 2.2, 19).tolist(), np.linspace(0.01, 0.1, 19).tolist()
)
SCENE = Force(least_N=0.0, most_N=2.0, resolution_N=0.1, tolerance_rms_N=0.05)
GAP_SPEED_MM_S = 38.0
STEEPEST_N_S = GAP_SPEED_MM_S * max(PORTRAIT.slope_N_mm)
AFTER_S = np.array(PATH_S)
VALID_S = 0.1


def governor(
    now_s: float = 0.0,
    asked_N: float = 0.4,
    *,
    scene: Force = SCENE,
    portrait: Portrait = PORTRAIT,
    gap_speed_mm_s: float = GAP_SPEED_MM_S,
    terms: Terms = EVERY_TERM,
) -> Governor:
    begun = Governor(now_s, portrait, scene, GapSpeeds(*[gap_speed_mm_s] * 3), terms)
    begun.asked_N = asked_N
    begun.from_mm = begun.sent_mm = portrait.gap_mm_at(asked_N)
    return begun


def decide(following: Governor, now_s: float, setpoint: TimedSetpoint | None, lag_s: float = 0.0) -> Ask:
    return following.update(now_s, setpoint, DeviceFit(), lag_s)


def path_N(ask: Ask) -> npt.NDArray[np.float64]:
    return np.array(ask.path_N)


def stream_of(
    forces_N: list[float], period_s: float = 0.01, lag_s: float = 0.0, portrait: Portrait = PORTRAIT
) -> tuple[Governor, Ask]:
    """Return a governor after setpoints that came one per period, with its last decision."""
    following = governor(portrait=portrait)
    for number, force_N in enumerate(forces_N, 1):
        now_s = number * period_s
        ask = decide(following, now_s, TimedSetpoint(force_N, now_s, VALID_S), lag_s)
    return following, ask


RAMP_N = [1.0 + 0.01 * k for k in range(40)]


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
    ask = decide(governor(scene=scene), 1.0, TimedSetpoint(asked, 1.0, VALID_S))
    assert (ask.force_N, ask.limits) == (pytest.approx(rendered), limits)


def test_without_a_setpoint_the_least_force_is_rendered() -> None:
    ask = decide(governor(), 1.0, None)
    assert (ask.force_N, ask.age_s, ask.limits) == (0.4, None, (Limit.NO_SETPOINT,))
    assert np.all(path_N(ask) == 0.4)


@pytest.mark.parametrize("preview_N", [(), (1.6,) * 200])
def test_a_stale_setpoint_decays_along_the_ramp_and_not_below_the_least(preview_N: tuple[float, ...]) -> None:
    setpoint = TimedSetpoint(1.6, 1.0, VALID_S, preview_N=preview_N, preview_dt_s=2e-3)
    following = governor(0.99, 1.6)
    decide(following, 1.0, setpoint)
    assert decide(following, 1.1 - 1e-9, setpoint).limits == ()
    for tick in range(1, 1_000):
        now_s = 1.1 + tick * 1e-3
        ask = decide(following, now_s, setpoint)
        assert (ask.limits, ask.age_s) == ((Limit.STALE,), pytest.approx(now_s - 1.0))
        assert np.all(path_N(ask) == ask.force_N)
        assert ask.force_N == pytest.approx(max(0.4, 1.6 - SCENE.release_N_s * tick * 1e-3), abs=5e-9)
    assert ask.force_N == 0.4


@pytest.mark.parametrize("ahead_N", [(), (1.0,) * 40])
@pytest.mark.parametrize(("before_N", "after_N"), [(1.6, 0.8), (0.8, 1.6)])
def test_from_one_holder_to_the_next_the_force_goes_along_the_ramp(
    before_N: float, after_N: float, ahead_N: tuple[float, ...]
) -> None:
    following, reached = governor(0.0, before_N), 0
    ask = decide(following, 0.001, TimedSetpoint(before_N, 0.001, VALID_S))
    for tick in range(2, 1_000):
        now_s, last_N = tick * 1e-3, ask.force_N
        preview_N = tuple(after_N * share for share in ahead_N)
        setpoint = TimedSetpoint(
            after_N, now_s, VALID_S, preview_N=preview_N, preview_dt_s=0.002, holder=1, limits=(Limit.OTHER_SOURCE,)
        )
        ask = decide(following, now_s, setpoint)
        assert abs(ask.force_N - last_N) <= SCENE.release_N_s * 1e-3 + 1e-9
        is_there = abs(ask.force_N - after_N) <= 1e-12
        assert ask.limits == ((Limit.OTHER_SOURCE,) if is_there else (Limit.OTHER_SOURCE, Limit.TAKEOVER))
        reached = reached or tick * is_there
    assert reached == pytest.approx(0.8 / SCENE.release_N_s * 1e3, abs=5)
    ask = decide(following, 1.001, TimedSetpoint(1.2, 1.001, VALID_S, holder=1))
    assert (ask.force_N, ask.limits) == (1.2, ())


def test_a_takeover_turns_where_the_new_holder_does_and_ends_a_step_from_its_force() -> None:
    following, at_N, step_N = governor(0.0, 1.2), 1.2, SCENE.release_N_s * 1e-3
    decide(following, 0.001, TimedSetpoint(1.2, 0.001, VALID_S))
    for tick in range(2, 62):
        now_s, to_N = tick * 1e-3, 1.6 if tick < 30 else 1.2 - 0.6 * step_N
        ask = decide(following, now_s, TimedSetpoint(to_N, now_s, VALID_S, holder=1))
        is_far = abs(to_N - at_N) > step_N
        at_N = at_N + math.copysign(step_N, to_N - at_N) if is_far else ask.path_N[0]
        assert (ask.force_N, Limit.TAKEOVER in ask.limits) == (pytest.approx(at_N), is_far)
        assert ask.path_N == pytest.approx([at_N] * len(PATH_S)) or not is_far
    assert ask.force_N == to_N


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
    following, now_s = governor(0.0, 2.0), 0.0
    for holder, age_s, elapsed_s in events:
        now_s += elapsed_s
        before_N = following.asked_N
        ask = decide(following, now_s, TimedSetpoint(0.5 + 0.5 * holder, now_s - age_s, VALID_S, holder=holder))
        if following.is_passing or Limit.STALE in ask.limits:
            assert before_N - following.asked_N <= SCENE.release_N_s * elapsed_s + 1e-9
        assert following.asked_N == ask.path_N[0]


def test_another_holders_forces_teach_no_slope_and_no_period() -> None:
    following, _ = stream_of([1.0, 1.1, 1.2])
    assert following.slope_N_s != 0.0
    decide(following, 0.04, TimedSetpoint(1.0, 0.04, VALID_S, holder=1))
    assert (following.slope_N_s, np.frombuffer(following.forecast.history).tolist()) == (0.0, [1.0])


@pytest.mark.parametrize("holder", [0, 1])
def test_a_hand_that_draws_back_is_let_go_at_once_after_a_silence_too(holder: int) -> None:
    following, _ = stream_of([1.0, 1.1, 1.2])
    decide(following, 0.2, TimedSetpoint(1.2, 0.03, VALID_S))
    setpoint = TimedSetpoint(1.5, 0.201, VALID_S, holder=holder, withdraw_N=0.7)
    for is_pushing, asked_N in ((True, following.asked_N), (False, 0.7), (True, 1.5)):
        ask = following.update(0.201, setpoint, DeviceFit(), 0.0, Travel(0.0, 0.0, is_pushing))
        assert (ask.path_N[0], Limit.TAKEOVER in ask.limits) == (
            pytest.approx(asked_N, abs=0.01),
            asked_N not in (0.7, 1.5),
        )


@pytest.mark.parametrize("holder", [0, 1])
def test_after_a_silence_a_publisher_is_followed_from_the_decayed_force_without_a_slope_from_before(
    holder: int,
) -> None:
    following, _ = stream_of([1.0, 1.1, 1.2])
    decayed_N = decide(following, 0.2, TimedSetpoint(1.2, 0.03, VALID_S)).force_N
    ask = decide(following, 0.201, TimedSetpoint(1.5, 0.201, VALID_S, holder=holder))
    risen_N = pytest.approx(decayed_N + SCENE.release_N_s * 1e-3)
    assert (ask.force_N, ask.path_N, ask.limits) == (risen_N, [ask.force_N] * len(PATH_S), (Limit.TAKEOVER,))
    ask = decide(following, 1.2, TimedSetpoint(1.5, 1.2, VALID_S, holder=holder))
    assert (ask.force_N, ask.path_N, ask.limits) == (1.5, [1.5] * len(PATH_S), ())


@pytest.mark.parametrize("asked_N", [0.8, 1.8])
def test_from_a_gap_that_was_held_the_force_goes_along_the_ramp(asked_N: float) -> None:
    following, _ = stream_of([1.0] * 20)
    for tick in range(1, 30):
        now_s = 0.2 + tick * 1e-3
        ask = following.update(now_s, TimedSetpoint(asked_N, now_s, VALID_S), DeviceFit(), 0.0, held_N=1.3)
        assert (ask.force_N, ask.path_N) == (1.3, [1.3] * len(PATH_S))
    ask = decide(following, now_s + 0.01, TimedSetpoint(asked_N, now_s + 0.01, VALID_S))
    assert ask.force_N == pytest.approx(1.3 + math.copysign(0.01 * SCENE.release_N_s, asked_N - 1.3))


@pytest.mark.parametrize("lag_s", [0.0, 0.02])
def test_a_slope_is_learned_and_carried_ahead(lag_s: float) -> None:
    following, ask = stream_of(RAMP_N)
    assert following.slope_N_s == pytest.approx(1.0, rel=1e-3)
    assert path_N(ask) == pytest.approx(1.39 + AFTER_S, abs=1e-3)
    for waited_s, ahead_N in ((0.0, 1.39), (0.01, 1.40), (AHEAD_S, 1.44), (0.09, 1.44)):
        later = decide(following, 0.4 + waited_s, TimedSetpoint(1.39, 0.4, VALID_S), lag_s)
        assert (path_N(later)[0], later.force_N, later.foresight) == (
            pytest.approx(ahead_N, abs=1e-3),
            pytest.approx(1.39),
            0.0,
        )


@settings(max_examples=100, deadline=None)
@given(
    forces_N=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=40),
    period_s=st.floats(1e-6, 0.2),
    lag_s=st.floats(0.0, 0.05),
)
def test_the_slope_is_one_that_the_gap_speed_can_render(forces_N: list[float], period_s: float, lag_s: float) -> None:
    following, ask = stream_of(forces_N, period_s, lag_s)
    assert abs(following.slope_N_s) <= STEEPEST_N_S + 1e-9
    assert np.all((path_N(ask) >= PORTRAIT.min_N) & (path_N(ask) <= SCENE.most_N))
    assert PORTRAIT.min_N <= ask.force_N <= SCENE.most_N


def test_a_jump_at_a_flat_force_gives_the_slope_renderable_there() -> None:
    flat = Portrait([95.0, 70.0, 45.0], [0.4, 1.0, 2.2], [0.001, 0.001, 0.1])
    following, _ = stream_of([1.0, 0.4, 1.0, 0.4, 0.5], portrait=flat)
    assert abs(following.slope_N_s) <= GAP_SPEED_MM_S * 0.001 + 1e-12


def test_a_stamp_ahead_of_the_clock_is_of_no_age() -> None:
    following, _ = stream_of(RAMP_N)
    ask = decide(following, 0.41, TimedSetpoint(1.4, 0.45, VALID_S))
    assert (ask.age_s, path_N(ask)[0], ask.limits) == (pytest.approx(-0.04), pytest.approx(1.4), ())


@pytest.mark.parametrize("now_s", [1.0, 0.5, -10.0])
def test_a_clock_that_stands_still_or_goes_back_lets_nothing_jump(now_s: float) -> None:
    assert decide(governor(1.0, 1.5), now_s, None).force_N == 1.5


def at(force_N: Callable[[float], float], now_s: float, ahead_s: float = 0.0) -> TimedSetpoint:
    ahead_N = tuple(force_N(now_s + 0.002 * place) for place in range(1, round(500 * ahead_s) + 1))
    return TimedSetpoint(force_N(now_s), now_s, VALID_S, preview_N=ahead_N, preview_dt_s=0.002)


def told(force_N: Callable[[float], float], seconds: float, *, ahead_s: float = 0.4, lag_s: float = 0.0) -> Ask:
    """The last decision on setpoints with previews, 500 times a second from 0 s on."""
    following = governor(0.0, force_N(0.0))
    for tick in range(1, round(500 * seconds) + 1):
        ask = decide(following, tick / 500, at(force_N, tick / 500, ahead_s), lag_s)
    return ask


def swing_N(time_s: float) -> float:
    return 1.5 + 0.05 * math.sin(2.0 * math.pi * 2.0 * time_s)


@pytest.mark.parametrize("seconds", [0.3, 0.5, 0.82])
@pytest.mark.parametrize("ahead_s", [0.07, 0.4])
def test_a_preview_is_what_comes(seconds: float, ahead_s: float) -> None:
    ask = told(swing_N, seconds, ahead_s=ahead_s)
    assert (path_N(ask), ask.force_N, ask.limits, ask.foresight) == (
        pytest.approx([swing_N(seconds + after_s) for after_s in PATH_S], abs=2e-3),
        ask.path_N[0],
        (),
        1.0,
    )


def step_N(time_s: float) -> float:
    return 1.2 if time_s < 1.0 else 1.8


def test_what_is_too_fast_is_missed_before_and_after() -> None:
    assert path_N(told(step_N, 0.6)) == pytest.approx(1.2)
    there = told(step_N, 1.0)
    assert (there.force_N, there.limits) == (pytest.approx(1.5, abs=0.1), (Limit.RATE,))
    long_after = told(step_N, 1.4)
    assert (path_N(long_after), long_after.limits) == (pytest.approx(1.8, abs=2e-3), ())
    # what is not known cannot be prepared for
    assert told(step_N, 0.88, ahead_s=0.05).force_N == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("preview_N", "spacing_s", "named"),
    [
        *[((1.6,), spacing_s, "preview_dt_s = .*: at least 0.0001 s$") for spacing_s in (0.0, 5e-324, 9e-5, math.nan)],
        ((1.6, 1e308, -1e308), 0.01, "preview_N = 1e.308"),
    ],
)
def test_a_preview_without_a_measure_of_its_slope_is_refused(
    preview_N: tuple[float, ...], spacing_s: float, named: str
) -> None:
    with pytest.raises(DomainError, match=named):
        TimedSetpoint(1.0, 1.0, VALID_S, preview_N=preview_N, preview_dt_s=spacing_s).require_numbers()


@given(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=60), st.floats(1e-4, 1.0), st.floats(0.0, 0.03))
def test_no_path_is_faster_than_the_gap_or_beyond_what_was_asked(
    ahead_N: list[float], spacing_s: float, lag_s: float
) -> None:
    following = governor(0.0, 1.0)
    for tick in range(1, 6):
        before_N, now_s = following.asked_N, 0.004 * tick
        leap = tuple(ahead_N[tick:] + ahead_N[:tick])
        setpoint = TimedSetpoint(leap[0], now_s, VALID_S, preview_N=leap, preview_dt_s=spacing_s)
        ask = decide(following, now_s, setpoint, lag_s)
        assert abs(ask.path_N[0] - before_N) <= STEEPEST_N_S * 0.004 + 1e-9
        assert np.all(np.abs(np.diff(path_N(ask))) <= STEEPEST_N_S * 0.005 + 1e-9)
        assert np.all((path_N(ask) >= PORTRAIT.min_N) & (path_N(ask) <= SCENE.most_N))


def test_a_short_preview_goes_on_as_it_ran_and_not_for_long() -> None:
    rising = TimedSetpoint(1.0, 0.5, 10.0, preview_N=(1.005, 1.01), preview_dt_s=5e-3)
    following = governor(0.499, 1.0)
    soon = decide(following, 0.5, rising)
    assert np.all(np.diff(path_N(soon)) > 0.0)
    assert path_N(soon)[-1] < 1.02
    highest_N = max(path_N(decide(following, 0.5 + 0.01 * tick, rising))[-1] for tick in range(1, 100))
    assert highest_N == pytest.approx(1.02, abs=1e-3)
    # then nobody goes on as told, and what was told last is held
    assert path_N(decide(following, 1.5, rising)) == pytest.approx(np.full(len(PATH_S), 1.01))


ENDS = Portrait([90.0, 50.0], [1.0, 2.0], [0.025, 0.025])


@pytest.mark.parametrize(("asked_N", "ahead_N", "end_mm"), [(1.01, 1.0, 90.0), (1.99, 2.0, 50.0)])
def test_no_carriages_are_sent_past_the_ends(asked_N: float, ahead_N: float, end_mm: float) -> None:
    following = governor(0.0, asked_N, portrait=ENDS)
    decide(following, 1.0, TimedSetpoint(asked_N, 1.0, VALID_S, preview_N=(ahead_N,) * 200, preview_dt_s=5e-3))
    assert following.sent_mm == end_mm


def beats_N(time_s: float) -> float:
    phase = 2.0 * math.pi * 1.1 * time_s
    return 1.4 + 0.15 * math.sin(phase) + 0.08 * math.sin(2.0 * phase + 1.0) + 0.04 * math.sin(3.0 * phase)


def beaten(seconds: float, **keywords) -> Governor:
    following = governor(**keywords)
    for tick in range(1, round(500 * seconds) + 1):
        decide(following, tick / 500, at(beats_N, tick / 500))
        following.foresee()
    return following


@pytest.fixture(scope="module")
def learned_once():
    return plain(beaten(10.0))


@pytest.fixture
def learned(learned_once) -> Governor:
    following = governor()
    restore(following, learned_once, KNOWN)
    return following


@pytest.mark.parametrize(("lag_s", "share"), [(0.0, 0.3), (0.01, 0.75)])
def test_a_force_that_repeats_itself_is_foreseen(lag_s: float, share: float) -> None:
    worst_N = extrapolated_N = 0.0
    swift_mm_s = 3.0 * GAP_SPEED_MM_S
    following = beaten(10.0, gap_speed_mm_s=swift_mm_s)
    blind = beaten(10.0, gap_speed_mm_s=swift_mm_s, terms=EVERY_TERM.without("forecast"))
    for tick in range(5_001, 5_501):
        now_s = tick / 500
        ask, extrapolated = (
            decide(following, now_s, at(beats_N, now_s), lag_s),
            decide(blind, now_s, at(beats_N, now_s)),
        )
        following.foresee()
        assert ask.foresight > 0.9
        assert ask.limits == ()
        # what late carriages are sent to now is rendered after the lag
        wanted_N = [beats_N(now_s + lag_s + ahead_s) for ahead_s in PATH_S]
        worst_N = max(worst_N, float(np.abs(path_N(ask) - wanted_N).max()))
        extrapolated_N = max(extrapolated_N, float(np.abs(path_N(extrapolated) - wanted_N).max()))
    assert worst_N < share * extrapolated_N


@pytest.mark.parametrize(("age_s", "ahead_s"), [(0.2, 0.0), (0.002, 0.4)], ids=["stale", "a long preview"])
def test_what_is_over_or_told_at_length_is_not_foreseen(learned: Governor, age_s: float, ahead_s: float) -> None:
    decide(learned, 10.002 + age_s, at(beats_N, 10.002, ahead_s))
    assert plain(learned.forecast) == plain(Forecast())


def test_a_silent_stream_is_not_believed_to_go_on(learned: Governor) -> None:
    last = TimedSetpoint(beats_N(10.0), 10.0, 60.0)
    assert decide(learned, 10.05, last).foresight > 0.9
    late = decide(learned, 10.2, last)
    assert late.foresight == 0.0
    learned.forecast.forget()
    assert np.all(path_N(late) == path_N(decide(learned, 10.2, last)))
    leapt, _ = stream_of([1.0, 1.5], 0.05)
    assert path_N(decide(leapt, 0.201, TimedSetpoint(1.5, 0.1, 60.0))) == pytest.approx(1.5)


def test_past_its_end_a_short_preview_of_what_repeats_itself_is_foreseen() -> None:
    missed: dict[bool, list[float]] = {True: [], False: []}
    for is_foreseen, found in missed.items():
        following = governor(0.0, beats_N(0.0), terms=Terms(forecast=is_foreseen))
        for tick in range(1, 5_000):
            now_s = tick * 2e-3
            setpoint = at(beats_N, now_s, 0.04)
            following.foresee()
            decide(following, now_s, setpoint)
            if now_s > 6.0:
                wanted_N = following.going_on_N(setpoint, 0.0, following.forecast.trust)
                known_s = 0.04 + HORIZON * GRID_S * is_foreseen
                assert len(wanted_N) == max(MIN_TIMES, sum(after_s < known_s for after_s in TIMES_S))
                found.append(wanted_N[MIN_TIMES - 1] - beats_N(now_s + TIMES_S[MIN_TIMES - 1]))
    assert np.std(missed[True]) < 0.5 * np.std(missed[False])
