"""The force sensor's zero z, its reading without a force, which drifts.

    reversal   z' = d (F1 - F0 - s (m1 - m0)) / 2     F0, F1 readings along the motion before and after the handle
                                                      turned to direction d, m0, m1 the model's forces, s the scale
    update     Kalman filter of z with the error of that half sum; between reversals its variance grows

Friction reverses with the handle and a zero does not. Between reversals nothing separates the zero from the device.
From readings that an uncertain zero may explain, nothing is learned.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.believe.strength import SURE, DeviceFit

TARED_VARIANCE_N2: Final = 0.02 * 0.02
"Variance of a sensor that begins: it is taken for tared."
WANDERS_S: Final = 600.0
DRIFT_N2_S: Final = 0.05**2 / WANDERS_S
"5 mN a minute (plant card). For WANDERS_S the zero may wander to and fro; in an hour it may have gone one way."
MAX_SD_N: Final = 0.3
"Greatest deviation of the zero, however long nothing was heard."
UNKNOWN_SD_N: Final = 0.05
"With more than this, and than the scene tolerates, few readings teach: eight minutes without a reversal."
WAY_VARIANCE: Final = 0.04 * 0.04
"Spread of the share by which friction differs from its mean one way and the other, squared."
MAX_WAY: Final = 0.06
MAX_ZERO_N: Final = 0.4
"A zero further off is not taken: no sensor drifts so far."
LEVEL_S: Final = 0.15
"A level is a mean over this much sliding, in which noise leaves 2 mN."
READ_SD_N: Final = 0.025
"What gap, field and speed that change around a reversal leave of the half sum."
VISCOUS_N_S_MM: Final = 5e-4
"The half sum is off by so much for each mm/s of speed changed: devices' viscous friction differs by that."
RELAXES_N_S: Final = 0.01
"The half sum is off by so much for each second between the levels: the elastomer relaxes."


@final
class Level(Value):
    """Means over a handle's newest sliding one way: reading along the motion, model's force, and rate without sign."""

    def __init__(self, reading_N: float, model_N: float, rate_mm_s: float, heard_s: float, until_s: float) -> None:
        self.reading_N: Final = reading_N
        self.model_N: Final = model_N
        self.rate_mm_s: Final = rate_mm_s
        self.heard_s: Final = heard_s
        self.until_s: Final = until_s

    def heard(self, reading_N: float, model_N: float, rate_mm_s: float, dt_s: float, now_s: float) -> "Level":
        """Return the level with one more reading, which stands for `dt_s` > 0 and came at `now_s`."""
        heard_s = self.heard_s + dt_s
        share = dt_s / min(heard_s, max(LEVEL_S, dt_s))
        return Level(
            self.reading_N + share * (reading_N - self.reading_N),
            self.model_N + share * (model_N - self.model_N),
            self.rate_mm_s + share * (rate_mm_s - self.rate_mm_s),
            heard_s,
            now_s,
        )


UNHEARD: Final = Level(0.0, 0.0, 0.0, 0.0, 0.0)
"Before the first reading."


@final
class SensorZero:
    """Estimator of one sensor's zero, `zero_N`, with its variance."""

    zero_N: float = 0.0
    "What the sensor reads without a force."
    variance_N2: float = TARED_VARIANCE_N2
    "Variance of the zero at `told_s`."
    way: float = 0.0
    "By which share friction is greater one way, and less the other."
    way_variance: float = WAY_VARIANCE
    told_s: float = math.inf
    "When the variance was told: at the first reading, or the newest reversal; inf before."
    direction: float = 0.0
    "The way the handle goes, 1 or -1; 0 before the first reading."
    level: Level = UNHEARD
    "Level of the present way."
    before: Level | None = None
    "Level of the way before, until the two have been compared; None without one."

    def sd_N(self, now_s: float) -> float:
        """Return the zero's standard deviation at `now_s`, N, at most MAX_SD_N."""
        since_s = max(now_s - self.told_s, 0.0)
        drifted_N2 = DRIFT_N2_S * since_s * max(since_s / WANDERS_S, 1.0)
        return math.sqrt(min(self.variance_N2 + drifted_N2, MAX_SD_N * MAX_SD_N))

    def update(
        self,
        now_s: float,
        direction: float,
        reading_N: float,
        model_N: float,
        rate_mm_s: float,
        dt_s: float,
        fit: DeviceFit,
        *,
        learns: bool,
        is_disputed: bool,
    ) -> float:
        """Take one reading, and return by how much those of the way before the first reversal were too small."""
        self.told_s = min(self.told_s, now_s)
        if direction != self.direction:
            # a mean over too short a time is no level
            self.before = self.level if self.level.heard_s >= LEVEL_S else None
            self.level, self.direction = UNHEARD, direction
        began_s, before = now_s - self.level.heard_s, self.before
        level = self.level = self.level.heard(reading_N, model_N, rate_mm_s, dt_s, now_s)
        if before is None or level.heard_s < LEVEL_S or not learns:
            return 0.0
        self.before = None
        return self._compare(now_s, before, level, began_s - before.until_s, fit, is_disputed)

    def _compare(
        self, now_s: float, before: Level, level: Level, between_s: float, fit: DeviceFit, is_disputed: bool
    ) -> float:
        """Learn zero and way from the levels before and after a reversal."""
        by_model_N = level.model_N - before.model_N
        found_N = 0.5 * self.direction * (level.reading_N - before.reading_N - fit.scale * by_model_N)
        if abs(found_N) > MAX_ZERO_N:
            return 0.0
        read_sd_N = math.hypot(
            READ_SD_N,
            0.5 * fit.scale_sd * by_model_N,
            0.5 * VISCOUS_N_S_MM * (level.rate_mm_s - before.rate_mm_s),
            0.5 * RELAXES_N_S * between_s,
        )
        # at one force a friction that differs by the way looks like a zero
        force_N, zero_N2 = 0.5 * fit.scale * (level.model_N + before.model_N), self.sd_N(now_s) ** 2
        error_N, way_N2 = found_N - self.zero_N - force_N * self.way, force_N * force_N * self.way_variance
        if error_N * error_N > SURE * SURE * (zero_N2 + way_N2 + read_sd_N**2):
            zero_N2 = MAX_SD_N * MAX_SD_N  # neither a drift nor a way explains it
        known_N2 = zero_N2 + read_sd_N**2
        share = error_N / (known_N2 + way_N2)
        is_first = self.way_variance == WAY_VARIANCE and not is_disputed
        self.zero_N += zero_N2 * share
        self.way = min(max(self.way + force_N * self.way_variance * share, -MAX_WAY), MAX_WAY)
        # halved: a way stays, and what drifts afterwards is the zero
        self.way_variance *= 0.5 * known_N2 / (known_N2 + way_N2)
        self.variance_N2, self.told_s = zero_N2 * read_sd_N**2 / known_N2, now_s
        return self.direction * share * (zero_N2 + way_N2) if is_first else 0.0
