"""What comes next: foreseen where a force repeats itself, and believed only where that was earned. All synthetic."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from tormagd.control.ask.forecast import (
    DELAYS,
    DOUBT_N,
    EVERY,
    FORGIVEN_N,
    GRID_S,
    HORIZON,
    LONG_S,
    LOST,
    MAX_STEP_S,
    MIN_HISTORY,
    RIDGE,
    SAME_N,
    SHORT_S,
    STRIDE,
    TAPS,
    Forecast,
    Skill,
)
from tormagd.ground.plain_values import plain, restore
from tormagd.record.stream import KNOWN

Array = npt.NDArray[np.float64]

AHEAD_S = np.array([0.02, 0.04, 0.06])
STEEPEST_N_S = 3.0


def pulse_N(times_s: Array, seed: int = 1, rate_hz: float = 1.1) -> Array:
    """Beats of two humps, each a few percent longer or shorter and higher or lower than the last."""
    random = np.random.default_rng(seed)
    forces = np.full(len(times_s), 1.4)
    starts_s = times_s[0] - 2.0 + np.cumsum(random.normal(1.0, 0.04, 4_000)[: len(times_s)]) / rate_hz
    for start_s in starts_s[starts_s < times_s[-1] + 1.0]:
        height_N = random.normal(0.25, 0.015)
        for after_s, width_s, share in ((0.2, 0.06, 1.0), (0.5, 0.09, 0.35)):
            deviation = (times_s - start_s - after_s / rate_hz) / (width_s / rate_hz)
            forces += height_N * share * np.exp(-0.5 * deviation**2)
    return forces


class Followed(NamedTuple):
    """One row per setpoint: its time, the trust, and the errors of slope and mixture at AHEAD_S."""

    time_s: Array
    trust: Array
    slope_N: Array
    mixture_N: Array

    def rms_N(self, start_s: float, end_s: float) -> tuple[float, float]:
        inside = (self.time_s >= start_s) & (self.time_s < end_s)
        slope_N, mixture_N = (float(np.sqrt(np.mean(each[inside] ** 2))) for each in (self.slope_N, self.mixture_N))
        return slope_N, mixture_N


def tell(forecast: Forecast, stamp_s: float, force_N: float, slope_N_s: float = 0.0) -> None:
    forecast.update(stamp_s, force_N)
    forecast.foresee(slope_N_s)


def follow(times_s: Array, forces_N: Array) -> Followed:
    forecast, rows, slope_N_s = Forecast(), [], 0.0
    for before, (time_s, force_N) in enumerate(zip(times_s[1:].tolist(), forces_N[1:].tolist(), strict=True)):
        steepness = (force_N - forces_N[before]) / (time_s - times_s[before])
        slope_N_s += 0.5 * (float(np.clip(steepness, -STEEPEST_N_S, STEEPEST_N_S)) - slope_N_s)
        tell(forecast, time_s, force_N, slope_N_s)
        slope_N, trust = force_N + slope_N_s * np.minimum(AHEAD_S, 0.05), forecast.trust
        mixture_N = slope_N
        if trust > 0.0:
            mixture_N = slope_N + trust * (
                np.array([forecast.force_at_N(after_s, forecast.from_N()) for after_s in AHEAD_S.tolist()]) - slope_N
            )
        came_N = np.interp(time_s + AHEAD_S, times_s, forces_N)
        rows.append((time_s, trust, slope_N - came_N, mixture_N - came_N))
    return Followed(*(np.array(column) for column in zip(*rows, strict=True)))


def beaten(seconds: float = 4.0, rate_hz: int = 200) -> Forecast:
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    forces_N = pulse_N(times_s)
    forecast = Forecast()
    for time_s, force_N, slope_N_s in zip(times_s, forces_N, np.gradient(forces_N, times_s), strict=True):
        tell(forecast, float(time_s), float(force_N), float(slope_N_s))
    return forecast


LEARNED = plain(beaten())


@pytest.fixture
def learned() -> Forecast:
    forecast = Forecast()
    restore(forecast, LEARNED, KNOWN)
    return forecast


def times_at(kind: str, seconds: float) -> Array:
    if kind == "irregular":
        return np.cumsum(np.random.default_rng(7).uniform(0.001, 0.012, round(seconds / 0.0065)))
    rate_hz = int(kind.split()[0])
    return np.arange(round(seconds * rate_hz)) / rate_hz


@pytest.mark.parametrize("kind", ["100 Hz", "500 Hz", "irregular"])
def test_a_pulse_is_foreseen_after_a_few_beats(kind: str) -> None:
    times_s = times_at(kind, 11.0)
    followed = follow(times_s, pulse_N(times_s))
    slope_N, mixture_N = followed.rms_N(5.0, 10.9)
    assert mixture_N < 0.4 * slope_N
    assert followed.trust[(followed.time_s > 5.0)].mean() > 0.8
    assert np.all(followed.trust[followed.time_s < times_s[0] + MIN_HISTORY * GRID_S - 0.02] == 0.0)


def steps_N(times_s: Array) -> Array:
    levels = np.random.default_rng(3).uniform(1.0, 1.8, 100)
    return levels[(times_s / 0.4).astype(int)]


def ramps_N(times_s: Array) -> Array:
    return np.interp(times_s, 0.3 * np.arange(100), np.random.default_rng(4).uniform(1.0, 1.8, 100))


def wander_N(times_s: Array) -> Array:
    white = np.random.default_rng(5).normal(size=(40, 2))
    phases = 2.0 * math.pi * np.outer(times_s, np.random.default_rng(6).uniform(0.2, 4.0, 40))
    return 1.4 + 0.03 * (np.cos(phases) @ white[:, 0] + np.sin(phases) @ white[:, 1])


@pytest.mark.parametrize(("kind", "most_trust"), [(steps_N, 0.1), (ramps_N, 1.0), (wander_N, 1.0)])
def test_what_does_not_repeat_itself_is_not_planned_worse_and_steps_are_never_trusted(kind, most_trust: float) -> None:
    times_s = times_at("250 Hz", 12.0)
    followed = follow(times_s, kind(times_s))
    for start_s in np.arange(0.0, 11.0, 1.0):
        slope_N, mixture_N = followed.rms_N(start_s, start_s + 1.0)
        assert mixture_N < 1.05 * slope_N + 0.003
    assert followed.trust.mean() < most_trust


def test_a_pulse_that_stops_is_held() -> None:
    times_s = times_at("250 Hz", 9.0)
    forces_N = pulse_N(times_s)
    stopped = int(np.argmax(np.where((times_s > 7.0) & (times_s < 8.0), forces_N, 0.0))) - 12  # on the steepest flank
    forces_N[stopped:] = forces_N[stopped]
    followed = follow(times_s, forces_N)
    errors_N = np.abs(followed.mixture_N).max(axis=1)
    stop_s = times_s[stopped]
    assert errors_N[(followed.time_s > stop_s) & (followed.time_s < stop_s + 0.15)].max() < 0.12
    assert errors_N[(followed.time_s > stop_s + 0.15) & (followed.time_s < 8.9)].max() < 0.01


def test_another_source_is_not_foreseen_from_the_first() -> None:
    times_s = times_at("250 Hz", 9.0)
    followed = follow(
        times_s, np.where(times_s < 7.0, pulse_N(times_s), 0.9 + 0.2 * np.sin(2.0 * math.pi * 2.3 * times_s))
    )
    assert followed.trust[np.searchsorted(followed.time_s, 6.99)] > 0.8
    slope_N, mixture_N = followed.rms_N(7.0, 7.5)
    assert mixture_N < 2.0 * slope_N
    assert followed.trust[(followed.time_s > 7.1) & (followed.time_s < 7.4)].max() < 0.3


def test_after_a_jump_nothing_is_forecast_and_trust_has_to_be_earned_again(learned: Forecast) -> None:
    trust, changes_N = learned.trust, learned.changes_N
    for tick in range(1, 8):
        tell(learned, 3.995 + 0.005 * tick, 0.8)
        assert learned.time_s < 4.0 or (learned.changes_N, learned.trust, learned.short) == ([], 0.0, LOST)
    assert learned.time_s > 4.02
    learned.changes_N = changes_N
    assert learned.trust < 0.03 < trust
    assert (LOST.score, LOST.apart) == (pytest.approx(-1.0, abs=0.03), pytest.approx(DOUBT_N**2))


@pytest.mark.parametrize(
    ("long", "short", "trust"),
    [(0.6, -0.5, 0.3), (0.6, 0.5, 0.6), (3.0, 0.0, 1.0), (-0.1, 0.0, 0.0), (0.6, -1.5, 0.0), (-0.6, -1.5, 0.0)],
)
def test_trust_is_the_product_of_two_scores_each_held_within_0_and_1(
    learned: Forecast, long: float, short: float, trust: float
) -> None:
    learned.long, learned.short = Skill(long, 1.0 - FORGIVEN_N**2), Skill(short, 1.0 - FORGIVEN_N**2)
    assert learned.trust == pytest.approx(trust)


@pytest.mark.parametrize(
    ("step_s", "is_anew"),
    [(MAX_STEP_S + 1e-6, True), (-1.1 * GRID_S, True), (-9.0, True), (MAX_STEP_S - 1e-6, False)],
)
def test_only_a_gap_or_a_stamp_from_before_begins_anew(learned: Forecast, step_s: float, is_anew: bool) -> None:
    fresh, stamp_s = Forecast(), learned.stamp_s + step_s
    for each in (fresh, learned):
        each.update(stamp_s, 1.5)
    assert (plain(fresh) == plain(learned)) is is_anew


def test_a_stamp_again_counts_once_with_its_newest_force(learned: Forecast) -> None:
    learned.update(learned.stamp_s, learned.force_N)
    assert plain(learned) == LEARNED
    history, stamp_s = learned.history, learned.stamp_s
    for back_s in (0.0, 0.003):
        learned.update(stamp_s - back_s, 1.7)
        assert (learned.history, learned.stamp_s, learned.force_N, learned.force_at_N(0.0, learned.from_N())) == (
            history,
            stamp_s,
            1.7,
            pytest.approx(1.7),
        )


def test_a_forecast_is_looked_for_once_for_every_few_points_of_the_grid(learned: Forecast) -> None:
    assert not learned.foresee(0.0)
    assert plain(learned) == LEARNED
    changes_N = learned.changes_N
    while learned.time_s - learned.from_s < (EVERY - 0.5) * GRID_S:
        assert not learned.foresee(0.0)
        learned.update(learned.time_s + 1.5 * GRID_S, 1.5)
    assert learned.changes_N == changes_N
    assert learned.foresee(0.0)
    assert learned.from_s == learned.time_s


def by_regression(history: Array) -> Array:
    """The constants of a weighted ridge regression, by NumPy's least squares."""
    delays = np.array(DELAYS)
    newest = len(history) - 1
    ends = np.arange(newest - HORIZON, DELAYS[-1] - 1, -STRIDE)[:, None]
    apart = history[ends - delays] - history[ends] - (history[newest - delays] - history[newest])
    followed = history[ends + np.arange(HORIZON + 1)] - history[ends]
    weight = (np.sum(apart**2, axis=1) + TAPS * SAME_N**2) ** -2
    ridge = RIDGE / TAPS * np.sum(weight[:, None] * apart**2) + SAME_N**2 * np.sum(weight)
    rows = np.sqrt(weight)[:, None] * np.column_stack([np.ones(len(ends)), apart])
    rows = np.vstack([rows, np.sqrt(ridge) * np.eye(TAPS + 1)[1:]])
    wanted = np.vstack([np.sqrt(weight)[:, None] * followed, np.zeros((TAPS, HORIZON + 1))])
    constants: Array = np.linalg.lstsq(rows, wanted)[0][0]
    return constants


@pytest.mark.parametrize("seconds", [1.6, 4.0, 12.0])
def test_a_forecast_is_a_weighted_ridge_regression(seconds: float) -> None:
    forecast = beaten(seconds)
    forecast.update(forecast.stamp_s + (EVERY + 0.5) * GRID_S, forecast.force_N + 0.004)
    assert forecast.foresee(0.0)
    assert forecast.changes_N == pytest.approx(by_regression(np.frombuffer(forecast.history)), abs=1e-9)


def test_a_guess_is_judged_over_a_long_time_and_a_short_one(learned: Forecast) -> None:
    learned.update(learned.stamp_s, 1.5)
    if learned.awaited[0] is None:
        learned.update(learned.time_s + 1.1 * GRID_S, 1.5)
    error_N, slope_error_N = (guessed_N - 1.5 for guessed_N in learned.awaited[0])
    long, short = learned.long, learned.short
    learned.update(learned.time_s + 1.1 * GRID_S, 1.5)
    for found, before, time_s in ((learned.long, long, LONG_S), (learned.short, short, SHORT_S)):
        after = before.after(error_N, slope_error_N, time_s)
        assert (found.gained, found.apart) == pytest.approx((after.gained, after.apart))
