"""Whether the force sensor is believed: its readings against the model, with all that a believable device may differ.

Judged while friction is mobilised and the handle slides, where the model knows the force. Four things no believable
device does: it makes less than the weakest or more than the strongest of its kind; its force jumps away from what it
has shown; its offset goes beyond what an elastomer relaxes; or the reading stands still to the last digit.
"""

import math
from typing import NamedTuple

from tormagd.control.device_fit import LEAST_SCALE, MOST_SCALE, RELAXES, SURE, DeviceFit, observe

NOISE_N = 0.03
"What noise, and the model's own error, leave of a mean over FILTER_S."
FILTER_S = 0.01
JUMP_N = 0.15
"A device may depart so far from its fit of a moment ago: its hysteresis and its own friction at a creep do."
VISCOUS_N_S_MM = 6e-4
"And so much further for each mm/s that the handle goes at another speed than then,"
SHAPE = 0.25
"and for each newton that the model says more or less: Eq. 7 is flat where the gap is open, the power law is not."
LEAST_OFFSET_N, MOST_OFFSET_N = -0.12, 0.3
"""Of a believable device that has not relaxed: another field law than the model's looks like an offset of up to 0.2 N.
So a sensor that reads 0.3 N too much from the beginning may pass for such a device; it makes the brake press less."""
KEPT_S = 0.3
"How old the fit is that jumps are told from."
FROZEN_S = 0.1
"A sensor that measures a friction in motion shows its own noise, at 500 readings a second or more."
DOUBTED_S = 0.05
"Evidence for so long is doubt."
TRUSTED_AGAIN_S = 1.0
"A sensor that reads, for so long, what a device gives that is like most, is believed anew."
SLOW_S, SLOW_ERROR_N2_S = 5.0, 3e-4
"A fit that forgets slowly, and takes the model at its word, tells an offset from a scale best."
MEMORY_S = 900.0
"The slowest of the elastomer's time constants."


class Sensor(NamedTuple):
    """What judging remembers. `before` and `kept` are the device's fit of up to twice and once KEPT_S ago, and
    `before_at` and `kept_at` the model's force and the handle's rate then, N and mm/s."""

    is_doubted: bool = False
    evidence_s: float = 0.0
    doubted_s: float = 0.0
    "For how long it has been doubted while the handle slid."
    reading_N: float = math.nan
    still_s: float = 0.0
    measured_N: float = math.nan
    loaded_N: float = 0.0
    "Mean of the model's force over MEMORY_S, at least the present one since it began."
    before: DeviceFit = DeviceFit()
    kept: DeviceFit = DeviceFit()
    before_at: tuple[float, float] = (0.0, 0.0)
    kept_at: tuple[float, float] = (0.0, 0.0)
    kept_s: float = 0.0
    slow: DeviceFit = DeviceFit()


def judge(
    sensor: Sensor, fit: DeviceFit, model_N: float, rate_mm_s: float, reading_N: float, elapsed_s: float
) -> Sensor:
    """The judgement after one reading along the motion of a handle that slides at `rate_mm_s`, `elapsed_s` after the
    last, where the model says `model_N` and the device has shown itself to be `fit`. All are finite."""
    is_first = math.isnan(sensor.measured_N)
    measured_N = reading_N
    if not is_first:
        measured_N = sensor.measured_N + elapsed_s / (FILTER_S + elapsed_s) * (reading_N - sensor.measured_N)
    loaded_N = model_N
    if not is_first:
        loaded_N = sensor.loaded_N + elapsed_s / (MEMORY_S + elapsed_s) * (model_N - sensor.loaded_N)
    still_s = sensor.still_s + elapsed_s if reading_N == sensor.reading_N else 0.0
    slow, _ = observe(
        sensor.slow,
        model_N,
        reading_N,
        elapsed_s,
        adapts_in_s=SLOW_S,
        bounds=(LEAST_SCALE, MOST_SCALE),
        error_N2_s=SLOW_ERROR_N2_S,
    )
    is_strange = (
        still_s > FROZEN_S
        or not _least_N(model_N, loaded_N) <= measured_N <= _most_N(model_N, loaded_N)
        or abs(measured_N - sensor.before.force_N(model_N)) > _jump_N(sensor, model_N, rate_mm_s)
        or _is_beyond(slow, max(model_N, loaded_N))
    )
    if sensor.is_doubted:  # once doubted, it has to read what most devices do, not what one at the edge might
        new = DeviceFit()
        is_strange = still_s > FROZEN_S or abs(measured_N - new.force_N(model_N)) > new.deviation_N(model_N)
    return _judged(sensor, fit, (model_N, rate_mm_s), is_strange, elapsed_s)._replace(
        reading_N=reading_N, still_s=still_s, measured_N=measured_N, loaded_N=loaded_N, slow=slow
    )


def _judged(sensor: Sensor, fit: DeviceFit, at: tuple[float, float], is_strange: bool, elapsed_s: float) -> Sensor:
    if sensor.is_doubted:
        # as long without evidence as it takes to be trusted again
        evidence_s = 0.0 if is_strange else sensor.evidence_s + elapsed_s
        if evidence_s > TRUSTED_AGAIN_S:
            return Sensor()
        return sensor._replace(evidence_s=evidence_s, doubted_s=sensor.doubted_s + elapsed_s)
    evidence_s = max(sensor.evidence_s + (elapsed_s if is_strange else -elapsed_s), 0.0)
    if evidence_s > DOUBTED_S:
        return sensor._replace(is_doubted=True, evidence_s=0.0, doubted_s=0.0)
    kept_s = sensor.kept_s + elapsed_s
    if is_strange or kept_s < KEPT_S:
        return sensor._replace(evidence_s=evidence_s, kept_s=kept_s)
    return sensor._replace(
        evidence_s=evidence_s, before=sensor.kept, kept=fit, before_at=sensor.kept_at, kept_at=at, kept_s=0.0
    )


def _jump_N(sensor: Sensor, model_N: float, rate_mm_s: float) -> float:
    further_N = max(
        SHAPE * abs(model_N - then_N) + VISCOUS_N_S_MM * abs(rate_mm_s - then_mm_s)
        for then_N, then_mm_s in (sensor.before_at, sensor.kept_at)
    )
    return JUMP_N + SURE * sensor.before.deviation_N(model_N) + further_N


def _least_N(model_N: float, loaded_N: float) -> float:
    return LEAST_SCALE * (model_N - RELAXES[1] * max(model_N, loaded_N)) - NOISE_N


def _most_N(model_N: float, loaded_N: float) -> float:
    return MOST_SCALE * (model_N - RELAXES[0] * min(model_N, loaded_N)) + NOISE_N


def _is_beyond(fit: DeviceFit, loaded_N: float) -> bool:
    deviation_N = SURE * math.sqrt(max(fit.offset_variance_N2, 0.0))
    least_N = LEAST_OFFSET_N - RELAXES[1] * fit.scale * loaded_N
    return fit.offset_N + deviation_N < least_N or fit.offset_N - deviation_N > MOST_OFFSET_N
