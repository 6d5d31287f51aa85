"""The strength of one device: what its force is over the model's, now and as it first showed itself.

    fit      F = s m + o + v         m model's force, N; F measured force, N; s scale; o offset, N
    predict  s, o forget towards their spread with time constants SCALE_LASTS_S and one that gives `adapts_in_s`
    update   Kalman filter of (s, o), with v of density ERROR_N2_S; what is not learned keeps its value (Schmidt)
    adapt    the sooner, the more the mean of the readings is off

    anchor   F = s m + o + q (m - MIDDLE_N)^2 + h max(LEAST_N - m, 0)^2      q, h, 1/N
    update   Kalman filter of (s, o, q, h) that forgets nothing, with an error of density CURVE_ERROR_N2_S

Friction, field and elastomer differ from device to device by a factor. A relaxed elastomer shifts the force. A straight
line misses devices of the thesis's field law by 60 to 80 mN, and sample 2 by 140 mN at its open gap.
"""

import math
from typing import Final, final

from firmware_protocol.value import Value
from tormagd.element.model.force_curve import within

SCALE_SD: Final = 0.17
"Spread of the scale of devices not yet seen: friction, shear modulus and field each differ evenly within 12%."
MAX_RELAXED: Final = 0.21
"The greatest share of its force that an elastomer loses in the course of hours."
OFFSET_SD_N: Final = 0.1
"Spread of the offset of devices not yet seen: what relaxation and hysteresis do around 0.5 N."
ERROR_N2_S: Final = 3e-4
"""Density of what the model does not follow, N^2 s: with these spreads a new device is learned in some hundredths of a
second."""
SCALE_LASTS_S: Final = 600.0
"Time constant in which the scale is forgotten: the device has warmed, by a kelvin or less."
SCALE_VARIANCE: Final = SCALE_SD * SCALE_SD
OFFSET_VARIANCE_N2: Final = OFFSET_SD_N * OFFSET_SD_N
SURE: Final = 2.0
"Standard deviations within which a force is taken to lie."
SURPRISE_N: Final = 0.01
"A mean error of more than this is the device's own."
MIN_ADAPTS_IN_S: Final = 0.04
"However great the surprise, the offset is learned no sooner than in this time."
MIDDLE_N: Final = 1.3
"The curve is 0 here, amid the forces that scenes ask for."
CURVE_VARIANCE: Final = 0.06**2
"Spread of the curve, 1/N^2: what the field law of the thesis makes of a power law."
LEAST_N: Final = 1.0
HOOK_VARIANCE: Final = 0.5**2
"At a wide gap the field is another: spread of h, 1/N^2."
CURVE_ERROR_N2_S: Final = 1e-3
"Density of what no curve follows, N^2 s: a turn of the shaft takes some seconds, and is to count as a whole."


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
        return math.sqrt(max(self.scale_variance, 0.0))

    def force_N(self, model_N: float) -> float:
        """Return the device's force, N, where the model's is `model_N`; it may be below 0."""
        return self.scale * model_N + self.offset_N

    def model_N(self, force_N: float) -> float:
        """Return the model's force, N, with which the device gives `force_N`."""
        return (force_N - self.offset_N) / self.scale

    def deviation_N(self, model_N: float) -> float:
        """Return the standard deviation, N, of the device's force where the model's is `model_N`."""
        variance = model_N * (model_N * self.scale_variance + 2.0 * self.covariance_N) + self.offset_variance_N2
        return math.sqrt(max(variance, 0.0))

    def times(self, factor: float) -> "DeviceFit":
        """Return the fit of a device with `factor` > 0 times the force, and `factor` squared times the variances."""
        square = factor * factor
        return DeviceFit(
            factor * self.scale,
            factor * self.offset_N,
            square * self.scale_variance,
            square * self.covariance_N,
            square * self.offset_variance_N2,
        )

    def relaxed(self, relaxed_N: float) -> "DeviceFit":
        """Return the fit that gives, for a model's force m, the force and deviation that this fit gives for m -
        `relaxed_N`."""
        by_scale_N = relaxed_N * self.scale_variance
        return DeviceFit(
            self.scale,
            self.offset_N - relaxed_N * self.scale,
            self.scale_variance,
            self.covariance_N - by_scale_N,
            self.offset_variance_N2 + relaxed_N * (by_scale_N - 2.0 * self.covariance_N),
        )

    def surely_within_N(self, max_N: float, scales: tuple[float, float]) -> float:
        """Return the model's force, N, at which the device, taken SURE deviations stronger, gives `max_N`."""
        # scale m + offset + SURE sqrt(variance of that) = max, a quadratic: the smaller root is where the sum is meant
        room_N, sure = max_N - self.offset_N, SURE * SURE
        square = self.scale * self.scale - sure * self.scale_variance
        half = self.scale * room_N + sure * self.covariance_N
        rest = room_N * room_N - sure * self.offset_variance_N2
        if square <= 0.0:  # the scale is too uncertain
            return max_N / scales[1]
        return within(
            (half - math.sqrt(max(half * half - square * rest, 0.0))) / square,
            (max_N / scales[1], max_N / scales[0]),
        )


UNSEEN: Final = DeviceFit()
"A device that has shown nothing of itself."


def adapting_s(time_s: float, surprise_N: float) -> float:
    """Return in which time the offset is learned, `time_s` where the readings' mean is not off by `surprise_N`."""
    return max(time_s / (1.0 + math.pow(surprise_N / SURPRISE_N, 2.0)), MIN_ADAPTS_IN_S)


def forgotten(fit: DeviceFit, dt_s: float, adapts_in_s: float) -> DeviceFit:
    """Return the fit after `dt_s` without a reading: its variances go to those of a device not yet seen."""
    keeps_scale = math.exp(-dt_s / SCALE_LASTS_S)
    keeps_offset = math.exp(-dt_s * ERROR_N2_S / (2.0 * OFFSET_VARIANCE_N2 * (adapts_in_s * adapts_in_s)))
    return DeviceFit(
        fit.scale,
        fit.offset_N,
        SCALE_VARIANCE + keeps_scale * keeps_scale * (fit.scale_variance - SCALE_VARIANCE),
        keeps_scale * keeps_offset * fit.covariance_N,
        OFFSET_VARIANCE_N2 + keeps_offset * keeps_offset * (fit.offset_variance_N2 - OFFSET_VARIANCE_N2),
    )


def observe(
    fit: DeviceFit,
    model_N: float,
    measured_N: float,
    dt_s: float,
    *,
    adapts_in_s: float,
    scales: tuple[float, float],
    offsets_N: tuple[float, float],
    learns: tuple[bool, bool] = (True, True),
) -> tuple[DeviceFit, bool]:
    """Return the fit after one reading, which stands for `dt_s` > 0, and whether `scales` or `offsets_N` held it."""
    prior = forgotten(fit, dt_s, adapts_in_s)
    noise_N2 = ERROR_N2_S / dt_s
    by_scale = model_N * prior.scale_variance + prior.covariance_N
    by_offset = model_N * prior.covariance_N + prior.offset_variance_N2
    innovation_variance = model_N * by_scale + by_offset + noise_N2
    gain_scale = by_scale / innovation_variance if learns[0] else 0.0
    gain_offset = by_offset / innovation_variance if learns[1] else 0.0
    error_N = measured_N - fit.force_N(model_N)
    wanted = fit.scale + gain_scale * error_N
    scale = within(wanted, scales)
    offset_N = fit.offset_N + gain_offset * error_N
    if scale != wanted and learns[1]:
        # a scale that is held is known: what is left of the error is the offset's alone
        by_itself = prior.offset_variance_N2 / (prior.offset_variance_N2 + noise_N2)
        offset_N = fit.offset_N + by_itself * (measured_N - scale * model_N - fit.offset_N)
    held_N = within(offset_N, offsets_N)
    learned = DeviceFit(
        scale,
        held_N,
        prior.scale_variance - gain_scale * by_scale,
        prior.covariance_N - (gain_scale * by_offset if learns[0] else gain_offset * by_scale),
        prior.offset_variance_N2 - gain_offset * by_offset,
    )
    return learned, scale != wanted or held_N != offset_N


@final
class Anchor:
    """Estimator of (s, o, q, h), with their covariance.

    Since a fit was learned the elastomer has rested: its offset is as wide as an unseen device's.
    """

    def __init__(self, fit: DeviceFit) -> None:
        self.values: list[float] = [fit.scale, fit.offset_N, 0.0, 0.0]
        self.covariance: list[list[float]] = [
            [fit.scale_variance, fit.covariance_N, 0.0, 0.0],
            [fit.covariance_N, OFFSET_VARIANCE_N2, 0.0, 0.0],
            [0.0, 0.0, CURVE_VARIANCE, 0.0],
            [0.0, 0.0, 0.0, HOOK_VARIANCE],
        ]

    def force_N(self, model_N: float) -> float:
        """Return the device's force, N, where the model's is `model_N`."""
        return _dot(self.values, _terms(model_N))

    def model_N(self, force_N: float) -> float:
        """Return the model's force, N, over LEAST_N, that gives `force_N`; one beyond where the device gives most, if
        none does."""
        scale, offset_N, curve, _ = self.values
        slope, left_N = scale - 2.0 * MIDDLE_N * curve, offset_N + MIDDLE_N * MIDDLE_N * curve - force_N
        return -2.0 * left_N / (slope + math.sqrt(max(slope * slope - 4.0 * curve * left_N, 0.0)))

    def deviation_N(self, model_N: float) -> float:
        """Return the standard deviation, N, of the device's force where the model's is `model_N`."""
        terms = _terms(model_N)
        return math.sqrt(max(_dot([_dot(row, terms) for row in self.covariance], terms), 0.0))

    def learn(self, model_N: float, reading_N: float, dt_s: float) -> None:
        """Learn from one reading, which stands for `dt_s` > 0, where the model's force is `model_N`."""
        terms = _terms(model_N)
        gains = [_dot(row, terms) for row in self.covariance]
        variance_N2 = _dot(gains, terms) + CURVE_ERROR_N2_S / dt_s
        error_N = reading_N - self.force_N(model_N)
        self.values = [value + gain * error_N / variance_N2 for value, gain in zip(self.values, gains)]  # noqa: B905
        self.covariance = [
            [each - gain * other / variance_N2 for each, other in zip(row, gains)]  # noqa: B905
            for row, gain in zip(self.covariance, gains)  # noqa: B905
        ]


def _terms(model_N: float) -> list[float]:
    return [model_N, 1.0, math.pow(model_N - MIDDLE_N, 2.0), math.pow(max(LEAST_N - model_N, 0.0), 2.0)]


def _dot(left: list[float], right: list[float]) -> float:
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2] + left[3] * right[3]
