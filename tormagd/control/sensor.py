"""Whether the force sensor is believed: its readings against the model, with all that a believable device may differ.

Judged while friction is mobilised and the handle slides, where the model knows the force. Four things no believable
device does: it makes less than the weakest or more than the strongest of its kind; its force jumps away from what it
has shown; its offset goes beyond what an elastomer relaxes; or the reading stands still to the last digit.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.device_fit import (
    LEAST_SCALE,
    MOST_SCALE,
    RELAXES_LEAST,
    RELAXES_MOST,
    SURE,
    UNSEEN,
    DeviceFit,
    observe,
)
from tormagd.control.sensor_zero import UNKNOWN_SD_N

NOISE_N: Final = 0.03
"What noise, and the model's own error, leave of a mean over FILTER_S."
FILTER_S: Final = 0.01
JUMP_N: Final = 0.15
"A device may depart so far from its fit of a moment ago: its hysteresis and its own friction at a creep do."
VISCOUS_N_S_MM: Final = 6e-4
"And so much further for each mm/s that the handle goes at another speed than then,"
SHAPE: Final = 0.25
"and for each newton that the model says more or less: Eq. 7 is flat where the gap is open, the power law is not."
LEAST_OFFSET_N: Final = -0.12
MOST_OFFSET_N: Final = 0.3
"""Of a believable device that has not relaxed: another field law than the model's looks like an offset of up to 0.2 N.
So a sensor that reads 0.3 N too much from the beginning may pass for such a device; it makes the brake press less."""
KEPT_S: Final = 0.3
"How old the fit is that jumps are told from."
FROZEN_S: Final = 0.1
"A sensor that measures a friction in motion shows its own noise, at 500 readings a second or more."
DOUBTED_S: Final = 0.05
"Evidence for so long is doubt."
TRUSTED_AGAIN_S: Final = 1.0
"A sensor that reads, for so long, what a device gives that is like most, is believed anew."
SLOW_S: Final = 5.0
SLOW_ERROR_N2_S: Final = 3e-4
"A fit that forgets slowly, and takes the model at its word, tells an offset from a scale best."
MEMORY_S: Final = 900.0
"The slowest of the elastomer's time constants."


@final
class Past(Value):
    """What was heard: the newest reading and for how long it has stood still, a mean over FILTER_S, the mean of the
    model's force over MEMORY_S, and the slow fit. `before` and `kept` are the device's own fit of up to twice and once
    KEPT_S ago, and `before_at` and `kept_at` the model's force and the handle's rate then, N and mm/s, and its way."""

    def __init__(
        self,
        reading_N: float,
        still_s: float,
        measured_N: float,
        loaded_N: float,
        slow: DeviceFit,
        before: DeviceFit = UNSEEN,
        before_at: tuple[float, float, float] = (0.0, 0.0, 0.0),
        kept: DeviceFit = UNSEEN,
        kept_at: tuple[float, float, float] = (0.0, 0.0, 0.0),
        kept_s: float = 0.0,
    ) -> None:
        self.reading_N: Final = reading_N
        self.still_s: Final = still_s
        self.measured_N: Final = measured_N
        self.loaded_N: Final = loaded_N
        self.slow: Final = slow
        self.before: Final = before
        self.before_at: Final = before_at
        self.kept: Final = kept
        self.kept_at: Final = kept_at
        self.kept_s: Final = kept_s


@final
class Sensor(Value):
    """The judgement: whether it is doubted, for how long of sliding, and since when there is, or is no, evidence."""

    def __init__(
        self, is_doubted: bool = False, doubted_s: float = 0.0, evidence_s: float = 0.0, past: Past | None = None
    ) -> None:
        self.is_doubted: Final = is_doubted
        self.doubted_s: Final = doubted_s
        self.evidence_s: Final = evidence_s
        self.past: Final = past


UNJUDGED: Final = Sensor()


def judge(
    sensor: Sensor,
    fit: DeviceFit,
    model_N: float,
    rate_mm_s: float,
    reading_N: float,
    elapsed_s: float,
    direction: float,
    zero_sd_N: float,
) -> Sensor:
    """The judgement after one reading along the motion of a handle that slides at `rate_mm_s`, `elapsed_s` after the
    last, where the model says `model_N` and the device has shown itself to be `fit`. It slides the way `direction`, 1
    or -1; the sensor's zero, which is off the reading, is known to within `zero_sd_N`. All are finite."""
    past = _heard(sensor.past, model_N, reading_N, elapsed_s)
    if sensor.is_doubted:
        # it has to read for long what most devices do, not what one at the edge might
        agrees = past.still_s <= FROZEN_S and abs(past.measured_N - UNSEEN.force_N(model_N)) <= UNSEEN.deviation_N(
            model_N
        )
        evidence_s = sensor.evidence_s + elapsed_s if agrees else 0.0
        return (
            UNJUDGED if evidence_s > TRUSTED_AGAIN_S else Sensor(True, sensor.doubted_s + elapsed_s, evidence_s, past)
        )
    is_strange = _is_strange(past, model_N, rate_mm_s, direction, zero_sd_N)
    evidence_s = max(sensor.evidence_s + (elapsed_s if is_strange else -elapsed_s), 0.0)
    if evidence_s > DOUBTED_S:
        return Sensor(True, past=past)
    if past.kept_s >= KEPT_S and not is_strange:
        past = past.replaced(
            before=past.kept, before_at=past.kept_at, kept=fit, kept_at=(model_N, rate_mm_s, direction), kept_s=0.0
        )
    return Sensor(False, 0.0, evidence_s, past)


def _heard(past: Past | None, model_N: float, reading_N: float, elapsed_s: float) -> Past:
    slow, _ = observe(
        UNSEEN if past is None else past.slow,
        model_N,
        reading_N,
        elapsed_s,
        adapts_in_s=SLOW_S,
        bounds=(LEAST_SCALE, MOST_SCALE),
        error_N2_s=SLOW_ERROR_N2_S,
    )
    if past is None:
        return Past(reading_N, 0.0, reading_N, model_N, slow)
    return Past(
        reading_N,
        past.still_s + elapsed_s if reading_N == past.reading_N else 0.0,
        past.measured_N + elapsed_s / (FILTER_S + elapsed_s) * (reading_N - past.measured_N),
        past.loaded_N + elapsed_s / (MEMORY_S + elapsed_s) * (model_N - past.loaded_N),
        slow,
        past.before,
        past.before_at,
        past.kept,
        past.kept_at,
        past.kept_s + elapsed_s,
    )


def _is_strange(past: Past, model_N: float, rate_mm_s: float, direction: float, zero_sd_N: float) -> bool:
    if past.still_s > FROZEN_S:
        return True
    # where nothing has told the zero for long, it may explain what no device does
    unknown_N = SURE * max(zero_sd_N - UNKNOWN_SD_N, 0.0)
    most_loaded_N, least_loaded_N = max(model_N, past.loaded_N), min(model_N, past.loaded_N)
    weakest_N = LEAST_SCALE * (model_N - RELAXES_MOST * most_loaded_N) - NOISE_N - unknown_N
    strongest_N = MOST_SCALE * (model_N - RELAXES_LEAST * least_loaded_N) + NOISE_N + unknown_N
    if not weakest_N <= past.measured_N <= strongest_N:
        return True
    (before_N, before_mm_s, before_way), (kept_N, kept_mm_s, _) = past.before_at, past.kept_at
    # a zero that is wrong is the fit's as well, but for the other way; and in time it drifts from both
    is_turned = before_way * direction < 0.0
    zero_N = SURE * zero_sd_N * (2.0 if is_turned else 1.0 if zero_sd_N > UNKNOWN_SD_N else 0.0)
    jump_N = (
        JUMP_N
        + zero_N
        + SURE * past.before.deviation_N(model_N)
        + SHAPE * max(abs(model_N - before_N), abs(model_N - kept_N))
        + VISCOUS_N_S_MM * max(abs(rate_mm_s - before_mm_s), abs(rate_mm_s - kept_mm_s))
    )
    if abs(past.measured_N - past.before.force_N(model_N)) > jump_N:
        return True
    slow = past.slow
    unsure_N = SURE * math.sqrt(slow.offset_variance_N2) + unknown_N
    least_N = LEAST_OFFSET_N - RELAXES_MOST * slow.scale * most_loaded_N
    return slow.offset_N + unsure_N < least_N or slow.offset_N - unsure_N > MOST_OFFSET_N
