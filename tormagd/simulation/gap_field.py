"""The field between the magnets: their moment over the gap, with the branch that hysteresis leaves it on."""

import math
from typing import Final, final

from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import moment_over_gap

SMALLEST_GAP_MM: Final = 45.0


@final
class GapField:
    """Radial moment of a plant's magnets, with rate-independent hysteresis of at most `branch_Tm` either way."""

    def __init__(self, plant: PlantParameters, gap_mm: float) -> None:
        self.static: Final = moment_over_gap(plant)
        "Without hysteresis."
        largest_Tm = self.static.at(SMALLEST_GAP_MM)
        self.branch_Tm: Final = plant.field.hysteresis_percent / 100.0 * largest_Tm
        self._turn_Tm: Final = plant.assumed.hysteresis_scale * largest_Tm
        self._moment_Tm = self.static.at(gap_mm)
        self._lag_Tm = 0.0

    @property
    def moment_Tm(self) -> float:
        return self._moment_Tm + self._lag_Tm

    def advance(self, gap_mm: float) -> float:
        moment_Tm = self.static.at(gap_mm)
        change_Tm = moment_Tm - self._moment_Tm
        if change_Tm != 0.0:
            # rate-independent: the lag moves along |change| towards the branch that change leads to
            branch_Tm = -self.branch_Tm if change_Tm > 0.0 else self.branch_Tm
            self._lag_Tm += (self._lag_Tm - branch_Tm) * math.expm1(-abs(change_Tm) / self._turn_Tm)
            self._moment_Tm = moment_Tm
        return moment_Tm + self._lag_Tm
