"""The judgement of the sensor over an hour in one direction: what may be its zero's drift is not held against it."""

from collections.abc import Callable

from tormagd.control.believe.strength import DeviceFit
from tormagd.control.believe.sensor import UNJUDGED, judge
from tormagd.control.believe.sensor_zero import SensorZero, TARED_SD_N

DRIFT_N_S = 0.005 / 60.0
STEP_S = 0.1
MODEL_N = 1.52
"What the model says without memory of a device that makes 1 N, relaxed for an hour."
FIT = DeviceFit(0.66, 0.0, 1e-4, 0.0, 1e-4)


def doubted_after_s(zero_sd_N: Callable[[float], float]) -> float | None:
    """When a sensor that drifts down for an hour is doubted, by how well its zero is known to be."""
    sensor = UNJUDGED
    for step in range(round(3600.0 / STEP_S)):
        now_s = step * STEP_S
        reading_N = 1.03 - DRIFT_N_S * now_s + (0.001 if step % 2 else -0.001)
        sensor = judge(sensor, FIT, MODEL_N, 42.0, reading_N, STEP_S, 1.0, zero_sd_N(now_s))
        if sensor.is_doubted:
            return now_s
    return None


def test_a_drift_that_nothing_could_tell_is_no_reason_to_doubt() -> None:
    assert doubted_after_s(SensorZero(told_s=0.0).sd_N) is None


def test_the_same_of_a_sensor_whose_zero_was_just_told_is() -> None:
    assert doubted_after_s(lambda now_s: TARED_SD_N) is not None
