"""Leash of the fit: how far the readings of the force sensor may lead what is believed of a device.

    anchor   a    what the device first showed, at each force until it is known there
    share    h    of the anchor to which the fit may fall: (1 - leash) to 1; it rises with the fit, and falls slowly
    low           h a - SLACK_N: lesser readings count as this
    outside       readings beyond (1 -+ leash) a and SLACK_N: sensor or device is another

A reading that rises is followed, and opens the gap. One that falls is followed within the leash. A sensor that shows
what no device gives is wrong, and teaches nothing.
"""

import math
from typing import Final, Literal, final

from tormagd.control.believe.anchor import Anchor
from tormagd.control.believe.freshness import Freshness
from tormagd.control.believe.sensor_zero import UNKNOWN_SD_N
from tormagd.control.believe.strength import SURE, UNSEEN, DeviceBounds, DeviceFit
from tormagd.control.interpolation import low_pass

Disputed = Literal["device", "sensor"]
"What an operator may say of readings outside: the device has changed, or the sensor is wrong."

FILTER_S: Final = 0.01
"Time constant of the readings' mean."
LEARNS_S: Final = 0.5
"A device that has not slid for so long has shown nothing: it has no leash. What is over sooner moves no leash."
KNOWN_N: Final = 0.02
"An anchor that is known so well at a force, as a standard deviation, learns no more there."
SLACK_N: Final = 0.05
"Noise, hysteresis, a creep and a kelvin move a force by so much."
VISCOUS_N_S_MM: Final = 1e-3
"And by so much for each mm/s between the handle's rate and that at which the anchor was learned."
FALLS_1_S: Final = 0.3
"The leash gives way by this share of the anchor a second."
NAMED_S: Final = 0.1
"Readings that have been outside for longer are named."
INSIDE_S: Final = 0.2
"Readings have to be inside for so long before they are no longer in dispute; those of a wrong sensor five times."
WRONG_S: Final = 0.05
"Evidence for so long shows that the sensor is wrong."
LEAPT: Final = 0.25
"A reading that is below the anchor by a greater share teaches nothing."
WEAKENED: Final = 0.12
"Any device may be weaker or stronger than its bounds by this share and SLACK_N: relaxed, or warm."


@final
class SensorTrust:
    """Judge of one force sensor: what of its readings may teach the fit. It keeps the anchor."""

    known_s: float = 0.0
    "How long the device has slid, LEARNS_S at most."
    measured_N: float = 0.0
    "Mean of the readings over FILTER_S."
    rate_mm_s: float = 0.0
    "Mean of the handle's rate while the anchor was learned."
    fallen: float = 1.0
    "Share of the anchor that the fit gave where the anchor was last known."
    share: float = 0.0
    "Share of the anchor to which the fit may fall; 0 until the device has slid."
    low_s: float = 0.0
    "How long the readings have been below that share."
    outside_s: float = 0.0
    "How long the readings have been outside the leash; 0 once they have been inside for INSIDE_S."
    inside_s: float = 0.0
    "How long they have been inside."
    is_doubted: bool = False
    "Whether the sensor is shown to be wrong."
    doubted_s: float = 0.0
    "How long the sensor has been doubted, in time of sliding."
    wrong_s: float = 0.0
    "How long the readings have been such as no device gives; falls while they are not."

    def __init__(self, bounds: DeviceBounds, leash: float, known: DeviceFit = UNSEEN) -> None:
        self._bounds: Final = bounds
        self._leash: Final = leash
        self.freshness = Freshness()
        self.anchor = Anchor(known)

    @property
    def has_slid(self) -> bool:
        return self.known_s >= LEARNS_S

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
        self.freshness.update(fit.scale, model_N, reading_N, dt_s, learns=not self.is_disputed)
        if self.known_s == 0.0:
            self.measured_N, self.rate_mm_s = reading_N, rate_mm_s
        self.measured_N = low_pass(self.measured_N, reading_N, dt_s, FILTER_S)
        unsure_N = SLACK_N + SURE * max(zero_sd_N - UNKNOWN_SD_N, 0.0)
        least_N = self._bounds.min_scale * (1.0 - WEAKENED) * model_N - unsure_N
        most_N = self._bounds.max_scale * (1.0 + WEAKENED) * model_N + unsure_N
        is_strange = self.freshness.is_frozen or not least_N <= self.measured_N <= most_N
        force_N, deviation_N = max(self.anchor.force_N(model_N), 0.0), self.anchor.deviation_N(model_N)
        surely_N = SURE * max(deviation_N - 2.0 * KNOWN_N, 0.0)
        unsure_N += VISCOUS_N_S_MM * abs(rate_mm_s - self.rate_mm_s)
        beyond_N = abs(self.measured_N - force_N) - self._leash * force_N - unsure_N - KNOWN_N - surely_N
        self._doubt(is_strange, dt_s)
        teaches = self._judge(is_strange, beyond_N <= 0.0, dt_s)
        leapt_N = (1.0 - LEAPT) * force_N - unsure_N - surely_N if self.has_slid else least_N
        if not (teaches and max(least_N, leapt_N) <= reading_N <= most_N):
            return None
        taught_N = max(reading_N, self.share * force_N - unsure_N)
        believed = fit.force_N(model_N) / max(force_N, SLACK_N)
        self._learn(model_N, force_N, deviation_N, rate_mm_s, taught_N, believed, dt_s, learns and beyond_N <= 0.0)
        if self.has_slid:
            self._give_way(believed, force_N, dt_s)
        return taught_N

    def _learn(
        self,
        model_N: float,
        force_N: float,
        deviation_N: float,
        rate_mm_s: float,
        taught_N: float,
        believed: float,
        dt_s: float,
        is_known: bool,
    ) -> None:
        """Teach the anchor a force at which it is not known."""
        if deviation_N <= KNOWN_N:
            self.fallen = min(max(believed, self._bounds.min_scale), 1.0)
        elif is_known:
            self.rate_mm_s = low_pass(self.rate_mm_s, rate_mm_s, dt_s, LEARNS_S)
            # what has fallen at the forces that are known has fallen here, too
            within_N, shown_N = SURE * deviation_N if self.has_slid else math.inf, taught_N / self.fallen
            self.anchor.learn(model_N, min(max(shown_N, force_N - within_N), force_N + within_N), dt_s)

    def _give_way(self, believed: float, force_N: float, dt_s: float) -> None:
        """Move the `share` that the fit may fall to, beside the share that is `believed`."""
        # what is lost in the slack is given way, too: readings at its end would teach only their noise
        self.low_s = self.low_s + dt_s if self.measured_N < self.share * force_N else 0.0
        falls = FALLS_1_S * dt_s if self.low_s > LEARNS_S else 0.0
        self.share = min(max(max(self.share - falls, believed), 1.0 - self._leash), 1.0)

    def _doubt(self, is_strange: bool, dt_s: float) -> None:
        """Count how long the readings have been such as no device gives, and how long the device has slid."""
        self.wrong_s = self.wrong_s + dt_s if is_strange else max(self.wrong_s - dt_s, 0.0)
        self.is_doubted = self.is_doubted or self.wrong_s > WRONG_S
        self.doubted_s = self.doubted_s + dt_s if self.is_doubted else 0.0
        if not is_strange and not self.is_doubted:
            self.known_s = min(self.known_s + dt_s, LEARNS_S)

    def _judge(self, is_strange: bool, is_inside: bool, dt_s: float) -> bool:
        """Count how long the readings have been outside or inside the leash, and return whether they teach."""
        self.inside_s = self.inside_s + dt_s if is_inside and not is_strange else 0.0
        if self.has_slid and not is_inside:
            self.outside_s += dt_s
        elif self.inside_s > INSIDE_S:
            self.outside_s = 0.0
        if self.is_doubted and self.inside_s > 5.0 * INSIDE_S:
            self.is_doubted, self.doubted_s, self.wrong_s = False, 0.0, 0.0
        return self.wrong_s == 0.0 and not self.is_doubted and not self.freshness.is_stale
