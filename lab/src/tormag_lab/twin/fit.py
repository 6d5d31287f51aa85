"""Fits a whole plant to recordings of one device, and says which of its numbers they tell."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from tormag_lab.arrays import rms
from tormag_lab.errors import LabError
from tormag_lab.twin.carriages import SUPPLY_STEP_V, fit_carriages, lag_s
from tormag_lab.twin.estimate import TOLD, Estimate, value_at, with_values
from tormag_lab.twin.excerpt import EVERY_TICK, GRID_HZ, Excerpt
from tormag_lab.twin.force import DRIFT_MN_MIN, EXPONENT, PIVOT_MM, STRENGTH, Fitted, fit_force, strength_N
from tormagd.simulation.parameters import PlantParameters

CHOICE = (STRENGTH, EXPONENT, "field.hysteresis_percent", "friction.static_to_kinetic")
CHOICE_S = 120.0
"Enough to tell the field laws apart."
SLOW_MM_S = 2.0
NEAR_MM, FAR_MM = 60.0, 85.0
EXPLAINED_N, EXPLAINED_MM = 0.015, 0.05
"Above these the laws are not this device's."
CLOCK_PPM = 0.7
RATE_SHARE = 0.05
NOISE_SHARE = 0.02
"How far the noise of a sensor with steps of its own may be off."


class Told(NamedTuple):
    """A number and half the width of its 95 % interval; NaN where it is not told."""

    value: float
    half_width: float


class Twin(NamedTuple):
    """A plant, what is told of its keys and of COMBINATIONS, and the unexplained RMS."""

    plant: PlantParameters
    keys: dict[str, Told]
    combinations: dict[str, Told]
    force: Fitted
    noise_N: float
    gap_error_mm: float

    @property
    def is_explained(self) -> bool:
        return self.force.error_N <= EXPLAINED_N and self.gap_error_mm <= EXPLAINED_MM


def slope(plant: PlantParameters) -> float:
    return strength_N(plant, NEAR_MM) / strength_N(plant, FAR_MM)


def low_speed_factor(plant: PlantParameters) -> float:
    return plant.friction.law.level_N(SLOW_MM_S, 1.0)


OF_FORCE: dict[str, Callable[[PlantParameters], float]] = {
    f"force at {PIVOT_MM:g} mm, N": strength_N,
    f"force at {NEAR_MM:g} mm over that at {FAR_MM:g} mm": slope,
    f"friction at {SLOW_MM_S:g} mm/s over that at speed": low_speed_factor,
}
OF_CARRIAGES: dict[str, Callable[[PlantParameters], float]] = {"lag of the carriages, s": lag_s}
COMBINATIONS = OF_FORCE | OF_CARRIAGES
"Figures that several keys share, and that the data tell better than each key."
STANDS_FOR = {STRENGTH: strength_N, EXPONENT: slope}
"Keys that take on what the data tell of a combination, on behalf of its other keys."


def twin_of(prior: PlantParameters, ways: Sequence[Excerpt]) -> Twin:
    if prior.pad is not None or prior.second is not None:
        raise LabError("--prior: allowed is a plant with an insert, without [pad] and [second]")
    under = [
        msgspec.structs.replace(prior, field=msgspec.structs.replace(prior.field, law=law))
        for law in ("power", "thesis")
    ]
    early = [ways[0].first(CHOICE_S)]
    base = min(under, key=lambda each: rms(fit_force(each, early, CHOICE).estimate.residual))
    open_force, open_driven = fit_force(base, ways).estimate, fit_carriages(base, ways).estimate
    told = _told(open_force) | _told(open_driven)
    # keys that are not told stay the prior's, and the others move to where they then fit best
    force, driven = fit_force(base, ways, tuple(told)), fit_carriages(base, ways, tuple(told))
    plant = with_values(force.estimate.plant, {key: value_at(driven.estimate.plant, key) for key in _told(open_driven)})
    keys, combinations = {}, {}
    for estimate, functions in ((open_force, OF_FORCE), (open_driven, OF_CARRIAGES)):
        for key in (each.key for each in estimate.priors if each.key in told):
            value = value_at(plant, key)
            keys[key] = Told(value, math.hypot(told[key], value - value_at(estimate.plant, key)))
        for name, function in functions.items():
            value = function(plant)
            combinations[name] = Told(
                value, math.hypot(estimate.half_width(function), value - function(estimate.plant))
            )
    sensor = _of_sensor(ways, force)
    plant = with_values(plant, {key: each.value for key, each in sensor.items()})
    return Twin(plant, keys | sensor, combinations, force, _noise_N(ways)[0], driven.error_mm)


def _told(estimate: Estimate) -> dict[str, float]:
    """Return half the interval of each key of the plant file that the data tell."""
    found, plant = {}, estimate.plant
    for key in (each.key for each in estimate.priors if "." in each.key):
        function = STANDS_FOR.get(key, lambda plant, key=key: value_at(plant, key))
        value, step = value_at(plant, key), 1e-3 * abs(value_at(plant, key)) + 1e-9
        rise = function(with_values(plant, {key: value + step})) - function(plant)
        if not math.isnan(width := estimate.half_width(function)):
            found[key] = width * abs(step / rise)
    return found


def _noise_N(ways: Sequence[Excerpt]) -> tuple[float, float]:
    noise_N = np.concatenate([way.noise_N for way in ways])
    spread = 2.0 * float(noise_N.std()) / math.sqrt(len(noise_N))
    return float(np.median(noise_N)), math.hypot(spread, NOISE_SHARE * float(np.median(noise_N)))


def _of_sensor(ways: Sequence[Excerpt], force: Fitted) -> dict[str, Told]:
    """Return what needs no law: the sensor's noise, drift and rate, the supply, and the device's clock."""
    noise_N, width_N = _noise_N(ways)
    drift_mN_min = float(np.mean([abs(zero["drift_mN_min"]) for zero in force.zeros]))
    rows, readings, ticks = (
        float(sum(each))
        for each in zip(*((len(way.ticks), way.readings.sum(), way.ticks.sum()) for way in ways), strict=True)
    )
    found = {
        "force_sensor.noise_mN": Told(1e3 * noise_N, 1e3 * width_N),
        "electronics.supply_V": Told(float(np.mean([way.supply_V for way in ways])), 0.5 * SUPPLY_STEP_V),
        "firmware.clock_ppm": Told(float(np.mean([way.clock_ppm for way in ways])), CLOCK_PPM),
    }
    if (width_mN_min := 1e3 * force.estimate.width_of("drift_N_min")) <= TOLD * DRIFT_MN_MIN:
        found["force_sensor.drift_mN_min"] = Told(drift_mN_min, width_mN_min)
    if readings < EVERY_TICK * ticks:
        rate_Hz = readings / rows * GRID_HZ
        found["force_sensor.rate_Hz"] = Told(rate_Hz, RATE_SHARE * rate_Hz)
    return found
