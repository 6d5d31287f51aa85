"""The laws of the torque element along a recorded way of gap and handle: what a plant would have let the sensor feel.

They are those of `tormagd.simulation.element`, at the rows of an excerpt in place of each millisecond.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from scipy.signal import lfilter

from tormagd.lab.arrays import Array
from tormagd.lab.ideal_carriage import friction_of, lag_of
from tormagd.lab.twin.excerpt import GRID_HZ, Excerpt
from tormagd.physics.force import TORMAG, Elastomer, reduced
from tormagd.physics.relaxation import PronySeries
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import radial_moment_Tm

PARTS = PlantParameters.__struct_fields__[: PlantParameters.__struct_fields__.index("assumed")]
"Tables of the plant card."
PIVOT_MM = 67.0
"Gap at which the strength is said, and about which the field's exponent turns: the middle of what is used."


def value_at(plant: PlantParameters, key: str) -> float:
    """Return the number at a key of the plant file, as `motor.resistance_Ohm`; `.0` is the first of a list.

    Raises AttributeError or IndexError for a key that is none, ValueError or TypeError for one of no number.
    """
    found: Any = plant
    for name in key.split("."):
        found = found[int(name)] if name.isdigit() else getattr(found, name)
    return float(found)


def keys_of(plant: PlantParameters) -> list[str]:
    """Return the keys of all numbers in a plant file, as `value_at` takes them; not of what is assumed, of [pad] or
    [second].

    They stand in the order of the file; each number of a list has its own key.
    """
    tables = msgspec.to_builtins(plant)
    named = ((f"{title}.{name}", value) for title in PARTS for name, value in tables[title].items())
    listed = (
        [f"{key}.{place}" for place in range(len(value))] if isinstance(value, list | tuple) else [key]
        for key, value in named
        if not isinstance(value, str)
    )
    return [key for keys in listed for key in keys]


def with_values(plant: PlantParameters, values: Mapping[str, float]) -> PlantParameters:
    """Return the plant with other numbers at some keys, as `value_at` takes them; `plant` itself stays.

    Neither numbers nor bounds are checked. A key of a name that the table has not raises TypeError, of a table
    AttributeError.
    """
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


def fresh_N(plant: PlantParameters, moment_Tm: Array) -> Array:
    """Return the kinetic friction of the fresh, cool insert (n), N, at radial moments (n), T m."""
    mre = plant.elastomer
    law = reduced(Elastomer(mre.shear_modulus_kPa * 1e3, mre.relative_permeability, mre.kinetic_friction), TORMAG)
    return np.asarray(law.force(moment_Tm))


def moments_Tm(plant: PlantParameters, gap_mm: Array) -> Array:
    """Return the radial moments (n), T m, at gaps (n), without hysteresis."""
    return np.asarray(radial_moment_Tm(gap_mm, plant), dtype=np.float64)


def strength_N(plant: PlantParameters, gap_mm: float = PIVOT_MM) -> float:
    """Return the kinetic friction of the fresh, cool insert at a gap, N."""
    return float(fresh_N(plant, moments_Tm(plant, np.array([gap_mm])))[0])


def fresh_along(plant: PlantParameters, way: Excerpt) -> Array:
    """Return the fresh insert's kinetic friction (n), N, along the way, as warm as it is, with the lag of its field.

    At the first row the field does not lag.
    """
    moment_Tm = moments_Tm(plant, way.gap_mm)
    warmer_K = way.temperature_C - plant.assumed.ambient_C
    lag_Tm = lag_of(plant).along_Tm(moment_Tm, 0.0, float(moment_Tm[0]))
    return fresh_N(plant, moment_Tm + lag_Tm) * (1.0 + plant.thermal.force_percent_K / 100.0 * warmer_K)


def along(plant: PlantParameters, way: Excerpt, memory_N: Sequence[float], fresh: Array) -> Array:
    """Return the friction (n), N, with the sign of the handle's motion, as the sensor shows it after its delay.

    `memory_N` is what each branch of the elastomer still remembers at the first row, N; 0 after a long rest. It has an
    element for each branch, else ValueError. `fresh` (n) is `fresh_along`. The handle stands before the first row.
    """
    series = PronySeries(plant.relaxation.fractions, plant.relaxation.times_s)
    step = series.discretise(1.0 / GRID_HZ)
    changes = np.diff(fresh, prepend=fresh[0])
    kinetic = step.equilibrium_fraction * fresh
    for share, decay, gain, left_N in zip(step.fractions, step.decays, step.gains, memory_N, strict=True):
        branch, _ = lfilter([gain], [1.0, -decay], changes, zi=[decay * left_N])
        kinetic = kinetic + share * branch
    force = _felt(plant, np.maximum(kinetic, 0.0), np.diff(way.handle_mm, prepend=way.handle_mm[0]) * GRID_HZ)
    return np.interp(way.time_s - 1e-3 * plant.force_sensor.delay_ms, way.time_s, force)


def _felt(plant: PlantParameters, kinetic_N: Array, speed_mm_s: Array) -> Array:
    """Return the friction at the roller (n), N, for kinetic levels (n), N, and handle speeds (n), mm/s, at rows of
    GRID_HZ.

    It has the sign of the motion. Bristles are unbent before the first row.
    """
    friction, bristles_mm, forces = friction_of(plant), 0.0, []
    for speed, level_N in zip(speed_mm_s.tolist(), kinetic_N.tolist(), strict=True):
        force_N, bristles_mm = friction.advance(bristles_mm, speed, level_N, 1.0 / GRID_HZ)
        forces.append(force_N)
    return np.array(forces)
