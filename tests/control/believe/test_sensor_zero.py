"""The sensor's zero: half the sum of the signed forces at a reversal, and how its uncertainty grows."""

import math
from typing import Any

import numpy as np
import pytest

from tormagd.control.believe.sensor_zero import (
    LEVEL_S,
    MAX_SD_N,
    MAX_ZERO_N,
    TARED_VARIANCE_N2,
    UNKNOWN_SD_N,
    Level,
    SensorZero,
)
from tormagd.control.believe.strength import DeviceFit

PERIOD_S = 0.004


def heard(
    zero: SensorZero,
    now_s: float,
    direction: float,
    reading_N: float,
    model_N: float,
    rate_mm_s: float,
    fit: DeviceFit,
) -> None:
    zero.update(now_s, direction, reading_N, model_N, rate_mm_s, PERIOD_S, fit, learns=True, is_disputed=False)


def strokes(
    off_N: float,
    zero: SensorZero | None = None,
    *,
    is_tared: bool = True,
    number: int = 6,
    stroke_s: float = 0.5,
    rest_s: float = 0.2,
    scale: float = 1.0,
    from_s: float = 0.0,
    way: float = 0.0,
    model_N: tuple[float, float] = (1.5, 1.5),
    rate_mm_s: tuple[float, float] = (42.0, 42.0),
) -> tuple[SensorZero, float]:
    """After strokes to and fro on a device whose sensor is off by that, with noise; and when."""
    zero = zero or SensorZero()
    if not is_tared:
        zero.variance_N2 = MAX_SD_N**2
    random, now_s = np.random.default_rng(2), from_s
    for stroke in range(number):
        direction = -1.0 if stroke % 2 else 1.0
        force_N = model_N[stroke % 2]
        for noise_N in random.normal(0.0, 0.01, round(stroke_s / PERIOD_S)).tolist():
            now_s += PERIOD_S
            reading_N = scale * force_N * (1.0 + way * direction) + direction * off_N + noise_N
            heard(zero, now_s, direction, reading_N, force_N, rate_mm_s[stroke % 2], DeviceFit(scale, 0.0, 0.02**2))
        now_s += rest_s
    return zero, now_s


@pytest.mark.parametrize(
    ("off_N", "turns", "within_N", "most_sd_N"),
    [
        *(
            (off_N, {"number": 20, "scale": scale}, 0.015 + 0.1 * abs(off_N), math.sqrt(TARED_VARIANCE_N2))
            for off_N in (0.0, 0.05, -0.1, 0.3)
            for scale in (0.7, 1.0, 1.4)
        ),
        # one reversal is enough where the sensor is not taken for tared
        (0.3, {"number": 2, "is_tared": False}, 0.01, 0.03),
        (0.1, {"number": 2, "is_tared": False, "scale": 1.2, "model_N": (0.8, 1.9)}, 0.01, 0.03),
    ],
)
def test_reversals_tell_the_zero_whatever_the_device(
    off_N: float, turns: dict[str, Any], within_N: float, most_sd_N: float
) -> None:
    zero, now_s = strokes(off_N, **turns)
    force_N = turns.get("scale", 1.0) * turns.get("model_N", (1.5, 1.5))[1]
    assert zero.zero_N + zero.way * force_N == pytest.approx(off_N, abs=within_N)
    assert zero.sd_N(now_s) < most_sd_N


@pytest.mark.parametrize("way", [0.05, -0.03])
def test_a_friction_that_differs_by_the_way_is_no_zero_of_a_tared_sensor(way: float) -> None:
    zero, _ = strokes(0.0, way=way)
    assert zero.way == pytest.approx(way, abs=0.012)
    assert zero.zero_N + 1.5 * zero.way == pytest.approx(1.5 * way, abs=0.01)


def test_what_no_way_explains_is_a_zero() -> None:
    zero, _ = strokes(0.3, number=2)
    assert (zero.zero_N, zero.way) == (pytest.approx(0.3, abs=0.03), pytest.approx(0.0, abs=0.02))


def test_without_a_reversal_nothing_is_told_and_less_and_less_is_known() -> None:
    zero, now_s = strokes(0.1, number=1)
    assert zero.zero_N == 0.0
    assert zero.sd_N(now_s + 300.0) < UNKNOWN_SD_N < zero.sd_N(now_s + 700.0)
    assert zero.sd_N(1e9) == MAX_SD_N


@pytest.mark.parametrize("minutes", [10, 20, 40, 60])
def test_a_sensor_that_drifts_one_way_stays_within_what_is_believed(minutes: int) -> None:
    zero, now_s = strokes(0.0, number=1)
    assert zero.sd_N(now_s + 60.0 * minutes) >= 0.005 * minutes


def test_before_anything_is_heard_no_time_counts() -> None:
    assert SensorZero().sd_N(1e9) == math.sqrt(TARED_VARIANCE_N2)


@pytest.mark.parametrize("turn", [{"stroke_s": 0.5 * LEVEL_S}, {"off_N": MAX_ZERO_N + 0.1}])
def test_levels_that_say_nothing_are_not_compared(turn: dict[str, float]) -> None:
    zero, _ = strokes(**({"off_N": 0.2, "number": 2, "is_tared": False} | turn))  # type: ignore[arg-type]
    assert zero.zero_N == 0.0


def test_a_level_is_a_mean_that_forgets() -> None:
    level = Level(1.0, 2.0, 40.0, PERIOD_S, 0.0).heard(2.0, 4.0, 44.0, PERIOD_S, PERIOD_S)
    assert (level.reading_N, level.model_N, level.rate_mm_s) == pytest.approx((1.5, 3.0, 42.0))
    assert (level.heard_s, level.until_s) == (2.0 * PERIOD_S, PERIOD_S)
    old = Level(1.0, 2.0, 40.0, 100.0 * LEVEL_S, 0.0).heard(2.0, 2.0, 40.0, PERIOD_S, PERIOD_S)
    assert old.reading_N == pytest.approx(1.0 + PERIOD_S / LEVEL_S)


def test_a_level_takes_its_time() -> None:
    zero, now_s = strokes(0.3, is_tared=False, number=1)
    for reading in range(1, 50):
        heard(zero, now_s + reading * PERIOD_S, -1.0, 1.2, 1.5, 42.0, DeviceFit(1.0, 0.0, 0.02**2))
        assert (zero.zero_N > 0.2) is (reading * PERIOD_S > LEVEL_S)


@pytest.mark.parametrize("changes", [{"rate_mm_s": (42.0, 300.0)}, {"model_N": (0.6, 2.4)}, {"rest_s": 8.0}])
def test_after_another_speed_or_force_or_a_long_rest_less_is_known(changes: dict[str, object]) -> None:
    alike, other = (strokes(0.1, is_tared=False, number=2, **each)[0] for each in ({}, changes))
    assert other.variance_N2 > 1.3 * alike.variance_N2


def test_a_drift_is_followed() -> None:
    zero, now_s = SensorZero(), 0.0
    for _ in range(180):
        _, now_s = strokes(0.005 / 60.0 * now_s, zero, number=2, stroke_s=1.0, rest_s=9.0, from_s=now_s)
    assert zero.zero_N == pytest.approx(0.3, abs=0.02)
