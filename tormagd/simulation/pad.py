"""The tactile element of chapter 4 as a plant: an elastomer pad between plates, compressed in a field. Synthetic.

The data of the thesis are not public. What is printed of them is met: pad size, classes, moduli at 0 and 365 mT, force
at full indentation. The rest (shape of the stiffening, relaxing fractions and times, conditioning, rates) is assumed,
with sizes that the literature gives for such elastomers.

Elastic force of each part: modulus times the Gent law in compression. The field's part of the modulus grows with the
square of the field and saturates with the particles; it breaks down with strain, the more the more filler there is
(Payne effect). Both parts stiffen with rate (Eyring) and relax, each with four times of its own, the field's part by
more. A pad not yet worked is stiffer (Mullins). Plates only push.
"""

import math
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tormagd.physics.errors import require
from tormagd.physics.relaxation import PronySeries, PronyState, PronyStep

Array = NDArray[np.float64]

FULL_INDENTATION_MM = 4.5
TOUCHING_MM = 0.2
"""Where the cycles turn at their open end: plates that leave the pad at every cycle measure air."""
FULL_FIELD_MT = 365.0
FIELDS_MT = tuple(float(value) for value in np.linspace(0.0, FULL_FIELD_MT, 11))
RATES_MM_S = (1.0, 0.5, 4.0, 2.0)
"""Not in order, so that a drift over the record is not mistaken for an effect of the rate."""
CYCLES_PER_RATE = 3
SAMPLES_PER_CYCLE = 175
RISE_SAMPLES = 46
"""Of a relaxation test: until the depth is reached."""
PASSES_BEFORE = 3
"""Unrecorded passes of the same program before each record: 5 minutes, after which the peaks repeat."""


@dataclass(frozen=True, slots=True)
class PadParameters:
    """Constants of one pad; the moduli are those of the worked pad at small strain."""

    cip_percent: float
    modulus_kPa: float
    full_field_modulus_kPa: float
    breakdown: float
    """Share of the field's stiffening that strain destroys."""
    diameter_mm: float = 30.0
    height_mm: float = 12.5
    breakdown_strain: float = 0.15
    gent_limit: float = 3.5
    saturation_mT: float = 260.0
    rate_gain: float = 0.018
    field_rate_gain: float = 0.026
    rate_scale_mm_s: float = 0.8
    mullins_share: float = 0.15
    mullins_travel_mm: float = 20.0
    relaxing: PronySeries = field(default=PronySeries((0.015, 0.040, 0.028, 0.025), (1.2, 9.5, 95.0, 1100.0)))
    field_relaxing: PronySeries = field(default=PronySeries((0.018, 0.048, 0.034, 0.030), (0.8, 6.5, 70.0, 800.0)))


PADS = MappingProxyType(
    {
        "MRE-A": PadParameters(25.0, 81.0, 130.0, 0.0),
        "MRE-B": PadParameters(35.0, 183.0, 341.0, 0.45),
        "MRE-C": PadParameters(45.0, 281.0, 592.0, 0.85),
    }
)
"""Moduli from section 4.2.3; the breakdown puts the force at 4.5 mm and 365 mT near 65, 141 and 186 N, the full
scales that table 4.1 implies."""


def drawn_pad(parameters: PadParameters, seed: int) -> PadParameters:
    """Another pad of the same recipe: moduli, saturation, relaxation, rate gain drawn about `parameters` (3..15%)."""
    draw = np.random.default_rng(seed)

    def about(value: float, spread: float) -> float:
        return value * float(1.0 + spread * draw.uniform(-1.0, 1.0))

    def series(given: PronySeries) -> PronySeries:
        fractions = tuple(about(fraction, 0.15) for fraction in given.fractions)
        return PronySeries(fractions, tuple(about(time_s, 0.15) for time_s in given.times_s))

    return replace(
        parameters,
        modulus_kPa=about(parameters.modulus_kPa, 0.03),
        full_field_modulus_kPa=about(parameters.full_field_modulus_kPa, 0.03),
        saturation_mT=about(parameters.saturation_mT, 0.05),
        rate_gain=about(parameters.rate_gain, 0.15),
        relaxing=series(parameters.relaxing),
        field_relaxing=series(parameters.field_relaxing),
    )


class TactilePad:
    """One pad with its past: what it has been worked, and what its stress remembers. New pads are unworked."""

    def __init__(self, parameters: PadParameters) -> None:
        self.parameters = parameters
        self._damage = 0.0
        self._deepest_mm = 0.0
        self._displacement_mm = 0.0
        self._dt_s = math.nan
        self._steps: tuple[PronyStep, PronyStep]
        self._memory: tuple[PronyState, PronyState]
        self.rest()

    def rest(self) -> None:
        """Take the load off for long enough that the stress forgets; what was worked stays worked."""
        self._displacement_mm = 0.0
        self._memory = (self.parameters.relaxing.relaxed(0.0), self.parameters.field_relaxing.relaxed(0.0))

    def elastic_parts_N(self, displacement_mm: float, rate_mm_s: float, field_mT: float) -> tuple[float, float]:
        """Force without memory: of the elastomer as it is worked now, and what the field adds.

        Raises `DomainError` outside 0..6 mm, +-100 mm/s, 0..500 mT.
        """
        require("displacement_mm", displacement_mm, 0.0, 6.0)
        require("rate_mm_s", rate_mm_s, -100.0, 100.0)
        require("field_mT", field_mT, 0.0, 500.0)
        pad = self.parameters
        strain = displacement_mm / pad.height_mm
        stretch = 1.0 - strain
        invariant = stretch * stretch + 2.0 / stretch - 3.0
        # kPa mm^2 is 1e-3 N
        area = 1e-3 * math.pi / 4.0 * pad.diameter_mm**2
        gent = (stretch**-2 - stretch) / 3.0 * pad.gent_limit / (pad.gent_limit - invariant)
        speed = math.asinh(rate_mm_s / pad.rate_scale_mm_s)
        unworked = 1.0 + pad.mullins_share - self._damage
        matrix_N = pad.modulus_kPa * area * gent * unworked * (1.0 + pad.rate_gain * speed)
        square = field_mT * field_mT
        full = FULL_FIELD_MT * FULL_FIELD_MT
        saturation = pad.saturation_mT * pad.saturation_mT
        stiffening = square / (square + saturation) * (full + saturation) / full
        intact = 1.0 - pad.breakdown + pad.breakdown / (1.0 + (strain / pad.breakdown_strain) ** 2)
        added_kPa = (pad.full_field_modulus_kPa - pad.modulus_kPa) * stiffening * intact
        return matrix_N, added_kPa * area * gent * (1.0 + pad.field_rate_gain * speed)

    def advance(self, dt_s: float, displacement_mm: float, rate_mm_s: float, field_mT: float) -> float:
        """Force, N, at the end of a step of `dt_s` that ends at that displacement, rate and field."""
        if dt_s != self._dt_s:
            pad = self.parameters
            self._steps = (pad.relaxing.discretise(dt_s), pad.field_relaxing.discretise(dt_s))
            self._dt_s = dt_s
        self._deepest_mm = max(self._deepest_mm, displacement_mm)
        travel_mm = abs(displacement_mm - self._displacement_mm)
        possible = self.parameters.mullins_share * min(self._deepest_mm / FULL_INDENTATION_MM, 1.0)
        self._damage += max(possible - self._damage, 0.0) * -math.expm1(-travel_mm / self.parameters.mullins_travel_mm)
        self._displacement_mm = displacement_mm
        force_N, following = 0.0, []
        parts = self.elastic_parts_N(displacement_mm, rate_mm_s, field_mT)
        for step, state, part_N in zip(self._steps, self._memory, parts, strict=True):
            relaxed_N, after = step.advance(state, part_N)
            force_N += relaxed_N
            following.append(after)
        self._memory = (following[0], following[1])
        return max(force_N, 0.0)

    def run(self, time_s: Array, displacement_mm: Array, rate_mm_s: Array, field_mT: Array) -> Array:
        """Forces, N, along a program; the first sample comes one step after what was before, or at once at time 0."""
        steps = np.round(np.diff(time_s, prepend=0.0 if time_s[0] == 0.0 else 2 * time_s[0] - time_s[1]), 9)
        columns = zip(steps.tolist(), displacement_mm.tolist(), rate_mm_s.tolist(), field_mT.tolist(), strict=True)
        return np.array([self.advance(*row) for row in columns])


class PadRecord(NamedTuple):
    """Samples of one or more records: features (n x 4: mm, mm/s, mT, %), force, and time since the last rest.

    `true_force_N` is the force without the sensor's noise, which no laboratory has. `cycle` counts through all records.
    """

    features: Array
    force_N: Array
    true_force_N: Array
    cycle: NDArray[np.int64]
    time_s: Array

    @classmethod
    def join(cls, records: "list[PadRecord]") -> "PadRecord":
        """One after the other."""
        return cls(*(np.concatenate(parts) for parts in zip(*records, strict=True)))


def cycling_program(samples_per_cycle: int = SAMPLES_PER_CYCLE) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Time, displacement, rate and cycle number of one pass: cycles 0.2 to 4.5 mm and back, each rate three times."""
    times, displacements, rates, cycles, start_s = [], [], [], [], 0.0
    stroke_mm = FULL_INDENTATION_MM - TOUCHING_MM
    share = np.arange(1, samples_per_cycle + 1) / samples_per_cycle
    for index, rate in enumerate(np.repeat(RATES_MM_S, CYCLES_PER_RATE)):
        period_s = 2.0 * stroke_mm / rate
        times.append(start_s + share * period_s)
        displacements.append(TOUCHING_MM + stroke_mm * (1.0 - np.abs(1.0 - 2.0 * share)))
        rates.append(np.where(share <= 0.5, rate, -rate))
        cycles.append(np.full(samples_per_cycle, index))
        start_s += period_s
    return np.concatenate(times), np.concatenate(displacements), np.concatenate(rates), np.concatenate(cycles)


def cyclic_records(
    noise_N: float, seed: int, *, samples_per_cycle: int = SAMPLES_PER_CYCLE, fields_mT: tuple[float, ...] = FIELDS_MT
) -> PadRecord:
    """The data of figure 4.3: three pads, eleven fields, twelve cycles of 175 samples, 69,300 rows. No holds, as there.

    Each field is a record of its own after a rest, preceded by three unrecorded passes of the same cycles.
    """
    time_s, displacement_mm, rate_mm_s, cycle = cycling_program(samples_per_cycle)
    noise = np.random.default_rng(seed)
    records: list[PadRecord] = []
    for parameters in PADS.values():
        pad = TactilePad(parameters)
        for field_mT in fields_mT:
            pad.rest()
            fields = np.full_like(time_s, field_mT)
            for pass_index in range(PASSES_BEFORE + 1):
                times = time_s + pass_index * time_s[-1]
                force_N = pad.run(times, displacement_mm, rate_mm_s, fields)
            features = np.column_stack(
                (displacement_mm, rate_mm_s, fields, np.full_like(fields, parameters.cip_percent))
            )
            noisy = force_N + noise.normal(0.0, noise_N, len(force_N))
            labels = cycle + len(records) * (int(cycle[-1]) + 1)
            records.append(PadRecord(features, noisy, force_N, labels, times))
    return PadRecord.join(records)


def worked_pad(parameters: PadParameters) -> TactilePad:
    """A pad after ten cycles without field and a rest."""
    pad = TactilePad(parameters)
    time_s, displacement_mm, rate_mm_s, _ = cycling_program(50)
    pad.run(time_s, displacement_mm, rate_mm_s, np.zeros_like(time_s))
    pad.rest()
    return pad


def holding_records(
    parameters: PadParameters,
    noise_N: float,
    seed: int,
    *,
    fields_mT: tuple[float, ...] = (0.0, 91.25, 182.5, 273.75, 365.0),
    duration_s: float = 3600.0,
    samples: int = 500,
) -> PadRecord:
    """Relaxation tests, which the thesis did not have: to 4.5 mm at 1 mm/s, then held; sampled ever more rarely.

    Raises `DomainError` on fewer samples than `RISE_SAMPLES` and two.
    """
    require("samples", samples, RISE_SAMPLES + 2, 1_000_000)
    rise_s = FULL_INDENTATION_MM
    held_s = np.geomspace(0.05, duration_s, samples - RISE_SAMPLES)
    time_s = np.concatenate((np.linspace(0.0, rise_s, RISE_SAMPLES), rise_s + held_s))
    displacement_mm = np.minimum(time_s, rise_s)
    rate_mm_s = np.where(time_s <= rise_s, 1.0, 0.0)
    noise = np.random.default_rng(seed)
    records = []
    for index, field_mT in enumerate(fields_mT):
        pad = worked_pad(parameters)
        fields = np.full_like(time_s, field_mT)
        force_N = pad.run(time_s, displacement_mm, rate_mm_s, fields)
        features = np.column_stack((displacement_mm, rate_mm_s, fields, np.full_like(fields, parameters.cip_percent)))
        noisy = force_N + noise.normal(0.0, noise_N, samples)
        records.append(PadRecord(features, noisy, force_N, np.full(samples, index), time_s))
    return PadRecord.join(records)
