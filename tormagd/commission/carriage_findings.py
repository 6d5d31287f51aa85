"""What the motion shows: how both carriages answer jumps and sines, and from that their motors and the loop's gains."""

import cmath
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from tormagd.commission.finding import Array, Finding, finding, fitted
from tormagd.commission.force_findings import GAINS, ready
from tormagd.commission.procedure import Columns, Course, Known, watch
from tormagd.config import Motor
from tormagd.control.move.motor import PULL_DEPTH_MM, margins

JUMP_SHARES = (0.0, 0.5, 0.2, 0.8, 0.35, 1.0, 0.6, 0.9, 0.1, 0.7, 0.3, 0.55, 0.5)
"Shares of the range: small and large jumps, up and down, over the whole stroke."
JUMP_S = 0.6
SLOW_S = 6.0
SMOOTH_S, SLOWEST_MM_S = 0.2, 0.5
SINES_HZ = (24.0, 16.0, 8.0, 4.0, 2.0, 1.0)
"The slow ones come last: what they teach of the carriages' lag stays, and a scene's forces are slow."
SINE_S = 3.0
SWING_N_S, SWING_N_S2 = 1.6, 100.0
"Greatest first and second derivative of the sines: within the gap's speed and acceleration."
AT_HZ = 4.0
MIN_RATIO, MAX_BEHIND = 0.707, math.radians(45.0)
"A carriage follows a sine with at least this share of its swing, and at most this far behind."
MIN_BANDWIDTH_HZ = 12.0
SIDES = ("left", "right")
WINDOW_S = 0.021
MOVING_M_S = 2e-3
"A slower carriage may stand, where friction takes any value."
THINNED = 20
WEAK = "look at supply, motor, gearbox and screw; then at the gains"
PLUG = "look at the motor's plugs, wires and brushes"
SCALE = "compare motor, gear ratio, screw lead and the encoder's counts with [motor]: one of them is another"
COUPLED = "look at gearbox and coupling, and compare the motor with [motor]"
GREASE = "grease the screw; look what rubs, and at the gearbox. A device that is right: take its calibration"
RESISTANCE = "resistance over motor.resistance_ohm"
BACK_EMF = "voltage for speed over the configured"
INERTIA = "inertia over motor.inertia_kg_m2"
FRICTION = "friction over the configured"
ALLOWED = {RESISTANCE: (0.75, 1.25), BACK_EMF: (0.88, 1.12), INERTIA: (0.6, 2.2), FRICTION: (0.75, 1.25)}
"""Most friction is the gearbox's: a screw that runs dry adds a fifth."""
REMEDIES = {RESISTANCE: PLUG, BACK_EMF: SCALE, INERTIA: COUPLED, FRICTION: GREASE}


Driven = dict[str, tuple[float, float]]
"""What a carriage's motor shows, each value with the half width of its interval."""


def nominals(motor: Motor) -> dict[str, float]:
    return {
        RESISTANCE: motor.resistance_ohm,
        BACK_EMF: motor.back_emf_V_s,
        INERTIA: motor.inertia_kg_m2,
        FRICTION: motor.coulomb_V / motor.resistance_ohm * motor.back_emf_V_s or math.nan,
    }


def carriages(known: Known) -> Course[list[Finding]]:
    """Go slowly, jump and swing over the range while the handle is moved."""
    levels_N = [known.force_N(share) for share in JUMP_SHARES]
    yield from ready(levels_N[0])
    times_s, forces_N = (0.0, SLOW_S, 2.0 * SLOW_S), (levels_N[0], known.most_N, levels_N[0])
    slow = yield from watch(times_s[-1], lambda t_s: float(np.interp(t_s, times_s, forces_N)))
    jumps = yield from watch(JUMP_S * len(levels_N), lambda t_s: levels_N[min(int(t_s / JUMP_S), len(levels_N) - 1)])
    swings: dict[float, Columns] = {}
    for at_Hz in SINES_HZ:
        rad_s = math.tau * at_Hz
        swing_N = min(SWING_N_S / rad_s, SWING_N_S2 / rad_s**2, 0.25 * (known.most_N - levels_N[0]))
        swings[at_Hz] = yield from watch(SINE_S, _sine(levels_N[-1], swing_N, at_Hz), is_told_ahead=True)
    found = [each for side in SIDES for each in _answers(swings, side)]
    ticks = {name: np.concatenate([each[name] for each in (jumps, *swings.values())]) for name in jumps}
    driven = [_driven(known, ticks, side) for side in SIDES]
    for side, motor in zip(SIDES, driven, strict=True):
        found += _motor_findings(known, slow, side, motor)
    margin_dB = margins(identified(known.config.motor, driven), known.config.position, known.period_s).gain_margin_dB
    return [*found, finding("gain margin of the position loop", margin_dB, "dB", (6.0, 200.0), GAINS)]


def _sine(middle_N: float, swing_N: float, at_Hz: float) -> Callable[[float], float]:
    return lambda t_s: middle_N + swing_N * math.sin(math.tau * at_Hz * t_s)


def _answers(swings: dict[float, Columns], side: str) -> list[Finding]:
    ratios = {at_Hz: _ratio(sine, side, at_Hz) for at_Hz, sine in swings.items()}
    lag_s = -cmath.phase(ratios[AT_HZ]) / (math.tau * AT_HZ)
    most_Hz = max(SINES_HZ)
    return [
        finding(f"{side} carriage's gain at {AT_HZ:g} Hz", abs(ratios[AT_HZ]), "", (0.9, 1.1), WEAK),
        finding(f"{side} carriage's lag at {AT_HZ:g} Hz", lag_s, "ms", (0.0, 12.0), WEAK, 1e3),
        finding(
            f"{side} carriage's bandwidth, of {most_Hz:g} Hz tried",
            _bandwidth_Hz(ratios),
            "Hz",
            (MIN_BANDWIDTH_HZ, most_Hz),
            WEAK,
        ),
    ]


def _bandwidth_Hz(ratios: dict[float, complex]) -> float:
    lacks = [
        (at_Hz, max(MIN_RATIO / max(abs(it), 1e-9), abs(cmath.phase(it)) / MAX_BEHIND))
        for at_Hz, it in sorted(ratios.items())
    ]
    low_Hz, before = 0.0, 0.0
    for at_Hz, lack in lacks:
        if not lack <= 1.0:
            return low_Hz * (at_Hz / low_Hz) ** ((1.0 - before) / (lack - before)) if low_Hz else 0.0
        low_Hz, before = at_Hz, lack
    return low_Hz


def _ratio(ticks: Columns, side: str, at_Hz: float) -> complex:
    """Return a carriage's complex response at `at_Hz`, relative to half of the gap reference."""
    times_s = ticks["monotonic_s"] - ticks["monotonic_s"][0]
    whole = (times_s >= 1.0 / at_Hz) & (times_s < math.floor(SINE_S * at_Hz) / at_Hz)
    turning = np.exp(-2j * math.pi * at_Hz * times_s[whole])

    def swing(values: Array) -> complex:
        return complex(np.mean((values[whole] - values[whole].mean()) * turning))

    return swing(ticks[f"{side}_mm"]) / (swing(ticks["reference_gap_mm"]) / 2.0 or math.nan)


def _driven(known: Known, ticks: Columns, side: str) -> Driven:
    """Return the motor parameters of a side from its moving ticks."""
    motor, period_s = known.config.motor, known.period_s
    volts, current_A, slope_A_s, speed_m_s, acceleration, moves, window = smoothed(period_s, ticks, side)
    pull = smooth((ticks["left_mm"] + ticks["right_mm"] + PULL_DEPTH_MM) ** -4.0, window)
    kept = np.flatnonzero(moves)[window:-window:THINNED]
    blocks = np.floor(ticks["monotonic_s"][kept])
    ones = np.ones_like(volts)
    electric = np.column_stack([column[kept] for column in (current_A, speed_m_s, slope_A_s, ones)])
    mechanical = np.column_stack([column[kept] for column in (acceleration, np.sign(speed_m_s), pull, speed_m_s)])
    (ohm, emf, *_), (ohm_width, emf_width, *_) = fitted(electric, volts[kept], blocks)
    (mass, *_), (mass_width, *_) = fitted(mechanical, current_A[kept], blocks)
    advance_m_rad = motor.screw_lead_mm * 1e-3 / (math.tau * motor.gear_ratio)
    inertia = emf * advance_m_rad**2
    return {
        "resistance_ohm": (float(ohm), float(ohm_width)),
        "back_emf_V_s": (float(emf * advance_m_rad), float(emf_width * advance_m_rad)),
        "inertia_kg_m2": (float(mass * inertia), float(mass_width * inertia)),
    }


class Smoothed(NamedTuple):
    volts: Array
    current_A: Array
    slope_A_s: Array
    speed_m_s: Array
    acceleration_m_s2: Array
    moves: npt.NDArray[np.bool_]
    window: int


def smoothed(period_s: float, ticks: Columns, side: str) -> Smoothed:
    window = max(round(WINDOW_S / period_s), 1) | 1
    # a tick's duty acts until the next tick's measurement
    volts = smooth(np.roll(ticks[f"{side}_duty"], 1) * ticks["supply_V"], window)
    current_A = smooth(ticks[f"{side}_current_A"], window)
    speed_m_s = np.gradient(smooth(ticks[f"{side}_mm"], window)) * 1e-3 / period_s
    slope_A_s, acceleration = np.gradient(current_A) / period_s, np.gradient(speed_m_s) / period_s
    moves = (np.abs(speed_m_s) > MOVING_M_S) & np.isfinite(volts + current_A + speed_m_s)
    moves &= np.abs(smooth(np.sign(speed_m_s), window)) > 0.98
    return Smoothed(volts, current_A, slope_A_s, speed_m_s, acceleration, moves, window)


def smooth(values: Array, window: int) -> Array:
    """Return values (n) after two running means over `window`; both ends fall to 0."""
    kernel = np.convolve(np.full(window, 1.0 / window), np.full(window, 1.0 / window))
    return np.convolve(values, kernel, "same")


def _motor_findings(known: Known, slow: Columns, side: str, driven: Driven) -> list[Finding]:
    torque_Nm = _friction_A(known.period_s, slow, side) * driven["back_emf_V_s"][0]
    seen = zip(nominals(known.config.motor).items(), (*driven.values(), (torque_Nm, 0.0)), strict=True)
    return [
        finding(f"{side} {name}", value / nominal, "", ALLOWED[name], REMEDIES[name], half_width=width / nominal)
        for (name, nominal), (value, width) in seen
    ]


def _friction_A(period_s: float, ticks: Columns, side: str) -> float:
    """Return the dry friction's current: half of what opening takes more than closing."""
    window = max(round(SMOOTH_S / period_s), 1)
    flat = np.full(window, 1.0 / window)
    current_A, place_mm = (np.convolve(ticks[f"{side}_{name}"], flat, "same") for name in ("current_A", "mm"))
    speed = np.gradient(place_mm) / period_s
    speed[:window] = speed[-window:] = 0.0
    close = place_mm < np.median(place_mm)
    opening, closing = (current_A[close & (goes > SLOWEST_MM_S)] for goes in (speed, -speed))
    return float(np.median(opening) - np.median(closing)) / 2.0 if opening.size and closing.size else math.nan


def identified(motor: Motor, driven: Sequence[Driven]) -> Motor:
    """Return `motor` with the means of what its carriages show."""
    means = {name: float(np.mean([each[name][0] for each in driven])) for name in driven[0]}
    return msgspec.structs.replace(motor, **{name: value for name, value in means.items() if math.isfinite(value)})
