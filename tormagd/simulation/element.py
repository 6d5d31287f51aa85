"""The torque element: from the magnets' gap and the handle's motion to the friction force at the roller.

The chain is richer than any model the controller uses: field with hysteresis, elastomer, relaxation, temperature,
pre-sliding friction with a Stribeck level.
"""

import math
from typing import Final, final

from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import force_over_moment, moment_over_gap

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


@final
class TorqueElement:
    """Friction of insert and shaft, with its state: magnetic branch, relaxation, bristles, temperature."""

    def __init__(self, plant: PlantParameters, gap_mm: float, dt_s: float) -> None:
        self._dt_s = dt_s
        self._field = GapField(plant, gap_mm)
        weakest_Tm = self._field.static.at(2.0 * plant.open_stop_mm) - self._field.branch_Tm
        strongest_Tm = self._field.static.at(2.0 * plant.closed_stop_mm) + self._field.branch_Tm
        self._force = force_over_moment(plant, weakest_Tm, strongest_Tm)
        self._friction = plant.friction.law
        self.warmth = Warmth(plant)
        series = plant.relaxation.law
        self._relax = series.discretise(dt_s)

        # the device has been at this gap for long before the power came
        self._memory = series.relaxed(self._force.at(self._field.moment_Tm))
        self._deflection_mm = 0.0
        self.force_N = 0.0
        self.kinetic_N, self._memory = self._relax.advance(self._memory, self._memory[0])

    def advance(self, time_s: float, gap_mm: float, speed_mm_s: float) -> None:
        self.prepare(time_s, gap_mm)
        self.slide(speed_mm_s)

    def prepare(self, time_s: float, gap_mm: float) -> None:
        """Begin a step that ends at `time_s` and `gap_mm`: advance all but the bristles."""
        moment_Tm = self._field.advance(gap_mm)
        driving_N = self._force.at(moment_Tm) * self.warmth.advance(time_s)
        relaxed_N, self._memory = self._relax.advance(self._memory, driving_N)
        # relaxing from a high force may pull the insert off the shaft, but never push the handle on
        self.kinetic_N = max(relaxed_N, 0.0)

    def resisting_N(self, speed_mm_s: float) -> float:
        """Return the friction with which the step would end at this speed."""
        return self._friction.advance(self._deflection_mm, speed_mm_s, self.kinetic_N, self._dt_s)[0]

    def slide(self, speed_mm_s: float) -> None:
        self.force_N, self._deflection_mm = self._friction.advance(
            self._deflection_mm, speed_mm_s, self.kinetic_N, self._dt_s
        )
