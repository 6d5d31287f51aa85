"""What a pad has been through before it is used: cycles without field, after which it does not change any more."""

import numpy as np
from numpy.typing import NDArray

from tormagd.simulation.parameters import PadParameters
from tormagd.simulation.tactile_pad import FULL_INDENTATION_MM, TactilePad

Array = NDArray[np.float64]

TOUCHING_MM = 0.2
"""Where the cycles turn at their open end: plates that leave the pad at every cycle measure air."""
RATES_MM_S = (1.0, 0.5, 4.0, 2.0)
"""Not in order, so that a drift over the record is not mistaken for an effect of the rate."""
CYCLES_PER_RATE = 3
SAMPLES_PER_CYCLE = 175


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


def worked_pad(parameters: PadParameters) -> TactilePad:
    """A pad after ten cycles without field and a rest."""
    pad = TactilePad(parameters)
    time_s, displacement_mm, rate_mm_s, _ = cycling_program(50)
    pad.run(time_s, displacement_mm, rate_mm_s, np.zeros_like(time_s))
    pad.rest()
    return pad
