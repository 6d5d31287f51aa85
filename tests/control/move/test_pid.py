"""The PID against simple-pid where their structures coincide, and where ours is meant to be better."""

import math

import pytest
from hypothesis import given, settings, strategies as st
from simple_pid import PID

from tormagd.config import Config, Position
from tormagd.control.move.pid import Error, Gains, ON_TARGET_MM, PidOutput, PidState, pid, rested

DT_S = 1e-3
GAINS = Gains.of(Config().position)
errors = st.floats(-50.0, 50.0)
gains = st.builds(
    Gains,
    proportional_per_mm=st.floats(0.1, 20.0),
    integral_time_s=st.floats(0.01, 10.0),
    derivative_time_s=st.floats(0.0, 0.05),
    back_calculation_s=st.floats(0.01, 10.0),
    duty_limit=st.floats(0.1, 1.0),
)


def update(
    position: Gains, state: PidState, error_mm: float, speed_error_mm_s: float = 0.0, feed_forward: float = 0.0
) -> tuple[PidState, PidOutput]:
    """One update, a millisecond after the last."""
    return pid(position, state, Error(error_mm, speed_error_mm_s), feed_forward, DT_S)


@settings(max_examples=100, deadline=None)
@given(
    sequence=st.lists(st.floats(-0.02, 0.02), min_size=1, max_size=40),
    proportional=st.floats(0.1, 5.0),
    integral_time_s=st.floats(0.05, 10.0),
)
def test_unsaturated_p_and_i_are_those_of_simple_pid(
    sequence: list[float], proportional: float, integral_time_s: float
) -> None:
    """simple-pid integrates before it answers and we do after, so its integral is ours one update later."""
    position = Gains.of(
        Position(proportional_per_mm=proportional, integral_time_s=integral_time_s, derivative_time_s=0.0)
    )
    oracle = PID(proportional, proportional / integral_time_s, 0.0, setpoint=0.0, sample_time=None)
    state = PidState()
    for error in sequence:
        before = state
        state, output = update(position, before, error)
        oracle(-error, dt=DT_S)
        proportional_part, integral_part, _ = oracle.components
        assert not output.is_saturated
        assert output.duty == pytest.approx(proportional_part + before.integral, abs=1e-12)
        assert state.integral == pytest.approx(integral_part, abs=1e-12)


@given(
    position=gains,
    integral=st.floats(-1.0, 1.0),
    error=errors,
    speed=st.floats(-500.0, 500.0),
    ahead=st.floats(-3.0, 3.0),
)
def test_the_duty_never_leaves_its_limit(
    position: Gains, integral: float, error: float, speed: float, ahead: float
) -> None:
    _, output = update(position, PidState(integral), error, speed, ahead)
    assert abs(output.duty) <= position.duty_limit
    asked = position.proportional_per_mm * (error + position.derivative_time_s * speed) + integral + ahead
    assert output.is_saturated == (abs(asked) > position.duty_limit) or abs(abs(asked) - position.duty_limit) < 1e-9


@settings(max_examples=50, deadline=None)
@given(
    position=gains,
    integral=st.floats(-0.1, 0.1),
    history=st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 30.0), st.floats(0.0, 1.0)), min_size=1),
)
def test_nothing_winds_up_against_a_switch(
    position: Gains, integral: float, history: list[tuple[float, float, float]]
) -> None:
    """However it is pushed there, for however long: no duty, no saturation, and closing finds no more to unlearn."""
    state = PidState(integral)
    for error, speed, ahead in history * 20:
        state, output = pid(position, state, Error(error, speed), ahead, DT_S, is_blocked=True)
        assert output.duty <= 0.0
        assert not output.is_saturated
        assert -position.duty_limit <= state.integral <= max(integral, 0.0)


def test_a_carriage_at_its_switch_closes_as_any_other() -> None:
    error = Error(-0.1, -5.0)
    assert pid(GAINS, PidState(), error, -0.2, DT_S, is_blocked=True) == pid(GAINS, PidState(), error, -0.2, DT_S)


@settings(max_examples=30, deadline=None)
@given(position=gains, error=st.floats(1.0, 50.0), sign=st.sampled_from([-1.0, 1.0]))
def test_a_long_saturation_winds_nothing_up(position: Gains, error: float, sign: float) -> None:
    state, output = PidState(), PidOutput(0.0, False)
    for _ in range(2_000):
        state, output = update(position, state, sign * error)
        assert abs(state.integral) <= position.duty_limit
    # with the error gone, the integral alone is left; it never asks for more than the whole duty
    _, output = update(position, state, 0.0)
    assert not output.is_saturated


@settings(max_examples=40, deadline=None)
@given(position=gains, back_calculation_s=st.floats(0.01, 0.2), error=st.floats(15.0, 50.0))
def test_back_calculation_balances_growth(position: Gains, back_calculation_s: float, error: float) -> None:
    """Standing saturation comes to P / Ti + (limit - P - I) / Tt = 0, within the limit."""
    position = position.replaced(back_calculation_s=back_calculation_s)
    state = PidState()
    for _ in range(2_000):
        state, output = update(position, state, error)
    assert output.is_saturated
    proportional, limit = position.proportional_per_mm * error, position.duty_limit
    balance = limit - proportional * (1.0 - back_calculation_s / position.integral_time_s)
    assert state.integral == pytest.approx(min(max(balance, -limit), limit), abs=1e-3)


def test_faster_back_calculation_lets_go_sooner() -> None:
    """A second of a blocked carriage: what the integral keeps of it is what delays the way back."""
    kept = []
    for back_calculation_s in (0.02, 0.05, 0.1, 1.0):
        position = GAINS.replaced(back_calculation_s=back_calculation_s)
        state = PidState()
        for _ in range(1_000):
            state, _ = update(position, state, 0.5)
        kept.append(state.integral)
    assert kept == sorted(kept)
    assert kept[0] < 0.0 < kept[-1]


def test_a_jump_of_the_reference_is_no_derivative_kick() -> None:
    """A target that jumps moves the error, not the speed error: the derivative does not see it."""
    _, step = update(GAINS, PidState(), 0.1)
    assert step.duty == pytest.approx(GAINS.proportional_per_mm * 0.1)
    # a carriage that moves exactly as its reference asks for no derivative action
    _, moving = update(GAINS, PidState(), 0.0, speed_error_mm_s=0.0, feed_forward=0.3)
    assert moving.duty == pytest.approx(0.3)


def test_derivative_action_brakes() -> None:
    _, output = update(GAINS, PidState(), 0.0, speed_error_mm_s=-10.0)
    assert output.duty == pytest.approx(-10.0 * GAINS.proportional_per_mm * GAINS.derivative_time_s)


def test_the_first_update_at_rest_on_target_asks_for_nothing() -> None:
    state, output = update(GAINS, PidState(), 0.0)
    assert (state, output) == (PidState(0.0), PidOutput(0.0, False))


@given(error=errors, speed=st.floats(-500.0, 500.0), integral=st.floats(-1.0, 1.0))
def test_both_directions_are_alike(error: float, speed: float, integral: float) -> None:
    state, output = update(GAINS, PidState(integral), error, speed)
    mirrored_state, mirrored = update(GAINS, PidState(-integral), -error, -speed)
    assert mirrored.duty == -output.duty
    assert mirrored_state.integral == -state.integral


@settings(max_examples=5, deadline=None)
@given(position=gains, error=st.floats(0.5, 50.0), dt_s=st.sampled_from([0.01, 0.05, 0.1]))
def test_an_hour_of_saturation_is_left_at_once(position: Gains, error: float, dt_s: float) -> None:
    """The integral stays within the whole duty, and an error of the other sign turns the duty round in one update."""
    state = PidState()
    for _ in range(round(3_600.0 / dt_s)):
        state, _ = pid(position, state, Error(error, 0.0), 0.0, dt_s)
        assert abs(state.integral) <= position.duty_limit
    most = 2.0 * position.duty_limit / position.proportional_per_mm
    _, output = update(position, state, -most)
    assert output.duty <= -position.duty_limit * (1.0 - 1e-9)


@given(integral=st.floats(-1.0, 1.0), error_mm=st.floats(-0.01, 0.01))
def test_a_carriage_at_rest_on_target_forgets_within_its_integral_time(integral: float, error_mm: float) -> None:
    state = PidState(integral)
    for _ in range(round(GAINS.integral_time_s / DT_S)):
        state = rested(GAINS, state, Error(error_mm, 0.0), DT_S)
    if abs(error_mm) > ON_TARGET_MM:
        assert state.integral == integral  # it is still on its way, and the integral is what gets it there
    else:
        assert state.integral == pytest.approx(integral / math.e, rel=0.01)


def test_no_carriage_is_nearer_than_on_target() -> None:
    """Half a count of the device's encoders, 4480 on a lead of 8 mm, is within it, and a whole one is not."""
    assert 0.5 * 8.0 / 4480.0 < ON_TARGET_MM < 8.0 / 4480.0
