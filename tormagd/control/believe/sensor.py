"""Leash of the fit: how far the readings of the force sensor may lead what is believed of a device.

    anchor   a    what the device first showed, at each force until it is known there
    share    h    of the anchor to which the fit may fall: (1 - leash) to 1; it rises with the fit, and falls slowly
    low           h a - SLACK_N: lesser readings count as this
    outside       readings beyond (1 -+ leash) a and SLACK_N: sensor or device is another

A reading that rises is followed, and opens the gap. One that falls is followed within the leash. A sensor that shows
what no device gives is wrong, and teaches nothing.
"""

from typing import Final, Literal, final

from tormagd.config import Trim
from tormagd.control.believe.freshness import Freshness
from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N, VISCOUS_N_S_MM
from tormagd.control.believe.strength import SURE, UNSEEN, Anchor, DeviceFit
from tormagd.control.interpolation import low_pass
from tormagd.control.nominal import ROLLER_RATE_MM_S
from tormagd.element.model.force_curve import within

Disputed = Literal["device", "sensor"]
"What an operator may say of readings outside: the device has changed, or the sensor is wrong."

FILTER_S: Final = 0.02
"Time constant of the mean by which the readings are off."
LEARNS_S: Final = 0.5
"A device that has not slid for so long has shown nothing: it has no leash. What is over sooner moves no leash."
KNOWN_N: Final = 0.02
"An anchor that is known so well at a force, as a standard deviation, learns no more there."
SLACK_N: Final = 0.04
"Noise, hysteresis, a creep, a turn and a kelvin move a force by so much."
FALLS_1_S: Final = 0.3
"The leash gives way by this share of the anchor a second."
NAMED_S: Final = 0.1
"Readings that have been outside for longer are named; they count for three times that at most."
WRONG_S: Final = 0.05
"Readings that have been such as no device gives for longer show that the sensor is wrong."
DOUBTED_S: Final = 0.9
"Then they count for so long, and less with each reading inside the leash."
LEAPT: Final = 0.25
"A reading that is below the anchor by a greater share teaches nothing."
WEAKENED: Final = 0.12
"Any device may be weaker or stronger than its bounds by this share and SLACK_N: relaxed, or warm."


@final
class SensorTrust:
    """Judge of one force sensor: what of its readings may teach the fit. It keeps the anchor."""

    known_s: float = 0.0
    "How long the device has slid, LEARNS_S at most."
    off_N: float = 0.0
    "Mean of the readings over FILTER_S, less the anchor's force."
    rate_mm_s: float = 0.0
    "Mean of the handle's rate while the anchor was learned."
    fallen: float = 1.0
    "Share of the anchor that the fit gave where the anchor was last known."
    share: float = 0.0
    "Share of the anchor to which the fit may fall; 0 until the device has slid."
    below_s: float = 0.0
    "How long readings have been below the anchor where it is known; falls while they are not."
    low_s: float = 0.0
    "How long they have been below that share."
    outside_s: float = 0.0
    "How long they have been outside the leash; falls while they are inside."
    doubted_s: float = 0.0
    "How long the sensor has been doubted, in time of sliding."
    wrong_s: float = 0.0
    "How long they have been such as no device gives; falls while they are not."

    def __init__(self, trim: Trim, known: DeviceFit = UNSEEN) -> None:
        self._scales: Final = (trim.least, trim.most)
        self._leash: Final = trim.leash
        self.freshness = Freshness()
        self.anchor = Anchor(known)

    @property
    def has_slid(self) -> bool:
        return self.known_s >= LEARNS_S

    @property
    def is_doubted(self) -> bool:
        return self.wrong_s > WRONG_S

    @property
    def is_disputed(self) -> bool:
        return self.is_doubted or self.outside_s > NAMED_S

    def update(
        self,
        fit: DeviceFit,
        model_N: float,
        rate_mm_s: float,
        reading_N: float,
        zero_sd_N: float,
        dt_s: float,
        *,
        learns: bool,
    ) -> float | None:
        """Take one reading, and return what of it may teach `fit`, N; None where it is old or wrong."""
        is_stale, is_frozen = self.freshness.update(fit.scale, model_N, reading_N, dt_s, learns=not self.is_disputed)
        self.rate_mm_s = self.rate_mm_s if self.has_slid else rate_mm_s
        force_N, deviation_N = max(self.anchor.force_N(model_N), 0.0), self.anchor.deviation_N(model_N)
        self.off_N = low_pass(self.off_N, reading_N - force_N, dt_s, FILTER_S)
        unsure_N = SLACK_N + SURE * max(zero_sd_N - UNKNOWN_SD_N, 0.0)
        least_N = self._scales[0] * (1.0 - WEAKENED) * model_N - unsure_N
        most_N = self._scales[1] * (1.0 + WEAKENED) * model_N + unsure_N
        is_strange = is_frozen or not least_N <= force_N + self.off_N <= most_N
        surely_N = SURE * max(deviation_N - 2.0 * KNOWN_N, 0.0)
        unsure_N += SURE * VISCOUS_N_S_MM * max(abs(rate_mm_s - self.rate_mm_s) - ROLLER_RATE_MM_S, 0.0)
        beyond_N = abs(self.off_N) - self._leash * force_N - unsure_N - KNOWN_N - surely_N
        teaches = self._judge(is_strange, beyond_N <= 0.0, is_stale, dt_s)
        leapt_N = (1.0 - LEAPT) * force_N - unsure_N - surely_N if self.has_slid else least_N
        if not (teaches and max(least_N, leapt_N) <= reading_N <= most_N):
            return None
        believed = fit.force_N(model_N) / max(force_N, SLACK_N)
        if learns and beyond_N <= 0.0:
            self._learn(model_N, rate_mm_s, force_N, deviation_N, believed, reading_N, dt_s)
        if self.has_slid:
            self._give_way(believed, force_N, dt_s)
        return max(reading_N, self.share * force_N - unsure_N)

    def _learn(
        self,
        model_N: float,
        rate_mm_s: float,
        force_N: float,
        deviation_N: float,
        believed: float,
        reading_N: float,
        dt_s: float,
    ) -> None:
        """Teach the anchor, which gives `force_N` there, a force at which it is not known; else learn `fallen`."""
        if deviation_N <= KNOWN_N:
            self.below_s = within(self.below_s + (dt_s if self.off_N < 0.0 else -dt_s), (0.0, 2.0 * LEARNS_S))
        # a fall where it is known teaches nothing lower where it is half known
        if deviation_N <= (2.0 * KNOWN_N if self.below_s > LEARNS_S and self.off_N < 0.0 else KNOWN_N):
            self.fallen = within(believed, (self._scales[0], 1.0))
        else:
            self.rate_mm_s = low_pass(self.rate_mm_s, rate_mm_s, dt_s, LEARNS_S)
            if self.has_slid:
                # what has fallen at the forces that are known has fallen here, too
                reading_N = within(
                    reading_N / self.fallen, (force_N - SURE * deviation_N, force_N + SURE * deviation_N)
                )
            self.anchor.learn(model_N, reading_N, dt_s)

    def _give_way(self, believed: float, force_N: float, dt_s: float) -> None:
        """Move the `share` that the fit may fall to, beside the share of the anchor's `force_N` that is `believed`."""
        # what is lost in the slack is given way, too: readings at its end would teach only their noise
        self.low_s = self.low_s + dt_s if force_N + self.off_N < self.share * force_N else 0.0
        falls = FALLS_1_S * dt_s if self.low_s > LEARNS_S else 0.0
        self.share = within(max(self.share - falls, believed), (1.0 - self._leash, 1.0))

    def _judge(self, is_strange: bool, is_inside: bool, is_stale: bool, dt_s: float) -> bool:
        """Weigh how long readings were such as no device gives, or outside the leash; return whether they teach."""
        if is_strange:
            self.wrong_s = self.wrong_s + dt_s if self.wrong_s + dt_s <= WRONG_S else DOUBTED_S
        elif is_inside or not self.is_doubted:
            self.wrong_s = max(self.wrong_s - dt_s, 0.0)
        self.outside_s = within(
            self.outside_s + (dt_s if self.has_slid and not is_inside else -dt_s), (0.0, 3.0 * NAMED_S)
        )
        self.doubted_s = self.doubted_s + dt_s if self.is_doubted else 0.0
        if self.wrong_s == 0.0:
            self.known_s = min(self.known_s + dt_s, LEARNS_S)
        return self.wrong_s == 0.0 and not is_stale
