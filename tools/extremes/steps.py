"""The part of `numerics.py` that steps relaxation and friction through time: 1 us..10 s, motion and force to a hundred
times normal. What steps through time in the control core has its limits in `tests/control`.

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

from tormagd.physics.friction import Friction
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


def _log_uniform(rng: np.random.Generator, low: float, high: float, count: int) -> list[float]:
    values: list[float] = (low * (high / low) ** rng.uniform(0.0, 1.0, count)).tolist()
    return values
