"""How the elastomer warms while the device works, and what that does to its force."""

import math
from typing import Final, final

from tormagd.simulation.parameters import PlantParameters


@final
class Warmth:
    """Temperature of the elastomer, which rises exponentially from the ambient to the warmest."""

    def __init__(self, plant: PlantParameters) -> None:
        self._force_per_K: Final = plant.thermal.force_percent_K / 100.0
        self._ambient_C: Final = plant.assumed.ambient_C
        self._warming_K: Final = plant.assumed.warm_C - plant.assumed.ambient_C
        self._drift_K_s: Final = plant.thermal.drift_K_h / 3600.0
        self.temperature_C = self._ambient_C

    def advance(self, time_s: float) -> float:
        """Set `temperature_C` at `time_s`, and return the factor on a cool elastomer's force."""
        if self._warming_K > 0.0:
            self.temperature_C = self._ambient_C - self._warming_K * math.expm1(
                -self._drift_K_s * time_s / self._warming_K
            )
        return 1.0 + self._force_per_K * (self.temperature_C - self._ambient_C)
