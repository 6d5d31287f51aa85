"""The PID against simple-pid where their structures coincide, and where ours is meant to be better."""

import math

import msgspec
import pytest
from hypothesis import given, settings, strategies as st
from simple_pid import PID

from tormagd.config import Config, Position
from tormagd.control.move.pid import ON_TARGET_MM, Pid

DT_S = 1e-3
SHIPPED = Config().position
errors = st.floats(-50.0, 50.0)
speeds = st.floats(-500.0, 500.0)
positions = st.builds(
    Position,
    proportional_per_mm=st.floats(0.1, 20.0),
    integral_time_s=st.floats(0.01, 10.0),
    derivative_time_s=st.floats(0.0, 0.05),
    back_calculation_s=st.floats(0.01, 10.0),
    duty_limit=st.floats(0.1, 1.0),
)


def begun(position: Position = SHIPPED, integral: float = 0.0) -> Pid:
    stage = Pid(position)
    stage.integral = integral
    return stage


def updated(stage: Pid, error_mm: float, error_mm_s: float = 0.0, ahead: float = 0.0, count: int = 1) -> float:
    for _ in range(count):
        duty = stage.update(error_mm, error_mm_s, ahead, DT_S, False)
    return duty


@settings(max_examples=100, deadline=None)
@given(
    sequence=st.lists(st.floats(-0.02, 0.02), min_size=1, max_size=40),
    proportional=st.floats(0.1, 5.0),
    integral_time_s=st.floats(0.05, 10.0),
)
def test_unsaturated_p_and_i_are_those_of_simple_pid(
    sequence: list[float], proportional: float, integral_time_s: float
) -> None:
    stage = Pid(Position(proportional_per_mm=proportional, integral_time_s=integral_time_s, derivative_time_s=0.0))
    oracle = PID(proportional, proportional / integral_time_s, 0.0, setpoint=0.0, sample_time=None)
    for error in sequence:
        before = stage.integral
        duty = updated(stage, error)
        oracle(-error, dt=DT_S)
        proportional_part, integral_part, _ = oracle.components
        assert (stage.is_saturated, duty, stage.integral) == (
            False,
            pytest.approx(proportional_part + before, abs=1e-12),
            pytest.approx(integral_part, abs=1e-12),
        )


@given(position=positions, integral=st.floats(-1.0, 1.0), error=errors, speed=speeds, ahead=st.floats(-3.0, 3.0))
def test_the_duty_never_leaves_its_limit(
    position: Position, integral: float, error: float, speed: float, ahead: float
) -> None:
    stage, limit = begun(position, integral), position.duty_limit
    assert abs(updated(stage, error, speed, ahead)) <= limit
    asked = position.proportional_per_mm * (error + position.derivative_time_s * speed) + integral + ahead
    assert stage.is_saturated == (abs(asked) > limit) or abs(abs(asked) - limit) < 1e-9


@settings(max_examples=50, deadline=None)
@given(
    position=positions,
    integral=st.floats(-0.1, 0.1),
    history=st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 30.0), st.floats(0.0, 1.0)), min_size=1),
)
def test_nothing_winds_up_against_a_switch(
    position: Position, integral: float, history: list[tuple[float, float, float]]
) -> None:
    stage = begun(position, integral)
    for error, speed, ahead in history * 20:
        assert stage.update(error, speed, ahead, DT_S, True) <= 0.0
        assert not stage.is_saturated
        assert -position.duty_limit <= stage.integral <= max(integral, 0.0)


@given(position=positions, back_calculation_s=st.floats(0.01, 0.2), error=st.floats(15.0, 50.0))
def test_back_calculation_balances_growth(position: Position, back_calculation_s: float, error: float) -> None:
    stage = Pid(msgspec.structs.replace(position, back_calculation_s=back_calculation_s))
    updated(stage, error, count=2_000)
    assert stage.is_saturated
    proportional, limit = position.proportional_per_mm * error, position.duty_limit
    balance = limit - proportional * (1.0 - back_calculation_s / position.integral_time_s)
    assert stage.integral == pytest.approx(min(max(balance, -limit), limit), abs=1e-3)


@given(integral=st.floats(-1.0, 1.0), error_mm=st.floats(-0.01, 0.01))
def test_a_carriage_at_rest_on_target_forgets_within_its_integral_time(integral: float, error_mm: float) -> None:
    stage = begun(integral=integral)
    for _ in range(round(SHIPPED.integral_time_s / DT_S)):
        stage.rest(error_mm, DT_S)
    if abs(error_mm) > ON_TARGET_MM:
        assert stage.integral == integral
    else:
        assert stage.integral == pytest.approx(integral / math.e, rel=0.01)
