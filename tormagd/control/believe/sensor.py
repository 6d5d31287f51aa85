"""Whether the force sensor is believed: its readings against the model, with all that a believable device may differ.

Judged while friction is mobilised and the handle slides, where the model knows the force. Four things no believable
device does: it makes less than the weakest or more than the strongest of its kind; its force jumps away from what it
has shown; its offset goes beyond what an elastomer relaxes; or the reading stands still to the last digit.
"""

import math
from typing import Final, final

from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N
from tormagd.control.believe.strength import (
    MAX_RELAXED,
    MAX_SCALE,
    MIN_RELAXED,
    MIN_SCALE,
    SURE,
    UNSEEN,
    DeviceFit,
    observe,
)
from tormagd.control.filter import low_pass

NOISE_N: Final = 0.03
"What noise, and the model's own error, leave of a mean over FILTER_S."
FILTER_S: Final = 0.01
JUMP_N: Final = 0.15
"A device may depart so far from its fit of a moment ago: its hysteresis and its own friction at a creep do."
VISCOUS_N_S_MM: Final = 6e-4
"And so much further for each mm/s that the handle goes at another speed than then,"
SHAPE: Final = 0.25
"and for each newton that the model says more or less: Eq. 7 is flat where the gap is open, the power law is not."
MIN_OFFSET_N: Final = -0.12
MAX_OFFSET_N: Final = 0.3
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
"A fit that forgets slowly, and takes the model at its word, tells an offset from a scale best."
MEMORY_S: Final = 900.0
"The slowest of the elastomer's time constants."


At = tuple[float, float, float]
"Where a fit was taken: the model's force, N, the handle's rate, mm/s, and its direction, 1 or -1."


@final
class SensorTrust:
    """Judges one force sensor."""

    is_doubted: bool = False
    doubted_s: float = 0.0
    "For how long of sliding it has been doubted."
    evidence_s: float = 0.0
    "For how long there has been evidence: of a lie, or while it is doubted of the truth."
    has_heard: bool = False
    reading_N: float = 0.0
    "The newest."
    still_s: float = 0.0
    "For how long it has stood still to the last digit."
    measured_N: float = 0.0
    "A mean over FILTER_S."
    loaded_N: float = 0.0
    "The model's force, a mean over MEMORY_S."
    slow: DeviceFit = UNSEEN
    "A fit of the readings that forgets in SLOW_S."
    before: DeviceFit = UNSEEN
    "The device's own fit of KEPT_S to twice that ago,"
    kept: DeviceFit = UNSEEN
    "and of up to KEPT_S ago."
    kept_s: float = 0.0

    def __init__(self) -> None:
        self.before_at: At = (0.0, 0.0, 0.0)
        self.kept_at: At = (0.0, 0.0, 0.0)

    def update(
        self,
        fit: DeviceFit,
        model_N: float,
        rate_mm_s: float,
        reading_N: float,
        dt_s: float,
        direction: float,
        zero_sd_N: float,
    ) -> None:
        """Takes a reading along the motion of a handle that slides at `rate_mm_s` the way `direction`, 1 or -1, where
        the model says `model_N` and the device has shown itself to be `fit`. The reading stands for `dt_s`; the zero
        that is off it is known to within `zero_sd_N`. All are finite."""
        self._hear(model_N, reading_N, dt_s)
        if self.is_doubted:
            self._hope(model_N, dt_s)
            return
        is_strange = self._is_strange(model_N, rate_mm_s, direction, zero_sd_N)
        self.evidence_s = max(self.evidence_s + (dt_s if is_strange else -dt_s), 0.0)
        if self.evidence_s > DOUBTED_S:
            self.is_doubted, self.doubted_s, self.evidence_s = True, 0.0, 0.0
        elif self.kept_s >= KEPT_S and not is_strange:
            self.before, self.before_at = self.kept, self.kept_at
            self.kept, self.kept_at, self.kept_s = fit, (model_N, rate_mm_s, direction), 0.0

    def _hear(self, model_N: float, reading_N: float, dt_s: float) -> None:
        if not self.has_heard:
            self.has_heard, self.still_s, self.kept_s = True, 0.0, 0.0
            self.measured_N, self.loaded_N, self.slow = reading_N, model_N, UNSEEN
            self.before = self.kept = UNSEEN
            self.before_at = self.kept_at = (0.0, 0.0, 0.0)
        else:
            self.still_s = self.still_s + dt_s if reading_N == self.reading_N else 0.0
            self.measured_N = low_pass(self.measured_N, reading_N, dt_s, FILTER_S)
            self.loaded_N = low_pass(self.loaded_N, model_N, dt_s, MEMORY_S)
            self.kept_s += dt_s
        self.reading_N = reading_N
        self.slow, _ = observe(self.slow, model_N, reading_N, dt_s, adapts_in_s=SLOW_S, bounds=(MIN_SCALE, MAX_SCALE))

    def _hope(self, model_N: float, dt_s: float) -> None:
        """A doubted sensor has to read for long what most devices do, not what one at the edge might."""
        misses_N = abs(self.measured_N - UNSEEN.force_N(model_N))
        agrees = self.still_s <= FROZEN_S and misses_N <= UNSEEN.deviation_N(model_N)
        self.evidence_s = self.evidence_s + dt_s if agrees else 0.0
        self.doubted_s += dt_s
        if self.evidence_s > TRUSTED_AGAIN_S:
            self.is_doubted, self.doubted_s, self.evidence_s, self.has_heard = False, 0.0, 0.0, False

    def _is_strange(self, model_N: float, rate_mm_s: float, direction: float, zero_sd_N: float) -> bool:
        """Whether the newest readings are such as no believable device gives."""
        if self.still_s > FROZEN_S:
            return True
        # where nothing has told the zero for long, it may explain what no device does
        unknown_N = SURE * max(zero_sd_N - UNKNOWN_SD_N, 0.0)
        max_loaded_N, min_loaded_N = max(model_N, self.loaded_N), min(model_N, self.loaded_N)
        weakest_N = MIN_SCALE * (model_N - MAX_RELAXED * max_loaded_N) - NOISE_N - unknown_N
        strongest_N = MAX_SCALE * (model_N - MIN_RELAXED * min_loaded_N) + NOISE_N + unknown_N
        if not weakest_N <= self.measured_N <= strongest_N:
            return True
        if abs(self.measured_N - self.before.force_N(model_N)) > self._jump_N(model_N, rate_mm_s, direction, zero_sd_N):
            return True
        slow = self.slow
        unsure_N = SURE * math.sqrt(slow.offset_variance_N2) + unknown_N
        min_N = MIN_OFFSET_N - MAX_RELAXED * slow.scale * max_loaded_N
        return slow.offset_N + unsure_N < min_N or slow.offset_N - unsure_N > MAX_OFFSET_N

    def _jump_N(self, model_N: float, rate_mm_s: float, direction: float, zero_sd_N: float) -> float:
        """How far a device may depart from its fit of a moment ago."""
        (before_N, before_mm_s, before_way), (kept_N, kept_mm_s, _) = self.before_at, self.kept_at
        # a zero that is wrong is the fit's as well, but for the other way; and in time it drifts from both
        is_turned = before_way * direction < 0.0
        zero_N = SURE * zero_sd_N * (2.0 if is_turned else 1.0 if zero_sd_N > UNKNOWN_SD_N else 0.0)
        return (
            JUMP_N
            + zero_N
            + SURE * self.before.deviation_N(model_N)
            + SHAPE * max(abs(model_N - before_N), abs(model_N - kept_N))
            + VISCOUS_N_S_MM * max(abs(rate_mm_s - before_mm_s), abs(rate_mm_s - kept_mm_s))
        )
