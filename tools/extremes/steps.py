"""The part of `numerics.py` that steps through time: 1 us..10 s, motion and force to a hundred times normal.

Each update is compared with its own formula in 50 digits, from the same state. The error counts against 8 eps times the
sum of the sizes of the formula's terms, which is its condition number's worth, or 1e-12 of the result's scale if that
is more. The relaxation is also followed through a whole sequence of unequal steps.
"""

import math
import sys
from dataclasses import dataclass, field
from typing import Any

import mpmath as mp
import numpy as np

from firmware_protocol.codec import DeviceFault, DeviceMode, Switches
from tormagd.config import Position
from tormagd.control.estimate import LEAST_DT_S, first_estimate, update
from tormagd.control.pid import Error, Gains, PidState, pid
from tormagd.control.trajectory import Reference, Speeds, follow
from tormagd.hardware.measurement import Measurement
from tormagd.physics.element import RateStrengthening, TorqueElement
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.force import TORMAG, Elastomer
from tormagd.physics.friction import Friction
from tormagd.physics.hysteresis import Hysteresis
from tormagd.physics.relaxation import PronySeries

DIGITS = 50
EPS = sys.float_info.epsilon
STEPS = 12
NORMAL_FORCE_N, NORMAL_SPEED_MM_S, NORMAL_TRAVEL_MM = 5.0, 42.0, 2.0
EXTREME = 100.0


@dataclass
class StepErrors:
    """Sequences run, numbers that were not finite, and by model the worst error over what is allowed."""

    cases: int = 0
    nonfinite: int = 0
    over_allowed: dict[str, float] = field(default_factory=dict)

    def take(self, name: str, computed: float, exact: Any, terms: Any, scale: float = 0.0) -> None:
        """Note one result beside its reference; `terms` is the sum of the sizes of what was added up."""
        if not math.isfinite(computed):
            self.nonfinite += 1
            return
        allowed = max(8.0 * EPS * float(terms), 1e-12 * max(scale, abs(float(exact))))
        share = float(abs(mp.mpf(computed) - exact)) / allowed if allowed > 0.0 else float(computed != exact)
        self.over_allowed[name] = max(self.over_allowed.get(name, 0.0), share)


def worst_step_errors(seed: int, sequences: int) -> StepErrors:
    """Every model over that many sequences of `STEPS` unequal steps."""
    rng = np.random.default_rng(seed)
    errors = StepErrors()
    with mp.workdps(DIGITS):
        for _ in range(sequences):
            steps_s = _log_uniform(rng, 1e-6, 10.0, STEPS)
            _relaxation(errors, rng, steps_s)
            _friction(errors, rng, steps_s)
            _element(errors, rng, steps_s)
            _pid(errors, rng, steps_s)
            _speed_filter(errors, rng, steps_s)
            _reference(errors, rng, steps_s)
            errors.cases += STEPS
    return errors


def _relaxation(errors: StepErrors, rng: np.random.Generator, steps_s: list[float]) -> None:
    branches = int(rng.integers(1, 5))
    fractions = (rng.dirichlet(np.ones(branches)) * rng.uniform(0.0, 0.99)).tolist()
    series = PronySeries(tuple(fractions), tuple(_log_uniform(rng, 1e-6, 1e6, branches)))
    shares, times = [mp.mpf(g) for g in series.fractions], [mp.mpf(tau) for tau in series.times_s]
    state = series.relaxed(0.0)
    exact, last, largest = [mp.mpf(0)] * branches, mp.mpf(0), 0.0
    for dt_s in steps_s:
        driving = float(rng.uniform(-1.0, 1.0)) * EXTREME * NORMAL_FORCE_N
        largest = max(largest, abs(driving))
        force, state = series.discretise(dt_s).advance(state, driving)
        for index, tau in enumerate(times):
            ratio = mp.mpf(dt_s) / tau
            exact[index] = exact[index] * mp.exp(-ratio) + (driving - last) * -mp.expm1(-ratio) / ratio
        last = mp.mpf(driving)
        truth = (1 - sum(shares)) * driving + sum(g * h for g, h in zip(shares, exact, strict=True))
        errors.take("relaxation", force, truth, (2 + branches) * largest)


def _friction(errors: StepErrors, rng: np.random.Generator, steps_s: list[float]) -> None:
    friction = Friction(
        presliding_stiffness_N_mm=_log_uniform(rng, 1e-2, 1e3, 1)[0],
        viscous_N_s_mm=float(rng.uniform(0.0, 1e-2)),
        static_ratio=float(rng.uniform(1.0, 2.0)),
        stribeck_speed_mm_s=_log_uniform(rng, 1e-2, 1e2, 1)[0],
    )
    sigma, ratio_s = mp.mpf(friction.presliding_stiffness_N_mm), mp.mpf(friction.static_ratio)
    deflection = float(rng.uniform(-1.0, 1.0)) * EXTREME * NORMAL_TRAVEL_MM
    for dt_s in steps_s:
        speed = float(rng.choice((-1.0, 0.0, 1.0))) * _log_uniform(rng, 1e-9, EXTREME * NORMAL_SPEED_MM_S, 1)[0]
        kinetic = float(rng.choice((0.0, 1.0))) * _log_uniform(rng, 1e-6, EXTREME * NORMAL_FORCE_N, 1)[0]
        level = kinetic * (1 + (ratio_s - 1) * mp.exp(-((mp.mpf(speed) / friction.stribeck_speed_mm_s) ** 2)))
        viscous = mp.mpf(friction.viscous_N_s_mm) * speed
        reach = level / sigma
        start = min(max(mp.mpf(deflection), -reach), reach)
        steady = reach if speed >= 0.0 else -reach
        moved = start - (steady - start) * mp.expm1(-abs(mp.mpf(speed)) * dt_s / reach) if reach > 0 else mp.mpf(0)
        force, deflection = friction.advance(deflection, speed, kinetic, dt_s)
        errors.take("friction force", force, sigma * moved + viscous, 2 * level + abs(viscous))
        errors.take("friction deflection", deflection, moved, 2 * reach)


def _element(errors: StepErrors, rng: np.random.Generator, steps_s: list[float]) -> None:
    """Every term at once: finite, and never more than break-away and viscous force can be."""
    rate, friction = RateStrengthening(0.05, 10.0), Friction(8.0, 0.0005, 1.15, 5.0)
    element = TorqueElement(
        PowerFieldLaw(),
        Elastomer(277.3e3, 4.0, 0.2),
        TORMAG,
        hysteresis=Hysteresis((0.02, 0.02), (1e-4, 5e-4)),
        rate=rate,
        relaxation=PronySeries((0.05, 0.04, 0.04), (8.0, 90.0, 900.0)),
        friction=friction,
    )
    state = element.rested(95.0)
    for dt_s in steps_s:
        speed = float(rng.uniform(-1.0, 1.0)) * EXTREME * NORMAL_SPEED_MM_S
        force, state = element.discretise(dt_s).advance(state, float(rng.uniform(45.0, 1000.0)), speed)
        most = 8.0 * rate.factor(EXTREME * NORMAL_SPEED_MM_S) * 1.15 * 1.13 + friction.viscous_N_s_mm * abs(speed)
        if not abs(force) <= most:
            errors.nonfinite += 1


def _pid(errors: StepErrors, rng: np.random.Generator, steps_s: list[float]) -> None:
    gains = Gains.of(Position())
    integral = float(rng.uniform(-1.0, 1.0)) * gains.duty_limit
    limit = mp.mpf(gains.duty_limit)
    for dt_s in steps_s:
        error_mm = float(rng.choice((1.0, 0.001))) * float(rng.uniform(-1.0, 1.0)) * EXTREME
        speed_error = float(rng.uniform(-1.0, 1.0)) * EXTREME * NORMAL_SPEED_MM_S
        feed_forward = float(rng.uniform(-2.0, 2.0))
        proportional = mp.mpf(gains.proportional_per_mm) * error_mm
        derivative = mp.mpf(gains.proportional_per_mm) * mp.mpf(gains.derivative_time_s) * speed_error
        terms = [proportional, mp.mpf(integral), derivative, mp.mpf(feed_forward)]
        asked = sum(terms)
        duty = min(max(asked, -limit), limit)
        growth = [proportional / gains.integral_time_s, duty / gains.back_calculation_s]
        growth += [-term / gains.back_calculation_s for term in terms]
        following = min(max(integral + sum(growth) * dt_s, -limit), limit)
        state, output = pid(gains, PidState(integral), Error(error_mm, speed_error), feed_forward, dt_s)
        errors.take("PID duty", output.duty, duty, sum(map(abs, terms)))
        errors.take("PID integral", state.integral, following, sum(map(abs, growth)) * dt_s + abs(integral))
        integral = state.integral


def _speed_filter(errors: StepErrors, rng: np.random.Generator, steps_s: list[float]) -> None:
    filter_s = _log_uniform(rng, 1e-4, 0.1, 1)[0]
    home_mm = 47.5
    time_s = float(rng.uniform(0.0, 1e4))
    last = first_estimate(_measurement(0, time_s, 0.0), home_mm)
    for number, dt_s in enumerate(steps_s, start=1):
        time_s += dt_s
        left_mm = float(rng.uniform(-1.0, 1.0)) * EXTREME * 25.0
        exact_dt = mp.mpf(time_s) - mp.mpf(last.device_time_s)
        share = exact_dt / (mp.mpf(filter_s) + exact_dt)
        quotient = (mp.mpf(home_mm) + left_mm - last.left_mm) / exact_dt
        truth = last.left_mm_s + share * (quotient - last.left_mm_s)
        # positions to a rounding each, over the step; the step's own rounding is exact in the device's clock
        terms = abs(last.left_mm_s) + share * (home_mm + abs(left_mm) + abs(last.left_mm)) / exact_dt
        if exact_dt < LEAST_DT_S:  # no news: the device's clock does not count so finely
            truth, terms = last.left_mm_s, abs(last.left_mm_s)
        last = update(last, _measurement(number, time_s, left_mm), home_mm, filter_s)
        errors.take("speed filter", last.left_mm_s, truth, terms)


def _reference(errors: StepErrors, rng: np.random.Generator, steps_s: list[float]) -> None:
    """Finite, and never faster than the limit."""
    limits = Position()
    speeds = Speeds(1.05 * limits.gap_speed_mm_s, limits.gap_speed_mm_s, limits.gap_speed_mm_s)
    reference = Reference(float(rng.uniform(45.0, 95.0)))
    for dt_s in steps_s:
        target_mm = float(rng.uniform(0.0, 1.0)) * EXTREME * 95.0
        target_speed = float(rng.uniform(-1.0, 1.0)) * EXTREME * limits.gap_speed_mm_s
        reference, _, _ = follow(
            limits.gap_acceleration_mm_s2, reference, Reference(target_mm, target_speed), dt_s, speeds
        )
        if not all(map(math.isfinite, (reference.gap_mm, reference.speed_mm_s, reference.acceleration_mm_s2))):
            errors.nonfinite += 1
        excess = max(abs(reference.speed_mm_s) - limits.gap_speed_mm_s, 0.0)
        errors.take("reference speed", excess, mp.mpf(0), limits.gap_speed_mm_s)


def _measurement(number: int, time_s: float, left_mm: float) -> Measurement:
    return Measurement(
        number=number,
        received_s=time_s,
        device_time_s=time_s,
        left_mm=left_mm,
        right_mm=left_mm,
        left_current_A=0.0,
        right_current_A=0.0,
        force_N=0.0,
        handle_mm=left_mm,
        mode=DeviceMode.RUN,
        switches=Switches.HOMED,
        faults=DeviceFault(0),
        temperature_C=25.0,
        supply_V=12.0,
        sensed_s=time_s,
        reported_s=time_s,
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float, count: int) -> list[float]:
    values: list[float] = (low * (high / low) ** rng.uniform(0.0, 1.0, count)).tolist()
    return values
