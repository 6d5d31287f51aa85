"""The sensor's zero: half the sum of the signed forces at a reversal, and what is not known of it between."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.control.believe.sensor_zero import (
    LEVEL_S,
    LONGEST_TURN_S,
    MAX_SD_N,
    MAX_ZERO_N,
    TARED_SD_N,
    UNKNOWN_SD_N,
    SensorZero,
)

PERIOD_S = 0.004


@pytest.fixture
def zero() -> SensorZero:
    """Of a sensor that is taken for tared."""
    return SensorZero()


@pytest.fixture
def doubted() -> SensorZero:
    """Of one that is not."""
    zero = SensorZero()
    zero.doubt()
    return zero


def strokes(
    zero: SensorZero,
    off_N: float,
    *,
    number: int = 6,
    stroke_s: float = 0.5,
    rest_s: float = 0.2,
    scale: float = 1.0,
    from_s: float = 0.0,
    model_N: tuple[float, float] = (1.5, 1.5),
) -> float:
    """Strokes to and fro of a handle on a device whose sensor is off by that, with noise; until when."""
    random, now_s = np.random.default_rng(2), from_s
    for stroke in range(number):
        direction = -1.0 if stroke % 2 else 1.0
        force_N = model_N[stroke % 2]
        for noise_N in random.normal(0.0, 0.01, round(stroke_s / PERIOD_S)).tolist():
            now_s += PERIOD_S
            reading_N = scale * force_N + direction * off_N + noise_N
            zero.begin(now_s)
            zero.update(now_s, direction, reading_N, force_N, 42.0, PERIOD_S, scale, 0.02)
        now_s += rest_s
    return now_s


@pytest.mark.parametrize("off_N", [0.0, 0.05, -0.1, 0.3])
@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
def test_a_few_reversals_tell_the_zero_whatever_the_device(zero: SensorZero, off_N: float, scale: float) -> None:
    now_s = strokes(zero, off_N, number=20, scale=scale)
    assert zero.zero_N == pytest.approx(off_N, abs=0.015 + 0.1 * abs(off_N))
    assert zero.sd_N(now_s) < TARED_SD_N


def test_one_reversal_is_enough_where_the_sensor_is_not_taken_for_tared(doubted: SensorZero) -> None:
    now_s = strokes(doubted, 0.3, number=2)
    assert doubted.zero_N == pytest.approx(0.3, abs=0.01)
    assert doubted.sd_N(now_s) < 0.03


def test_the_force_may_be_another_after_the_reversal(doubted: SensorZero) -> None:
    strokes(doubted, 0.1, number=2, scale=1.2, model_N=(0.8, 1.9))
    assert doubted.zero_N == pytest.approx(0.1, abs=0.01)


def test_without_a_reversal_nothing_is_told_and_less_and_less_is_known(zero: SensorZero) -> None:
    now_s = strokes(zero, 0.1, number=1)
    assert zero.zero_N == 0.0
    assert zero.sd_N(now_s + 300.0) < UNKNOWN_SD_N < zero.sd_N(now_s + 700.0)
    assert zero.sd_N(1e9) == MAX_SD_N


@pytest.mark.parametrize("minutes", [10, 20, 40, 60])
def test_a_sensor_that_drifts_one_way_stays_within_what_is_believed(zero: SensorZero, minutes: int) -> None:
    now_s = strokes(zero, 0.0, number=1)
    assert zero.sd_N(now_s + 60.0 * minutes) >= 0.005 * minutes


def test_before_anything_is_heard_no_time_counts(zero: SensorZero) -> None:
    assert zero.sd_N(1e9) == TARED_SD_N


@pytest.mark.parametrize(
    "turn", [{"rest_s": LONGEST_TURN_S + 0.1}, {"stroke_s": 0.5 * LEVEL_S}, {"off_N": MAX_ZERO_N + 0.1}]
)
def test_levels_that_say_nothing_are_not_compared(doubted: SensorZero, turn: dict[str, float]) -> None:
    """Too far apart, too short, or of a sensor that is broken rather than off its zero."""
    strokes(doubted, **({"off_N": 0.2, "number": 2} | turn))  # type: ignore[arg-type]
    assert doubted.zero_N == 0.0


def test_a_drift_is_followed(zero: SensorZero) -> None:
    """5 mN a minute for an hour, turning every 10 s."""
    now_s = 0.0
    for _ in range(180):
        now_s = strokes(zero, 0.005 / 60.0 * now_s, number=2, stroke_s=1.0, rest_s=9.0, from_s=now_s)
    assert zero.zero_N == pytest.approx(0.3, abs=0.02)


readings = st.tuples(
    st.floats(0.0, 30.0), st.sampled_from([-1.0, 1.0]), st.floats(-33.0, 33.0), st.floats(0.0, 8.0), st.floats(0, 300)
)


@given(history=st.lists(readings, max_size=80))
def test_no_history_makes_it_impossible(history: list[tuple[float, float, float, float, float]]) -> None:
    zero, now_s = SensorZero(), 0.0
    for gone_s, direction, reading_N, model_N, rate_mm_s in history:
        now_s += gone_s + PERIOD_S
        zero.begin(now_s)
        zero.update(now_s, direction, reading_N, model_N, rate_mm_s, min(gone_s + PERIOD_S, 0.02), 1.0, 0.17)
        assert abs(zero.zero_N) <= MAX_ZERO_N
        assert 0.0 < zero.variance_N2 <= MAX_SD_N**2
        assert math.isfinite(zero.sd_N(now_s + 1.0))
