"""The tactile pad's law: an elastomer between plates, compressed in a field, with what it remembers.

Elastic force of each part: modulus times the Gent law in compression. The field's part of the modulus grows with the
square of the field and saturates with the particles. It breaks down with strain, the more the more filler there is
(Payne effect). Both parts stiffen with rate (Eyring) and relax, each with times of its own, the field's part by more. A
pad not yet worked is stiffer (Mullins). Plates only push.
"""

import math
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from tormagd.element.physics.errors import require
from tormagd.element.physics.field import PAD_RADIUS_M
from tormagd.element.physics.relaxation import PronySeries, PronyState, PronyStep
from tormagd.simulation.element import GapField, Warmth
from tormagd.simulation.parameters import PadParameters, PlantParameters

Array = NDArray[np.float64]

FULL_INDENTATION_MM: Final = 4.5
FULL_FIELD_MT: Final = 365.0
DEEPEST_MM: Final = 6.0
FASTEST_MM_S: Final = 100.0
STRONGEST_MT: Final = 500.0

TOUCHING_MM = 0.2
"Plates that leave the pad would measure air."
RATES_MM_S = (1.0, 0.5, 4.0, 2.0)
"Not in order, so that a drift is not mistaken for an effect of the rate."
CYCLES_PER_RATE = 3
SAMPLES_PER_CYCLE = 175


@final
class TactilePad:
    """One pad with its past: conditioning by strain (Mullins effect) and relaxing stress."""

    def __init__(self, parameters: PadParameters) -> None:
        self._parameters = parameters
        self._series: PronySeries = parameters.relaxing.law
        self._field_series: PronySeries = parameters.field_relaxing.law
        self._damage: float = 0.0
        self._deepest_mm: float = 0.0
        self._dt_s: float = 0.0
        self._step: PronyStep = self._series.discretise(0.0)
        self._field_step: PronyStep = self._field_series.discretise(0.0)
        self._displacement_mm: float = 0.0
        self._memory: PronyState = self._series.relaxed(0.0)
        self._field_memory: PronyState = self._field_series.relaxed(0.0)

    def rest(self) -> None:
        """Take the load off until all stress has relaxed; conditioning stays."""
        self._displacement_mm = 0.0
        self._memory, self._field_memory = self._series.relaxed(0.0), self._field_series.relaxed(0.0)

    def elastic_parts_N(self, displacement_mm: float, rate_mm_s: float, field_mT: float) -> tuple[float, float]:
        """Return the forces before relaxation of the elastomer, and of the field."""
        require("displacement_mm", displacement_mm, 0.0, DEEPEST_MM)
        require("rate_mm_s", rate_mm_s, -FASTEST_MM_S, FASTEST_MM_S)
        require("field_mT", field_mT, 0.0, STRONGEST_MT)
        pad = self._parameters
        area = 1e-3 * math.pi / 4.0 * pad.diameter_mm**2  # kPa mm^2 is 1e-3 N
        strain = displacement_mm / pad.height_mm
        stretch = 1.0 - strain
        invariant = stretch * stretch + 2.0 / stretch - 3.0
        gent = (1.0 / (stretch * stretch) - stretch) / 3.0 * pad.gent_limit / (pad.gent_limit - invariant)
        speed = math.asinh(rate_mm_s / pad.rate_scale_mm_s)
        unworked = 1.0 + pad.mullins_share - self._damage
        matrix_N = pad.modulus_kPa * area * gent * unworked * (1.0 + pad.rate_gain * speed)
        square, saturation = field_mT * field_mT, pad.saturation_mT * pad.saturation_mT
        full = FULL_FIELD_MT * FULL_FIELD_MT
        stiffening = square / (square + saturation) * (full + saturation) / full
        share = strain / pad.breakdown_strain
        intact = 1.0 - pad.breakdown + pad.breakdown / (1.0 + share * share)
        added_kPa = (pad.full_field_modulus_kPa - pad.modulus_kPa) * stiffening * intact
        return matrix_N, added_kPa * area * gent * (1.0 + pad.field_rate_gain * speed)

    def advance(self, dt_s: float, displacement_mm: float, rate_mm_s: float, field_mT: float) -> float:
        if dt_s != self._dt_s:
            self._step, self._field_step = self._series.discretise(dt_s), self._field_series.discretise(dt_s)
            self._dt_s = dt_s
        self._deepest_mm = max(self._deepest_mm, displacement_mm)
        travel_mm = abs(displacement_mm - self._displacement_mm)
        pad = self._parameters
        possible = pad.mullins_share * min(self._deepest_mm / FULL_INDENTATION_MM, 1.0)
        self._damage += max(possible - self._damage, 0.0) * -math.expm1(-travel_mm / pad.mullins_travel_mm)
        self._displacement_mm = displacement_mm
        matrix_N, added_N = self.elastic_parts_N(displacement_mm, rate_mm_s, field_mT)
        relaxed_N, self._memory = self._step.advance(self._memory, matrix_N)
        field_N, self._field_memory = self._field_step.advance(self._field_memory, added_N)
        return max(relaxed_N + field_N, 0.0)

    def run(self, time_s: Array, displacement_mm: Array, rate_mm_s: Array, field_mT: Array) -> Array:
        """Return the force at each of n samples of a program."""
        steps = np.round(np.diff(time_s, prepend=0.0 if time_s[0] == 0.0 else 2 * time_s[0] - time_s[1]), 9)
        columns = zip(steps.tolist(), displacement_mm.tolist(), rate_mm_s.tolist(), field_mT.tolist(), strict=True)
        return np.array([self.advance(*row) for row in columns])


def cycling_program(samples_per_cycle: int = SAMPLES_PER_CYCLE) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return time, displacement, rate and cycle number of one pass of the test rig."""
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


def worked_pad(parameters: PadParameters) -> TactilePad:
    """Return a pad after twelve cycles without field and a rest."""
    pad = TactilePad(parameters)
    time_s, displacement_mm, rate_mm_s, _ = cycling_program(50)
    pad.run(time_s, displacement_mm, rate_mm_s, np.zeros_like(time_s))
    pad.rest()
    return pad


MT_PER_TM: Final = 1e3 / PAD_RADIUS_M


@final
class PressedPad:
    """The worked, rested pad between the magnets of the brake, behind the interface of `TorqueElement`."""

    def __init__(self, plant: PlantParameters, gap_mm: float, dt_s: float) -> None:
        assert plant.pad is not None, "this is the plant of a pad"
        self._dt_s = dt_s
        self._field = GapField(plant, gap_mm)
        self._pad: TactilePad = worked_pad(plant.pad)
        self.warmth = Warmth(plant)
        self.force_N = 0.0

    @property
    def kinetic_N(self) -> float:
        return self.force_N

    def advance(self, time_s: float, gap_mm: float, depth_mm: float, speed_mm_s: float) -> None:
        """Advance by one step that ends at `time_s` and `gap_mm`."""
        field_mT = MT_PER_TM * self._field.advance(gap_mm)
        depth_mm = min(max(depth_mm, 0.0), DEEPEST_MM)
        speed_mm_s = min(max(speed_mm_s, -FASTEST_MM_S), FASTEST_MM_S)
        self.force_N = self.warmth.advance(time_s) * self._pad.advance(self._dt_s, depth_mm, speed_mm_s, field_mT)
