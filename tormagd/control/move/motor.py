"""DC motor, gearbox and lead screw of one carriage: continuous model, H(z) by zero-order hold, stability margins.

Continuous model, from duty u to carriage position x (mm), friction and load left out because they are disturbances:
    L di/dt = V u - R i - Ke w,    J dw/dt = Ke i,    dx/dt = w lead / (2 pi N)
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from tormagd.config import Config, Motor, Position
from tormagd.control.records import GapSpeeds

Array = npt.NDArray[np.float64]

PULL_STATED_MM: Final = 45.0
"The gap for which `motor.pull_V` is stated."
MAX_MARGIN_DB: Final = 200.0
"No gain makes such a loop swing or, negative, every gain does."
PULL_DEPTH_MM: Final = 32.0
"Two blocks of 40 x 40 x 20 mm attract each other like dipoles this much further apart than their faces."


LIVELY: Final = 1.1
"The plant card's motors turn up to 9% faster than their figures; a late gap may ask for that."


class TransferFunction(NamedTuple):
    """H(z) = numerator(z) / denominator(z), highest power first."""

    numerator: Array
    denominator: Array


class Margins(NamedTuple):
    gain_margin_dB: float
    phase_margin_deg: float
    crossover_Hz: float


def full_speed_mm_s(motor: Motor) -> float:
    """Return the speed of one carriage at full duty without load."""
    return motor.supply_V / motor.back_emf_V_s / motor.gear_ratio * motor.screw_lead_mm / (2.0 * math.pi)


def most_closing_mm_s(config: Config) -> float:
    return LIVELY * config.position.duty_limit * 2.0 * full_speed_mm_s(config.motor)


def gap_speeds(config: Config) -> GapSpeeds:
    """Return the gap's speeds. Counted on is what the motors do against dry friction."""
    position, motor = config.position, config.motor
    closing_mm_s = position.closing_mm_s or most_closing_mm_s(config)
    no_load_mm_s = 2.0 * full_speed_mm_s(motor)
    sure_mm_s = no_load_mm_s * (position.duty_limit - motor.coulomb_V / motor.supply_V)
    sure_mm_s = min(closing_mm_s, max(sure_mm_s, position.gap_speed_mm_s))
    return GapSpeeds(closing_mm_s, position.gap_speed_mm_s, sure_mm_s, no_load_mm_s)


def pull_V(stated_V: float, gap_mm: float) -> float:
    """Return the voltage that one motor needs against the magnets' pull at `gap_mm`."""
    nearness = (PULL_STATED_MM + PULL_DEPTH_MM) / (gap_mm + PULL_DEPTH_MM)
    nearness *= nearness
    return stated_V * nearness * nearness


def mechanical_time_s(motor: Motor) -> float:
    """Return the time constant of the speed: J R / Ke^2."""
    return motor.inertia_kg_m2 * motor.resistance_ohm / motor.back_emf_V_s**2


def electrical_time_s(motor: Motor) -> float:
    return motor.inductance_mH * 1e-3 / motor.resistance_ohm


def zero_order_hold(motor: Motor, period_s: float) -> TransferFunction:
    """Return H(z) from duty to carriage position, mm, exact for a duty held over each period."""
    slow_s, quick_s = mechanical_time_s(motor), electrical_time_s(motor)
    poles = np.roots([slow_s * quick_s, slow_s, 1.0]).astype(np.complex128)
    # the step response at full speed: the sum of share (e^(p t) - 1 - p t) over the poles p
    shares_s = 1.0 / (slow_s * quick_s * poles**2 * (poles - poles[::-1]))
    exponents = period_s * np.outer(np.arange(4.0), poles)
    steps_s = ((np.expm1(exponents) - exponents) @ shares_s).real
    denominator: Array = np.poly([1.0, *np.exp(period_s * poles)]).real.astype(np.float64)
    # its differences are the impulse response; times the denominator they give the numerator
    numerator = full_speed_mm_s(motor) * np.convolve(denominator, np.diff(steps_s, prepend=0.0))[:4]
    return TransferFunction(numerator, denominator)


def delay_margin_s(motor: Motor, position: Position, period_s: float) -> float:
    """Return the delay beyond one period's exchange that the position loop bears."""
    known = margins(motor, position, period_s)
    return max(known.phase_margin_deg, 0.0) / 360.0 / known.crossover_Hz


def margins(motor: Motor, position: Position, period_s: float) -> Margins:
    """Return the margins of one carriage's position loop as it is computed: PID and its filter in z,
    H(z), and a delay."""
    frequency = np.geomspace(0.05, 0.4999 / period_s, 4_000)
    z = np.exp(2j * np.pi * frequency * period_s)
    plant = zero_order_hold(motor, period_s)
    open_loop = np.polyval(plant.numerator, z) / np.polyval(plant.denominator, z) * z**-1.0
    integral = period_s / position.integral_time_s / (1.0 - 1.0 / z)
    smoothing = period_s / (position.derivative_filter_s + period_s)
    derivative = position.derivative_time_s * smoothing * (1.0 - 1.0 / z) / period_s / (1.0 - (1.0 - smoothing) / z)
    open_loop = open_loop * position.proportional_per_mm * (1.0 + integral + derivative)
    magnitude = np.maximum(np.abs(open_loop), 10.0 ** (-MAX_MARGIN_DB / 20.0))
    phase_deg = np.degrees(np.unwrap(np.angle(open_loop)))
    phase_deg += 360.0 * np.round((-180.0 - phase_deg[0]) / 360.0)
    below = np.flatnonzero((magnitude[:-1] >= 1.0) & (magnitude[1:] < 1.0))
    crossing = int(below[-1]) if below.size else 0
    turning = np.flatnonzero(np.diff(phase_deg < -180.0))
    # more gain makes the loop swing where the phase turns beyond the crossover, and less gain where it turns before
    gains_dB = 20.0 * np.log10(magnitude[turning])
    gain_margin = float(np.where(turning > crossing, -gains_dB, gains_dB).min(initial=MAX_MARGIN_DB))
    if phase_deg[crossing] < -180.0:  # the loop swings
        gain_margin = -abs(gain_margin)
    return Margins(gain_margin, 180.0 + float(phase_deg[crossing]), float(frequency[crossing]))
