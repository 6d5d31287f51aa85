"""A cyclic compression test after ISO 7743: from force and displacement to stress and stretch.

Eq. 1 and 2 of the thesis: sigma = force / area and lambda = 1 + displacement / height, with compression negative in
both. A fresh filled rubber softens over its first cycles, so the loading half of the fourth is evaluated.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tormag_lab.arrays import Array, Mask
from tormag_lab.errors import LabError
from tormag_lab.tables import read_columns
from tormagd.element.physics.errors import require

CYCLES = 4
"Three conditioning cycles and the evaluated one."

STRAIN, RATE_MM_MIN = 0.25, 10.0
"Engineering strain of each cycle, and its speed."

STRAIN_TOLERANCE, RATE_TOLERANCE = 0.02, 0.25
"Deviations of strain (absolute) and rate (relative) beyond these are reported."


@dataclass(frozen=True, slots=True)
class Sample:
    """A cylinder of 1..200 mm; the thesis tested 30 mm by 12.5 mm."""

    diameter_mm: float = 30.0
    height_mm: float = 12.5

    def __post_init__(self) -> None:
        require("diameter_mm", self.diameter_mm, 1.0, 200.0)
        require("height_mm", self.height_mm, 1.0, 200.0)

    @property
    def area_m2(self) -> float:
        return math.pi * (self.diameter_mm * 1e-3) ** 2 / 4.0


class CompressionRecord(NamedTuple):
    """Displacement of the plates and force are positive in compression."""

    time_s: Array
    displacement_mm: Array
    force_N: Array


class StressStretch(NamedTuple):
    stretch: Array
    stress_Pa: Array


def read_compression(path: Path) -> CompressionRecord:
    """Read a CSV file with `time_s,displacement_mm,force_N`."""
    record = CompressionRecord(**read_columns(path, CompressionRecord._fields))
    if not (np.diff(record.time_s) > 0.0).all():
        raise LabError(f"{path}: time_s does not rise strictly")
    return record


def loading_halves(record: CompressionRecord) -> list[slice]:
    """Return the rows of each cycle's loading half, in order."""
    displacement = record.displacement_mm
    low, high = float(displacement.min()), float(displacement.max())
    if not high - low > 1e-3:
        raise LabError(f"displacement_mm goes from {low:g} to {high:g}: that is no cycle")
    # so that noise and a set make no cycle
    quarter = 0.25 * (high - low)
    compressed = _latched(displacement, low + quarter, high - quarter).astype(np.int8)
    turns = np.diff(compressed, prepend=compressed[0], append=0)
    rises = np.flatnonzero(turns > 0).tolist()
    falls = np.flatnonzero(turns < 0).tolist()[-len(rises) :]
    halves, start = [], 0
    for rise, end in zip(rises, falls, strict=False):
        bottom = start + int(np.argmin(displacement[start : rise + 1]))
        top = rise + int(np.argmax(displacement[rise:end]))
        halves.append(slice(bottom, top + 1))
        start = end
    return halves


def evaluated_cycle(record: CompressionRecord, sample: Sample, cycle: int = CYCLES) -> StressStretch:
    """Return stretch, under 1, and stress, negative, in the loading half of `cycle`, counted from 1."""
    halves = loading_halves(record)
    if not 1 <= cycle <= len(halves):
        raise LabError(f"cycle {cycle} of {len(halves)}: the record holds no such cycle")
    half = halves[cycle - 1]
    stretch = 1.0 - record.displacement_mm[half] / sample.height_mm
    if not (stretch > 0.0).all():
        raise LabError(f"displacement_mm reaches the sample's height, {sample.height_mm:g} mm")
    return StressStretch(stretch, -record.force_N[half] / sample.area_m2)


def deviations(record: CompressionRecord, sample: Sample) -> list[str]:
    """Return a sentence for each deviation from ISO 7743 with lubricated plates."""
    halves = loading_halves(record)
    found = []
    for name, value, nominal in (("diameter", sample.diameter_mm, 29.0), ("height", sample.height_mm, 12.5)):
        if abs(value - nominal) > 0.5:
            found.append(f"{name} {value:g} mm: test piece A has {nominal:g} +- 0.5 mm")
    if len(halves) != CYCLES:
        found.append(f"{len(halves)} cycles: the method has {CYCLES} and evaluates the last")
    for number, half in enumerate(halves, start=1):
        strain = float(record.displacement_mm[half].max()) / sample.height_mm
        if abs(strain - STRAIN) > STRAIN_TOLERANCE:
            found.append(f"cycle {number} goes to {strain:.1%} strain: the method goes to {STRAIN:.0%}")
        rate = 60.0 * float(np.ptp(record.displacement_mm[half])) / float(np.ptp(record.time_s[half]))
        if abs(rate / RATE_MM_MIN - 1.0) > RATE_TOLERANCE:
            found.append(f"cycle {number} loads at {rate:.3g} mm/min: the method loads at {RATE_MM_MIN:g} mm/min")
    return found


def _latched(values: Array, low: float, high: float) -> Mask:
    """Return a mask that is set once values pass `high`, until they fall below `low`."""
    decided = np.where(values >= high, 1, np.where(values <= low, 0, -1))
    known = np.maximum.accumulate(np.where(decided >= 0, np.arange(len(values)), -1))
    return np.where(known >= 0, decided[known], 0).astype(np.bool_)
