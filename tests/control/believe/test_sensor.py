"""The judgement of the sensor: what no believable device gives, and what one may, for an hour one way as well."""

from collections.abc import Callable

import numpy as np
import pytest

from tormagd.control.believe.sensor import DOUBTED_S, FROZEN_S, KEPT_S, TRUSTED_AGAIN_S, SensorTrust
from tormagd.control.believe.sensor_zero import TARED_SD_N, SensorZero
from tormagd.control.believe.strength import MAX_RELAXED, MAX_SCALE, MIN_RELAXED, MIN_SCALE, DeviceFit, Strength

DRIFT_N_S = 0.005 / 60.0
STEP_S = 0.1
MODEL_N = 1.52
"What the model says without memory of a device that makes 1 N, relaxed for an hour."
FIT = DeviceFit(0.66, 0.0, 1e-4, 0.0, 1e-4)
PERIOD_S = 0.004


def doubted_after_s(zero_sd_N: Callable[[float], float]) -> float | None:
    """When a sensor that drifts down for an hour is doubted, by how well its zero is known to be."""
    sensor = SensorTrust()
    for step in range(round(3600.0 / STEP_S)):
        now_s = step * STEP_S
        reading_N = 1.03 - DRIFT_N_S * now_s + (0.001 if step % 2 else -0.001)
        sensor.update(FIT, MODEL_N, 42.0, reading_N, STEP_S, 1.0, zero_sd_N(now_s))
        if sensor.is_doubted:
            return now_s
    return None


def test_a_drift_that_nothing_could_tell_is_no_reason_to_doubt() -> None:
    zero = SensorZero()
    zero.begin(0.0)
    assert doubted_after_s(zero.sd_N) is None


def test_the_same_of_a_sensor_whose_zero_was_just_told_is() -> None:
    assert doubted_after_s(lambda now_s: TARED_SD_N) is not None


def heard(
    sensor: SensorTrust,
    seconds: float,
    share: float,
    noise_N: float = 0.003,
    at: tuple[float, float, float] = (1.5, 42.0, 1.0),
) -> SensorTrust:
    """After so long of readings that are so much of the model's force, of a device that is being learned, `at` that
    force of the model, rate and direction."""
    (model_N, rate_mm_s, direction), device = at, Strength(0.5, (MIN_SCALE, MAX_SCALE), (True, True))
    for off_N in np.random.default_rng(3).normal(0.0, noise_N, round(seconds / PERIOD_S)).tolist():
        reading_N = share * model_N + off_N
        sensor.update(device.fit, model_N, rate_mm_s, reading_N, PERIOD_S, direction, TARED_SD_N)
        device.update(model_N, reading_N, PERIOD_S)
    return sensor


@pytest.mark.parametrize(("share", "noise_N"), [(0.4, 0.003), (1.6, 0.003), (-1.0, 0.003), (1.0, 0.0)])
def test_what_no_device_gives_is_doubted_and_the_truth_believed_again(share: float, noise_N: float) -> None:
    """Less than the weakest, more than the strongest, the wrong way, and to the last digit the same."""
    sensor = SensorTrust()
    assert not heard(sensor, 0.6 * DOUBTED_S, share, noise_N).is_doubted
    assert heard(sensor, DOUBTED_S + FROZEN_S, share, noise_N).is_doubted
    assert heard(sensor, 10.0, share, noise_N).doubted_s > 9.9
    assert heard(sensor, 0.9 * TRUSTED_AGAIN_S, 1.0).is_doubted
    assert not heard(sensor, 0.2 * TRUSTED_AGAIN_S, 1.0).is_doubted


@pytest.mark.parametrize("share", [(1.0 - MAX_RELAXED) * MIN_SCALE, MIN_SCALE, 1.0, (1.0 - MIN_RELAXED) * MAX_SCALE])
def test_what_a_believable_device_gives_is_not_doubted(share: float) -> None:
    assert not heard(SensorTrust(), 20.0, share, 0.01).is_doubted


@pytest.mark.parametrize(
    ("leap_N", "at", "is_doubted"),
    [
        (0.08, (1.5, 42.0, 1.0), False),
        (-0.08, (1.5, 42.0, 1.0), False),
        (0.25, (1.5, 42.0, 1.0), True),
        (-0.25, (1.5, 42.0, 1.0), True),
        (-0.25, (1.5, 42.0, -1.0), False),
        (-0.25, (1.5, 300.0, 1.0), False),
        (-0.25, (1.1, 42.0, 1.0), False),
    ],
)
def test_a_force_that_leaps_from_what_the_device_showed_is_doubted(
    leap_N: float, at: tuple[float, float, float], is_doubted: bool
) -> None:
    """Further where the handle has turned, goes faster, or the gap is another."""
    sensor = heard(SensorTrust(), 3.0 * KEPT_S, 1.0)
    assert heard(sensor, 0.2, 1.0 + leap_N / at[0], at=at).is_doubted is is_doubted
