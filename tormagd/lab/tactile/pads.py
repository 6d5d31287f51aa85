"""The thesis's pads of chapter 4, and records of what is done to them.

The data of the thesis are not public. What is printed of them is met: pad size, classes, moduli at 0 and 365 mT, force
at full indentation. The rest (shape of the stiffening, relaxing fractions and times, conditioning, rates) is assumed,
with sizes that the literature gives for such elastomers. `TactilePad` is the pad's law. All of it is synthetic.
"""

from collections.abc import Iterable
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from tormagd.simulation.parameters import PadParameters, Relaxation
from tormagd.simulation.tactile_pad import (
    FULL_FIELD_MT,
    FULL_INDENTATION_MM,
    SAMPLES_PER_CYCLE,
    Array,
    TactilePad,
    cycling_program,
    worked_pad,
)

FIELDS_MT = tuple(float(value) for value in np.linspace(0.0, FULL_FIELD_MT, 11))
RISE_SAMPLES = 46
"""Of a relaxation test: until the depth is reached."""
PASSES_BEFORE = 3
"""Unrecorded passes of the same program before each record: 5 minutes, after which the peaks repeat."""


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

    def series(given: Relaxation) -> Relaxation:
        fractions = tuple(about(fraction, 0.15) for fraction in given.fractions)
        return Relaxation(fractions, tuple(about(time_s, 0.15) for time_s in given.times_s))

    return msgspec.structs.replace(
        parameters,
        modulus_kPa=about(parameters.modulus_kPa, 0.03),
        full_field_modulus_kPa=about(parameters.full_field_modulus_kPa, 0.03),
        saturation_mT=about(parameters.saturation_mT, 0.05),
        rate_gain=about(parameters.rate_gain, 0.15),
        relaxing=series(parameters.relaxing),
        field_relaxing=series(parameters.field_relaxing),
    )


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


def cyclic_records(
    noise_N: float,
    seed: int,
    *,
    samples_per_cycle: int = SAMPLES_PER_CYCLE,
    fields_mT: tuple[float, ...] = FIELDS_MT,
    pads: Iterable[PadParameters] = tuple(PADS.values()),
) -> PadRecord:
    """The data of figure 4.3: three pads, eleven fields, twelve cycles of 175 samples, 69,300 rows. No holds, as there.

    Each field is a record of its own after a rest, preceded by three unrecorded passes of the same cycles.
    """
    time_s, displacement_mm, rate_mm_s, cycle = cycling_program(samples_per_cycle)
    noise = np.random.default_rng(seed)
    records: list[PadRecord] = []
    for parameters in pads:
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


def holding_records(
    parameters: PadParameters,
    noise_N: float,
    seed: int,
    *,
    fields_mT: tuple[float, ...] = (0.0, 91.25, 182.5, 273.75, 365.0),
    duration_s: float = 3600.0,
    samples: int = 500,
) -> PadRecord:
    """Relaxation tests, which the thesis did not have: to 4.5 mm at 1 mm/s, then held; sampled ever more rarely."""
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
