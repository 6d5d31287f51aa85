"""The thesis's pads of chapter 4, and synthetic records of what is done to them.

The data of the thesis are not public. `TactilePad` meets what is printed of them: pad size, classes, moduli without and
with field, force at full indentation. The rest (shape of the stiffening, relaxation, conditioning, rates) is assumed,
with sizes that the literature gives for such elastomers.
"""

from collections.abc import Iterable
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tormag_lab.training.dataset import Dataset
from tormagd.simulation.parameters import PadParameters
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
PASSES_BEFORE = 3
"Unrecorded passes before each record: 5 minutes, after which the peaks repeat."
HOLD_S = 3600.0


PADS = MappingProxyType(
    {
        "MRE-A": PadParameters(25.0, 81.0, 130.0, 0.0),
        "MRE-B": PadParameters(35.0, 183.0, 341.0, 0.45),
        "MRE-C": PadParameters(45.0, 281.0, 592.0, 0.85),
    }
)
"Moduli from section 4.2.3; the breakdown puts the greatest forces near 65, 141 and 186 N, as table 4.1 implies."


class Program(NamedTuple):
    """What is done to a pad, sample by sample."""

    time_s: Array
    displacement_mm: Array
    rate_mm_s: Array
    field_mT: Array

    def features(self, cip_percent: float) -> Array:
        """Return the network's features (n x 4): displacement, rate, field, iron."""
        cip = np.full_like(self.field_mT, cip_percent)
        return np.column_stack((self.displacement_mm, self.rate_mm_s, self.field_mT, cip))


class PadRecord(NamedTuple):
    """Measured rows, and the force without the sensor's noise; `cycle` counts through all records."""

    data: Dataset
    true_force_N: Array


Pass = tuple[PadParameters, Program, Array]
"Pad, program and force, N, of one recorded pass."


def cyclic_records(
    noise_N: float,
    seed: int,
    *,
    samples_per_cycle: int = SAMPLES_PER_CYCLE,
    pads: Iterable[PadParameters] = tuple(PADS.values()),
) -> PadRecord:
    """Make the data of figure 4.3: eleven fields, twelve cycles at four rates, without holds."""
    time_s, displacement_mm, rate_mm_s, cycle = cycling_program(samples_per_cycle)
    passes: list[Pass] = []
    for parameters in pads:
        pad = TactilePad(parameters)
        for field_mT in FIELDS_MT:
            pad.rest()
            for number in range(PASSES_BEFORE + 1):
                times_s, fields_mT = time_s + number * time_s[-1], np.full_like(time_s, field_mT)
                program = Program(times_s, displacement_mm, rate_mm_s, fields_mT)
                force_N = pad.run(*program)
            passes.append((parameters, program, force_N))
    return _recorded(passes, cycle, noise_N, seed)


def holding_records(
    parameters: PadParameters,
    noise_N: float,
    seed: int,
    *,
    fields_mT: tuple[float, ...] = (0.0, 91.25, 182.5, 273.75, 365.0),
    samples: int = 500,
) -> PadRecord:
    """Make a relaxation test at each field: to 4.5 mm at 1 mm/s, then held for an hour, sampled ever more rarely."""
    rise_s = FULL_INDENTATION_MM
    held_s = np.geomspace(0.05, HOLD_S, samples - RISE_SAMPLES)
    time_s = np.concatenate((np.linspace(0.0, rise_s, RISE_SAMPLES), rise_s + held_s))
    displacement_mm, rate_mm_s = np.minimum(time_s, rise_s), np.where(time_s <= rise_s, 1.0, 0.0)
    programs = [Program(time_s, displacement_mm, rate_mm_s, np.full_like(time_s, field_mT)) for field_mT in fields_mT]
    passes = [(parameters, program, worked_pad(parameters).run(*program)) for program in programs]
    return _recorded(passes, np.zeros(samples, dtype=np.int64), noise_N, seed)


def _recorded(passes: list[Pass], cycle: NDArray[np.int64], noise_N: float, seed: int) -> PadRecord:
    features = np.concatenate([program.features(pad.cip_percent) for pad, program, _ in passes])
    true_N = np.concatenate([force_N for *_, force_N in passes])
    noisy_N = true_N + np.random.default_rng(seed).normal(0.0, noise_N, len(true_N))
    cycles = np.concatenate([cycle + number * (int(cycle[-1]) + 1) for number in range(len(passes))])
    return PadRecord(Dataset(features, noisy_N, cycles, np.concatenate([each.time_s for _, each, _ in passes])), true_N)
