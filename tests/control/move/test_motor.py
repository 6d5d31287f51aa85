"""H(z) of motor and screw, and the stability margins, against scipy and against a bisection of their own."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy.optimize import brentq
from scipy.signal import StateSpace, cont2discrete, dlsim, lfilter

from tormagd.config import Config, Motor, Position
from tormagd.control.assembly.build import MIN_GAIN_MARGIN_DB, MIN_PHASE_MARGIN_DEG, build_core
from tormagd.control.move.motor import (
    MAX_MARGIN_DB,
    delay_margin_s,
    margins,
    pull_V,
    zero_order_hold,
)
from tormagd.element.physics.magnets import CuboidMagnet, attraction_N
from tormagd_client.endpoints import ConfigError

PERIOD_S = 1e-3
motors = st.builds(
    Motor,
    supply_V=st.floats(6.0, 24.0),
    resistance_ohm=st.floats(0.5, 20.0),
    inductance_mH=st.floats(0.1, 10.0),
    back_emf_V_s=st.floats(0.003, 0.05),
    inertia_kg_m2=st.floats(1e-7, 1e-5),
    gear_ratio=st.floats(10.0, 200.0),
    screw_lead_mm=st.floats(1.0, 10.0),
)
periods = st.floats(2.5e-4, 0.012)


def continuous(motor: Motor) -> StateSpace:
    """The motor's differential equations, written down a second time: current A, speed rad/s, position mm."""
    inductance_H = motor.inductance_mH * 1e-3
    a = [
        [-motor.resistance_ohm / inductance_H, -motor.back_emf_V_s / inductance_H, 0.0],
        [motor.back_emf_V_s / motor.inertia_kg_m2, 0.0, 0.0],
        [0.0, motor.screw_lead_mm / (motor.gear_ratio * math.tau), 0.0],
    ]
    return StateSpace(a, [[motor.supply_V / inductance_H], [0.0], [0.0]], [[0.0, 0.0, 1.0]], [[0.0]])


@given(motor=motors, period_s=periods)
def test_the_step_response_is_that_of_the_held_continuous_motor(motor: Motor, period_s: float) -> None:
    ours = zero_order_hold(motor, period_s)
    system = continuous(motor)
    exact = cont2discrete((system.A, system.B, system.C, system.D), period_s, method="zoh")
    duty = np.r_[np.ones(20), -0.5 * np.ones(20)]
    _, expected, _ = dlsim(exact, duty)
    response = lfilter(ours.numerator, ours.denominator, duty)
    np.testing.assert_allclose(response, expected.ravel(), rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def open_loop(motor: Motor, position: Position, frequency_Hz: float) -> complex:
    """The loop's response at one frequency: scipy's plant, and the controller's difference equations."""
    system = continuous(motor)
    a, b, c, _, _ = cont2discrete((system.A, system.B, system.C, system.D), PERIOD_S, method="zoh")
    z = np.exp(2j * np.pi * frequency_Hz * PERIOD_S)
    plant = (c @ np.linalg.solve(z * np.eye(3) - a, b))[0, 0]
    integral = PERIOD_S / position.integral_time_s * z / (z - 1.0)
    share = PERIOD_S / (position.derivative_filter_s + PERIOD_S)
    speed = share * ((z - 1.0) / (z * PERIOD_S)) / (1.0 - (1.0 - share) / z)
    controller = position.proportional_per_mm * (1.0 + integral + position.derivative_time_s * speed)
    return complex(plant * controller / z)


def test_margins_agree_with_an_independent_computation() -> None:
    config = Config()
    ours = margins(config.motor, config.position, PERIOD_S)

    def gain(frequency_Hz: float) -> float:
        return math.log(abs(open_loop(config.motor, config.position, frequency_Hz)))

    def phase_past_turning(frequency_Hz: float) -> float:
        # the imaginary part of -L changes sign where the phase passes -180 degrees
        return (-open_loop(config.motor, config.position, frequency_Hz)).imag

    crossover_Hz = brentq(gain, 3.0, 100.0)
    phase_deg = math.degrees(np.angle(-open_loop(config.motor, config.position, crossover_Hz)))
    turning_Hz = brentq(phase_past_turning, 20.0, 150.0)
    assert (ours.crossover_Hz, ours.phase_margin_deg) == (
        pytest.approx(crossover_Hz, rel=0.01),
        pytest.approx(phase_deg, abs=0.5),
    )
    assert ours.gain_margin_dB == pytest.approx(-20.0 * gain(turning_Hz) / math.log(10.0), abs=0.1)


ENDS = {
    "supply_V": (3.0, 60.0),
    "resistance_ohm": (0.05, 100.0),
    "inductance_mH": (0.01, 100.0),
    "back_emf_V_s": (1e-4, 1.0),
    "inertia_kg_m2": (1e-9, 1e-2),
    "gear_ratio": (1.0, 1_000.0),
    "screw_lead_mm": (0.2, 50.0),
}


@given(
    motor=st.builds(Motor, **{name: st.sampled_from(both) for name, both in ENDS.items()}),
    gain=st.sampled_from([5e-324, 3.6, 1_000.0]),
    period_s=st.sampled_from([2.5e-4, 1e-3, 1.0 / 83.0]),
)
def test_margins_are_numbers_at_every_corner_of_what_is_accepted(motor: Motor, gain: float, period_s: float) -> None:
    position = Position(proportional_per_mm=gain)
    found = margins(motor, position, period_s)
    assert all(map(math.isfinite, (*found, delay_margin_s(motor, position, period_s))))
    assert abs(found.gain_margin_dB) <= MAX_MARGIN_DB


def closed_loop_radius(motor: Motor, position: Position) -> float:
    plant = zero_order_hold(motor, PERIOD_S)
    share = PERIOD_S / (position.derivative_filter_s + PERIOD_S)
    integral = np.poly1d([PERIOD_S / position.integral_time_s, 0.0])
    filtered = np.poly1d([1.0, share - 1.0])
    origin, unity = np.poly1d([1.0, 0.0]), np.poly1d([1.0, -1.0])
    speed = share / PERIOD_S * position.derivative_time_s * unity * unity
    numerator = position.proportional_per_mm * (unity * filtered + integral * filtered + speed)
    denominator = unity * filtered * origin
    characteristic = np.poly1d(plant.denominator) * denominator + np.poly1d(plant.numerator) * numerator
    return float(np.abs(characteristic.roots).max())


SHORT_INTEGRAL = Position(
    proportional_per_mm=0.09375, integral_time_s=0.005859375, derivative_time_s=0.75, derivative_filter_s=0.0001
)
"Just unstable at 1.8 Hz, where the gain is first 1, and robust at its crossover of 10 Hz."


@settings(max_examples=150, deadline=None)
@example(position=SHORT_INTEGRAL)
@given(
    position=st.builds(
        Position,
        proportional_per_mm=st.floats(1e-3, 1_000.0),
        integral_time_s=st.floats(0.005, 100.0),
        derivative_time_s=st.floats(0.0, 1.0),
        derivative_filter_s=st.floats(1e-4, 0.1),
    )
)
def test_gains_at_their_bounds_are_unstable_only_where_the_margins_say_so(position: Position) -> None:
    motor = Config().motor
    found = margins(motor, position, PERIOD_S)
    if found.phase_margin_deg >= MIN_PHASE_MARGIN_DEG and found.gain_margin_dB >= MIN_GAIN_MARGIN_DB:
        assert closed_loop_radius(motor, position) < 1.0


OSCILLATES = r"phase margin of .* gain margin of .* allowed is at least"
TOO_WEAK = r"coulomb_V = .* pull_V = .* to open the gap from .* allowed is"


@pytest.mark.parametrize(
    ("section", "said"),
    [
        (Position(proportional_per_mm=60.0), OSCILLATES),
        (Position(proportional_per_mm=1_000.0), OSCILLATES),
        (Position(derivative_time_s=0.5), OSCILLATES),
        (Position(derivative_time_s=0.0, integral_time_s=0.005), OSCILLATES),
        (Motor(pull_V=6.0), TOO_WEAK),
        (Motor(coulomb_V=5.8), TOO_WEAK),
        (Motor(supply_V=3.0, coulomb_V=1.4), TOO_WEAK),
    ],
)
def test_gains_that_would_oscillate_and_motors_too_weak_for_the_pull_give_no_core(section, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        build_core(Config(**{type(section).__name__.lower(): section}))


@pytest.mark.parametrize("gap_mm", np.linspace(45.0, 95.0, 11))
def test_the_pull_falls_with_the_gap_as_that_of_two_blocks(gap_mm: float) -> None:
    block = CuboidMagnet(0.04, 0.04, 0.02, 1.45)
    motor = Config().motor
    expected = attraction_N(float(gap_mm), block) / attraction_N(45.0, block)
    assert pull_V(motor.pull_V, gap_mm) / motor.pull_V == pytest.approx(expected, rel=0.03)
