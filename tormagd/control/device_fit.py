"""What this device has shown of itself: the force it makes, over the model's, as a scale and an offset with variances.

    F = scale F_model + offset

Friction, field and elastomer differ from device to device by a factor; what the elastomer has relaxed, and what the
field's hysteresis holds back, shift the force. A Kalman filter tells the two apart as far as the forces rendered so far
allow, and no further: what a low force does not show of a high one is left to the device's spread, and known as such.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value

SCALE_SD: Final = 0.17
"Spread of the scale of devices not yet seen: friction, shear modulus and field each differ evenly within 12%."
LEAST_SCALE: Final = 0.64
MOST_SCALE: Final = 1.53
"All three at their ends, and the field's exponent at its own, -1.34 and -1.26: no believable device is beyond."
RELAXES_LEAST: Final = 0.1
RELAXES_MOST: Final = 0.21
"The least and the greatest share of its force that an elastomer loses in the course of hours."
OFFSET_SD_N: Final = 0.1
"Of the offset: what relaxation and hysteresis do around 0.5 N."
ERROR_N2_S: Final = 3e-4
"""Density of what the model does not follow, N^2 s: with these spreads a new device is learned in some hundredths of a
second. Chosen on sample 1 and draws 0 to 11, for their steps; with seven times as much these took two seconds."""
SCALE_LASTS_S: Final = 600.0
"In which what was learned of the scale is forgotten: the device has warmed, by a kelvin or less."
SCALE_VARIANCE: Final = SCALE_SD * SCALE_SD
OFFSET_VARIANCE_N2: Final = OFFSET_SD_N * OFFSET_SD_N
SURE: Final = 2.0
"Standard deviations within which a force is taken to lie."


@final
class DeviceFit(Value):
    """Scale and offset of one device, their variances and covariance."""

    def __init__(
        self,
        scale: float = 1.0,
        offset_N: float = 0.0,
        scale_variance: float = SCALE_VARIANCE,
        covariance_N: float = 0.0,
        offset_variance_N2: float = OFFSET_VARIANCE_N2,
    ) -> None:
        self.scale: Final = scale
        self.offset_N: Final = offset_N
        self.scale_variance: Final = scale_variance
        self.covariance_N: Final = covariance_N
        self.offset_variance_N2: Final = offset_variance_N2

    @property
    def scale_sd(self) -> float:
        """Standard deviation of the scale."""
        return math.sqrt(max(self.scale_variance, 0.0))

    @property
    def offset_sd_N(self) -> float:
        """Standard deviation of the offset."""
        return math.sqrt(max(self.offset_variance_N2, 0.0))

    def force_N(self, model_N: float) -> float:
        """What the device gives where the model says `model_N`."""
        return self.scale * model_N + self.offset_N

    def model_N(self, force_N: float) -> float:
        """What to ask of the model for the device to give `force_N`."""
        return (force_N - self.offset_N) / self.scale

    def deviation_N(self, model_N: float) -> float:
        """Standard deviation of `force_N` there."""
        variance = model_N * (model_N * self.scale_variance + 2.0 * self.covariance_N) + self.offset_variance_N2
        return math.sqrt(max(variance, 0.0))

    def times(self, factor: float) -> "DeviceFit":
        """The fit of a device that gives `factor` > 0 times the force."""
        if factor == 1.0:
            return self
        square = factor * factor
        return DeviceFit(
            factor * self.scale,
            factor * self.offset_N,
            square * self.scale_variance,
            square * self.covariance_N,
            square * self.offset_variance_N2,
        )

    def relaxed(self, relaxed_N: float) -> "DeviceFit":
        """The fit over the model's force without memory, of a device whose force it is without `relaxed_N` of that."""
        if relaxed_N == 0.0:
            return self
        by_scale_N = relaxed_N * self.scale_variance
        return DeviceFit(
            self.scale,
            self.offset_N - relaxed_N * self.scale,
            self.scale_variance,
            self.covariance_N - by_scale_N,
            self.offset_variance_N2 + relaxed_N * (by_scale_N - 2.0 * self.covariance_N),
        )

    def surely_within_N(self, most_N: float) -> float:
        """The most to ask of the model for the device to give no more than `most_N`: as far as it has shown itself,
        but no believable device is weaker than LEAST_SCALE or stronger than MOST_SCALE."""
        # scale m + offset + SURE sqrt(variance of that) = most, a quadratic: the smaller root is where the sum is meant
        room_N, sure = most_N - self.offset_N, SURE * SURE
        square = self.scale * self.scale - sure * self.scale_variance
        half = self.scale * room_N + sure * self.covariance_N
        rest = room_N * room_N - sure * self.offset_variance_N2
        if square <= 0.0:  # so uncertain beside its scale that no force is surely within
            return most_N / MOST_SCALE
        root_N = (half - math.sqrt(max(half * half - square * rest, 0.0))) / square
        return min(max(root_N, most_N / MOST_SCALE), most_N / LEAST_SCALE)


UNSEEN: Final = DeviceFit()
"A device that has shown nothing of itself."


def observe(
    fit: DeviceFit,
    model_N: float,
    measured_N: float,
    elapsed_s: float,
    *,
    adapts_in_s: float,
    bounds: tuple[float, float],
    error_N2_s: float = ERROR_N2_S,
    learns_scale: bool = True,
    learns_offset: bool = True,
) -> tuple[DeviceFit, bool]:
    """The fit after `measured_N` where the model says `model_N`, `elapsed_s` after the last, and whether the scale is
    held at one of its `bounds`. In the long run the offset is learned in about `adapts_in_s`; `error_N2_s` is the
    density of what the model does not follow. All are finite. What is not learned keeps its value and stays as
    uncertain as it is, and the other's gain counts with that (Schmidt's filter)."""
    if elapsed_s <= 0.0:
        return fit, False
    # both are forgotten towards their spread, which keeps the variances those of a believable device
    keeps_scale = math.exp(-elapsed_s / SCALE_LASTS_S)
    keeps_offset = math.exp(-elapsed_s * error_N2_s / (2.0 * OFFSET_VARIANCE_N2 * (adapts_in_s * adapts_in_s)))
    scale_variance = SCALE_VARIANCE + keeps_scale * keeps_scale * (fit.scale_variance - SCALE_VARIANCE)
    offset_variance = OFFSET_VARIANCE_N2 + keeps_offset * keeps_offset * (fit.offset_variance_N2 - OFFSET_VARIANCE_N2)
    covariance = keeps_scale * keeps_offset * fit.covariance_N
    by_scale = model_N * scale_variance + covariance
    by_offset = model_N * covariance + offset_variance
    innovation_variance = model_N * by_scale + by_offset + error_N2_s / elapsed_s
    gain_scale = by_scale / innovation_variance if learns_scale else 0.0
    gain_offset = by_offset / innovation_variance if learns_offset else 0.0
    error_N = measured_N - fit.force_N(model_N)
    wanted = fit.scale + gain_scale * error_N
    scale = min(max(wanted, bounds[0]), bounds[1])
    offset_N = fit.offset_N + gain_offset * error_N
    if scale != wanted and learns_offset:
        # a scale that is held is known: what is left of the error is the offset's alone
        by_itself = offset_variance / (offset_variance + error_N2_s / elapsed_s)
        offset_N = fit.offset_N + by_itself * (measured_N - scale * model_N - fit.offset_N)
    learned = DeviceFit(
        scale,
        offset_N,
        scale_variance - gain_scale * by_scale,
        covariance - (gain_scale * by_offset if learns_scale else gain_offset * by_scale),
        offset_variance - gain_offset * by_offset,
    )
    return learned, scale != wanted
