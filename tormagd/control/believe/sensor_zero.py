"""What the force sensor reads where there is no force: its zero z, which drifts.

    reversal   z' = d (F1 - F0 - s (m1 - m0)) / 2     F0, F1 readings along the motion before and after the handle
                                                      turned to direction d, m0, m1 the model's forces, s the scale
    update     Kalman filter of z with the error of that half sum; between reversals its variance grows

Friction turns round with the handle and a zero does not. Between reversals nothing tells the zero from the device
itself: where it is too uncertain, nothing may be learned from readings.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value

TARED_SD_N: Final = 0.02
TARED_VARIANCE_N2: Final = TARED_SD_N * TARED_SD_N
"Of a sensor that begins: it is taken for tared."
WANDERS_S: Final = 600.0
DRIFT_N2_S: Final = 0.05**2 / WANDERS_S
"""A sensor that drifts by 5 mN a minute is off by 50 mN after ten (plant card). For so long it may wander to and fro;
in an hour it may have gone one way."""
MAX_SD_N: Final = 0.3
"An hour of that. However long nothing was heard, no more is believed possible."
UNKNOWN_SD_N: Final = 0.05
"With more than this a force is better left to what was learned before: ten minutes without a reversal."
MAX_ZERO_N: Final = 0.4
"A sensor that is further off did not drift, it is broken, or was never tared: that is no zero to go on with."
LEVEL_S: Final = 0.15
"A level is a mean over this much sliding, in which noise leaves 2 mN."
READ_SD_N: Final = 0.025
"What gap, field and speed that change around a reversal leave of half the sum."
VISCOUS_N_S_MM: Final = 5e-4
"And so much more for each mm/s that the handle comes back at another speed: devices' viscous friction differs by that."
RELAXES_N_S: Final = 0.01
"And so much more for each second that lies between: the elastomer relaxes."
LONGEST_TURN_S: Final = 10.0
"Levels further apart are not compared."


@final
class Level(Value):
    """Means over the newest sliding one way: of the readings along the motion, of the model's force there, N, and of
    the handle's rate, mm/s, over `heard_s`, the last of it at `until_s`."""

    def __init__(self, reading_N: float, model_N: float, rate_mm_s: float, heard_s: float, until_s: float) -> None:
        self.reading_N: Final = reading_N
        self.model_N: Final = model_N
        self.rate_mm_s: Final = rate_mm_s
        self.heard_s: Final = heard_s
        self.until_s: Final = until_s

    def heard(self, reading_N: float, model_N: float, rate_mm_s: float, dt_s: float, now_s: float) -> "Level":
        """After one more reading, which stands for `dt_s` > 0: a plain mean at first, then one that forgets."""
        heard_s = self.heard_s + dt_s
        share = dt_s / min(heard_s, max(LEVEL_S, dt_s))
        return Level(
            self.reading_N + share * (reading_N - self.reading_N),
            self.model_N + share * (model_N - self.model_N),
            self.rate_mm_s + share * (rate_mm_s - self.rate_mm_s),
            heard_s,
            now_s,
        )


@final
class SensorZero:
    """Estimates the zero of one sensor."""

    zero_N: float = 0.0
    variance_N2: float = TARED_VARIANCE_N2
    undoubted_N2: float = TARED_VARIANCE_N2
    "What it was before the zero was doubted."
    told_s: float = math.inf
    "When the variance was that."
    direction: float = 0.0
    "The way the handle goes, 1 or -1."
    level: Level | None = None
    "Of that way."
    before: Level | None = None
    "Of the way before, until the two have been compared."

    def sd_N(self, now_s: float) -> float:
        """Standard deviation of the zero by now; before the first reading no time counts."""
        since_s = max(now_s - self.told_s, 0.0)
        drifted_N2 = DRIFT_N2_S * since_s * max(since_s / WANDERS_S, 1.0)
        return math.sqrt(min(self.variance_N2 + drifted_N2, MAX_SD_N * MAX_SD_N))

    def begin(self, now_s: float) -> None:
        """Says that there is a reading: from the first one on the zero's variance grows."""
        self.told_s = min(self.told_s, now_s)

    def doubt(self) -> None:
        """The zero may be any: the next reversal tells it."""
        self.undoubted_N2, self.variance_N2 = self.variance_N2, MAX_SD_N * MAX_SD_N

    def trust(self) -> None:
        """The readings show that it is the one it was."""
        self.variance_N2 = min(self.variance_N2, self.undoubted_N2)

    def update(
        self,
        now_s: float,
        direction: float,
        reading_N: float,
        model_N: float,
        rate_mm_s: float,
        dt_s: float,
        scale: float,
        scale_sd: float,
    ) -> bool:
        """Takes a reading along `direction` of a handle that slides at `rate_mm_s`, where the model says `model_N`. It
        stands for `dt_s` > 0; the device's scale is known to within `scale_sd`. All are finite. The result tells
        whether a reversal has told the zero just now."""
        level = self.level
        if level is None or direction != self.direction:
            # what was heard for too short a time is no level
            self.before = level if level is not None and level.heard_s >= LEVEL_S else None
            self.level, self.direction = Level(reading_N, model_N, rate_mm_s, dt_s, now_s), direction
            return False
        began_s = now_s - level.heard_s
        level = self.level = level.heard(reading_N, model_N, rate_mm_s, dt_s, now_s)
        if self.before is None or level.heard_s < LEVEL_S:
            return False
        before, self.before = self.before, None
        return self._compare(now_s, before, level, began_s - before.until_s, scale, scale_sd)

    def _compare(
        self, now_s: float, before: Level, level: Level, between_s: float, scale: float, scale_sd: float
    ) -> bool:
        """Learns from the levels before and after a reversal, which took `between_s`, and says whether it could."""
        by_model_N = level.model_N - before.model_N
        found_N = 0.5 * self.direction * (level.reading_N - before.reading_N - scale * by_model_N)
        if between_s > LONGEST_TURN_S or abs(found_N) > MAX_ZERO_N:
            return False
        by_scale_N = 0.5 * scale_sd * by_model_N
        by_speed_N = 0.5 * VISCOUS_N_S_MM * (level.rate_mm_s - before.rate_mm_s)
        by_time_N = 0.5 * RELAXES_N_S * between_s
        read_N2 = READ_SD_N * READ_SD_N + by_scale_N * by_scale_N + by_speed_N * by_speed_N + by_time_N * by_time_N
        variance_N2 = self.sd_N(now_s) ** 2
        gain = variance_N2 / (variance_N2 + read_N2)
        self.zero_N += gain * (found_N - self.zero_N)
        self.variance_N2, self.told_s = (1.0 - gain) * variance_N2, now_s
        return True
