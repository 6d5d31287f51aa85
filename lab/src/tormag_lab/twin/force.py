"""What the force sensor says of the element: strength, shape over the gap, memory, friction over the rate.

The laws are those of `tormagd.simulation.element`, at the rows of an excerpt in place of each millisecond.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.signal import lfilter

from tormag_lab.arrays import Array, Mask, rms
from tormag_lab.errors import LabError
from tormag_lab.ideal_carriage import lag_of
from tormag_lab.twin.estimate import Estimate, Prior, Values, estimated, named, value_at, with_values
from tormag_lab.twin.excerpt import GRID_HZ, Excerpt
from tormagd.element.physics.force import TORMAG, reduced
from tormagd.simulation.parameters import Elastomer, Field, PlantParameters, Thermal
from tormagd.simulation.static_laws import radial_moment_Tm

STRENGTH, EXPONENT = "elastomer.kinetic_friction", "field.exponent"
PIVOT_MM = 67.0
"Gap of the stated strength, about which the field's exponent turns: the middle of what is used."
BURN_S = 5.0
"By then hysteresis and bristles have forgotten what was before the recording."
BLOCK_S = 10.0
FIT_N = 0.03
"Size of a row's error in the fit: some noise, and more that neighbouring rows share."
FROZEN_S, FROZEN_N = 0.3, 0.1
"A reading that stays so long while the law moves by this much is no reading."
GRID_RATIO = 0.003
"Rows of a hundredth of a second blur the friction of a stopping handle by so much."
DRIFT_MN_MIN = 5.0
"Greatest drift of the plant card's sensors."
MAX_LOST = 0.3
MAX_DRIFT_MN_MIN, MAX_ZERO_MN = 10.0, 150.0
"A sensor whose zero drifts faster, or is further off, is refused."
WANDER_S = 30.0


class Fitted(NamedTuple):
    """The element's estimate, what was cut out of the recordings, and the sensor's zero in each."""

    estimate: Estimate
    cut_out: list[str]
    zeros: list[dict[str, float]]
    error_N: float


def fresh_N(plant: PlantParameters, moment_Tm: Array) -> Array:
    """Return the kinetic friction of the fresh, cool insert (n) at radial moments (n)."""
    return np.asarray(reduced(plant.elastomer.law, TORMAG).force(moment_Tm))


def moments_Tm(plant: PlantParameters, gap_mm: Array) -> Array:
    return np.asarray(radial_moment_Tm(gap_mm, plant), dtype=np.float64)


def strength_N(plant: PlantParameters, gap_mm: float = PIVOT_MM) -> float:
    return float(fresh_N(plant, moments_Tm(plant, np.array([gap_mm])))[0])


def fresh_along(plant: PlantParameters, way: Excerpt) -> Array:
    """Return the fresh insert's kinetic friction (n), at its temperature and with the lag of its field."""
    moment_Tm = moments_Tm(plant, way.gap_mm)
    warmer_K = way.temperature_C - plant.assumed.ambient_C
    lag_Tm = lag_of(plant).along_Tm(moment_Tm, 0.0, float(moment_Tm[0]))
    return fresh_N(plant, moment_Tm + lag_Tm) * (1.0 + plant.thermal.force_percent_K / 100.0 * warmer_K)


def along(plant: PlantParameters, way: Excerpt, memory_N: Sequence[float], fresh: Array) -> Array:
    """Return the friction (n), signed as the handle's motion, as the sensor shows it after its delay."""
    step = plant.relaxation.law.discretise(1.0 / GRID_HZ)
    changes = np.diff(fresh, prepend=fresh[0])
    kinetic = step.equilibrium_fraction * fresh
    for share, decay, gain, left_N in zip(step.fractions, step.decays, step.gains, memory_N, strict=True):
        branch, _ = lfilter([gain], [1.0, -decay], changes, zi=[decay * left_N])
        kinetic = kinetic + share * branch
    force = _felt(plant, np.maximum(kinetic, 0.0), np.diff(way.handle_mm, prepend=way.handle_mm[0]) * GRID_HZ)
    return np.interp(way.time_s - 1e-3 * plant.force_sensor.delay_ms, way.time_s, force)


def _felt(plant: PlantParameters, kinetic_N: Array, speed_mm_s: Array) -> Array:
    friction, bristles_mm, forces = plant.friction.law, 0.0, []
    for speed, level_N in zip(speed_mm_s.tolist(), kinetic_N.tolist(), strict=True):
        force_N, bristles_mm = friction.advance(bristles_mm, speed, level_N, 1.0 / GRID_HZ)
        forces.append(force_N)
    return np.array(forces)


def made(prior: PlantParameters, values: Values) -> PlantParameters:
    field, own_N = prior.field, strength_N(prior)
    exponent = values.get(EXPONENT, field.exponent)
    turned = {"field.coefficient": field.coefficient * PIVOT_MM ** (field.exponent - exponent)}
    shaped = with_values(prior, {key: value for key, value in values.items() if key != STRENGTH} | turned)
    friction = values.get(STRENGTH, prior.elastomer.kinetic_friction)
    return with_values(shaped, {STRENGTH: friction * own_N / strength_N(shaped)})


def priors_of(plant: PlantParameters) -> list[Prior]:
    """Return what is believed of an element beforehand: the spread of the plant card's devices."""

    def about(key: str, share: float = 0.0, plain: float = 0.0, least: float = 0.0, floor: float = 0.0) -> Prior:
        value = value_at(plant, key)
        return Prior(key, value, abs(share * value) + plain, least, floor)

    return [
        about(STRENGTH, 0.3, least=1e-3),
        about("elastomer.shear_modulus_kPa", 0.12, least=1.0),
        *([about(EXPONENT, plain=0.04, least=-3.0)] if plant.field.law == "power" else []),
        about("field.hysteresis_percent", plain=0.75),
        *(about(f"relaxation.fractions.{place}", 0.6) for place in range(len(plant.relaxation.fractions))),
        about("friction.static_to_kinetic", plain=0.1, least=1.0, floor=GRID_RATIO),
        about("friction.stribeck_speed_mm_s", 0.5, least=0.5),
        about("friction.presliding_stiffness_N_mm", 0.5, least=0.5),
        about("friction.viscous_N_s_mm", plain=5e-4),
        about("thermal.force_percent_K", plain=0.25, least=-5.0),
        about("force_sensor.delay_ms", plain=3.0, floor=1.0),
    ]


def fit_force(prior: PlantParameters, ways: Sequence[Excerpt], only: Sequence[str] | None = None) -> Fitted:
    """Fit the element to the forces along `ways`, under the field law of `prior`."""
    shared = [each for each in priors_of(prior) if only is None or each.key in only]
    branches = [Prior(f"memory_{place}", 0.0, 0.5) for place in range(len(prior.relaxation.fractions))]
    sensor = [Prior("zero_N", 0.0, 0.06), Prior("drift_N_min", 0.0, 0.02), *branches]
    kept, cut_out = _believed(prior, ways)

    def plant_of(values: Values) -> PlantParameters:
        return made(prior, {key: value for key, value in values.items() if "." in key})

    # most derivatives leave these tables alone
    @lru_cache(maxsize=4 * len(ways))
    def fresh(number: int, elastomer: Elastomer, field: Field, thermal: Thermal) -> Array:
        plant = msgspec.structs.replace(prior, elastomer=elastomer, field=field, thermal=thermal)
        return fresh_along(plant, ways[number])

    def off(values: Array) -> Array:
        plant = plant_of(named(shared, values[: len(shared)]))
        parts = zip(range(len(ways)), kept, values[len(shared) :].reshape(len(ways), -1).tolist(), strict=True)
        return np.concatenate(
            [
                (
                    ways[number].force_N
                    - along(plant, ways[number], memory_N, fresh(number, plant.elastomer, plant.field, plant.thermal))
                    - zero_N
                    - drift_N_min * ways[number].minute
                )[mask]
                for number, mask, (zero_N, drift_N_min, *memory_N) in parts
            ]
        )

    blocks = [1e6 * number + np.floor(way.time_s / BLOCK_S) for number, way in enumerate(ways)]
    counted = np.concatenate([block[mask] for block, mask in zip(blocks, kept, strict=True)])
    found = estimated(off, [*shared, *(sensor * len(ways))], counted, FIT_N, plant_of)
    zeros = []
    each_off = np.split(found.residual, np.cumsum([np.count_nonzero(mask) for mask in kept])[:-1])
    each_own = found.values[len(shared) :].reshape(len(ways), -1)[:, :2] * 1e3
    for way, mask, own, residual in zip(ways, kept, each_own.tolist(), each_off, strict=True):
        zeros.append(dict(zip(("zero_mN", "drift_mN_min"), own, strict=True)))
        _require_steady(way, own[0], own[1], 1e3 * found.width_of("drift_N_min"), residual, way.time_s[mask])
    noise_N = rms(
        np.concatenate(
            [
                np.median(way.noise_N) / np.sqrt(np.maximum(way.readings[mask], 1.0))
                for way, mask in zip(ways, kept, strict=True)
            ]
        )
    )
    return Fitted(found, cut_out, zeros, math.sqrt(max(rms(found.residual) ** 2 - noise_N**2, 0.0)))


def _believed(prior: PlantParameters, ways: Sequence[Excerpt]) -> tuple[list[Mask], list[str]]:
    """Return a mask of the rows of each way that count, and a sentence for each stuck stretch of the sensor."""
    kept, cut_out = [], []
    for way in ways:
        known = np.isfinite(way.force_N)
        expected_N = along(prior, way, [0.0] * len(prior.relaxation.fractions), fresh_along(prior, way))
        stands = np.concatenate([[0], (way.readings == 0.0).astype(np.int64), [0]])
        edges = np.flatnonzero(np.diff(stands)).reshape(-1, 2)
        for begin, end in edges[np.diff(edges)[:, 0] >= FROZEN_S * GRID_HZ].tolist():
            if np.ptp(expected_N[begin:end]) > FROZEN_N:
                # the rows before and after it were stuck for a part
                known[max(begin - 1, 0) : end + 1] = False
                cut_out.append(
                    f"{way.name}: the force sensor stood still from {begin / GRID_HZ:.1f} to {end / GRID_HZ:.1f} s"
                )
        lost = 1.0 - float(known.mean())
        if lost > MAX_LOST:
            raise LabError(f"{way.name}: the force sensor says nothing in {lost:.0%} of it: allowed are {MAX_LOST:.0%}")
        known[: round(BURN_S * GRID_HZ)] = False
        kept.append(known)
    return kept, cut_out


def _require_steady(
    way: Excerpt, zero_mN: float, drift_mN_min: float, width_mN_min: float, residual_N: Array, time_s: Array
) -> None:
    """Refuse a sensor whose zero is far off, surely drifts, or wanders."""
    part = np.floor(time_s / WANDER_S).astype(np.int64)
    sums, counts = np.bincount(part, residual_N), np.bincount(part)
    wander_mN = 1e3 * float(np.ptp(sums[counts > 0] / counts[counts > 0]))
    if abs(drift_mN_min) > MAX_DRIFT_MN_MIN + width_mN_min or abs(zero_mN) + wander_mN > MAX_ZERO_MN:
        raise LabError(
            f"{way.name}: the force sensor's zero is {zero_mN:.0f} mN, drifts by {drift_mN_min:.1f} mN a minute and "
            f"wanders by {wander_mN:.0f} mN: allowed are {MAX_DRIFT_MN_MIN:g} mN a minute, {MAX_ZERO_MN:g} mN else"
        )
