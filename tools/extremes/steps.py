"""The part of `numerics.py` that steps relaxation and friction through time: 1 us..10 s, motion and force to a hundred
times normal. What steps through time in the control core has its limits in `tests/control`.

Each update is compared with its own formula in 50 digits, from the same state. The error counts against 8 eps times the
sum of the sizes of the formula's terms, which is its condition number's worth, or 1e-12 of the result's scale if that
is more. The relaxation is also followed through a whole sequence of unequal steps.
"""

import math
import sys
from typing import Any

import mpmath as mp
import numpy as np

from extremes.tally import Tally, Worst
from tormagd.physics.friction import Friction
from tormagd.physics.relaxation import PronySeries

DIGITS = 50
EPS = sys.float_info.epsilon
STEPS = 12
NORMAL_FORCE_N, NORMAL_SPEED_MM_S, NORMAL_TRAVEL_MM = 5.0, 42.0, 2.0
EXTREME = 100.0


def worst_step_errors(seed: int, sequences: int) -> Tally:
    """Every model over that many sequences of `STEPS` unequal steps."""
    rng = np.random.default_rng(seed)
    tally = Tally()
    with mp.workdps(DIGITS):
        for _ in range(sequences):
            steps_s = _log_uniform(rng, 1e-6, 10.0, STEPS)
            _relaxation(tally, rng, steps_s)
            _friction(tally, rng, steps_s)
    return tally


def _note(tally: Tally, name: str, computed: float, exact: Any, terms: Any) -> None:
    """One result beside its reference; `terms` is the sum of the sizes of what was added up."""
    tally.counts["nonfinite"] += not math.isfinite(computed)
    allowed = max(8.0 * EPS * float(terms), 1e-12 * abs(float(exact)))
    share = float(abs(mp.mpf(computed) - exact)) / allowed if allowed > 0.0 else float(computed != exact)
    tally.raise_to(("steps", name), Worst(over_allowed=share))


def _relaxation(tally: Tally, rng: np.random.Generator, steps_s: list[float]) -> None:
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
        _note(tally, "relaxation", force, truth, (2 + branches) * largest)


def _friction(tally: Tally, rng: np.random.Generator, steps_s: list[float]) -> None:
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
        _note(tally, "friction force", force, sigma * moved + viscous, 2 * level + abs(viscous))
        _note(tally, "friction deflection", deflection, moved, 2 * reach)


def _log_uniform(rng: np.random.Generator, low: float, high: float, count: int) -> list[float]:
    values: list[float] = (low * (high / low) ** rng.uniform(0.0, 1.0, count)).tolist()
    return values
