"""Least squares about a prior: the plant that fits, and 95 % intervals of whatever the data tell of it.

Values are fitted at keys of a plant file, such as `motor.resistance_Ohm`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from tormag_lab.arrays import Array
from tormagd.commission.finding import sandwich
from tormagd.simulation.parameters import PlantParameters

TOLD = 0.5
"A number is told where its interval is at most this share of the prior's."
ROUNDS = 12
STEP = 1e-3
"Step of a derivative, in widths of the prior."

PARTS = PlantParameters.__struct_fields__[: PlantParameters.__struct_fields__.index("assumed")]
"Tables of the plant card."

Values = dict[str, float]
PlantOf = Callable[[Values], PlantParameters]


def value_at(plant: PlantParameters, key: str) -> float:
    """Return the number at a key of the plant file; `.0` is the first of a list."""
    found: Any = plant
    for name in key.split("."):
        found = found[int(name)] if name.isdigit() else getattr(found, name)
    return float(found)


def keys_of(plant: PlantParameters) -> list[str]:
    tables = msgspec.to_builtins(plant)
    named = ((f"{title}.{name}", value) for title in PARTS for name, value in tables[title].items())
    listed = (
        [f"{key}.{place}" for place in range(len(value))] if isinstance(value, list | tuple) else [key]
        for key, value in named
        if not isinstance(value, str)
    )
    return [key for keys in listed for key in keys]


def with_values(plant: PlantParameters, values: Mapping[str, float]) -> PlantParameters:
    for key, value in values.items():
        table, name, *index = key.split(".")
        part = getattr(plant, table)
        new: Any = value
        if index:
            listed = list(getattr(part, name))
            listed[int(index[0])] = value
            new = tuple(listed)
        plant = msgspec.structs.replace(plant, **{table: msgspec.structs.replace(part, **{name: new})})
    return plant


class Prior(NamedTuple):
    """What is known of a number beforehand. A key without a dot is no key of the plant file."""

    key: str
    value: float
    half_width: float
    least: float = -np.inf
    "No smaller value makes sense."
    floor: float = 0.0
    "How far the way of fitting alone may be off."


class Estimate(NamedTuple):
    """Values (p), their covariance, what residuals they leave, and their plant. `deviations` make 95 %."""

    priors: Sequence[Prior]
    values: Array
    covariance: Array
    deviations: float
    residual: Array
    plant_of: PlantOf

    @property
    def plant(self) -> PlantParameters:
        return self.plant_of(named(self.priors, self.values))

    def width_of(self, key: str) -> float:
        """Return half the widest 95 % interval of the values at a key."""
        places = [place for place, each in enumerate(self.priors) if each.key == key]
        return self.deviations * math.sqrt(float(np.diag(self.covariance)[places].max()))

    def half_width(self, function: Callable[[PlantParameters], float]) -> float:
        widths = np.array([each.half_width for each in self.priors])

        def at(values: Array) -> float:
            return function(self.plant_of(named(self.priors, values)))

        slope = np.array([at(self.values + step) - at(self.values - step) for step in STEP * np.diag(widths)])
        slope /= 2.0 * STEP * widths
        variance = self.deviations**2 * slope @ self.covariance @ slope
        found = math.sqrt(variance + np.sum((slope * [each.floor for each in self.priors]) ** 2))
        return found if 0.0 < found <= TOLD * float(np.linalg.norm(slope * widths)) else math.nan


def named(priors: Sequence[Prior], values: Array) -> Values:
    return {each.key: value for each, value in zip(priors, values.tolist(), strict=True)}


def estimated(
    residuals: Callable[[Array], Array], priors: Sequence[Prior], blocks: Array, noise: float, plant_of: PlantOf
) -> Estimate:
    """Find the values (p) that make `residuals` (n) small beside `noise` and stay near their priors."""
    middle, widths = (np.array([getattr(each, name) for each in priors]) for name in ("value", "half_width"))
    least = (np.array([each.least for each in priors]) - middle) / widths

    def off(shares: Array) -> Array:
        return np.concatenate([residuals(middle + widths * shares) / noise, shares])

    start = np.maximum(np.zeros(len(priors)), least + STEP)
    found = least_squares(off, start, bounds=(least, np.inf), xtol=1e-3, ftol=1e-4, max_nfev=ROUNDS)
    numbers = np.concatenate([blocks, blocks.max() + 1.0 + np.arange(len(priors))])
    bread = np.linalg.inv(found.jac.T @ found.jac)
    # what a prior leaves open stays open, however well its middle fits
    spread = sandwich(found.jac, found.fun, numbers) + bread @ bread
    return Estimate(
        priors,
        middle + widths * found.x,
        spread * np.outer(widths, widths),
        float(student.ppf(0.975, max(len(np.unique(blocks)) - len(priors), 2))),
        noise * found.fun[: -len(priors)],
        plant_of,
    )
