"""The torque element: from the magnets' gap and the handle's motion to the friction force at the roller.

The chain is richer than any model the controller uses: field with hysteresis, elastomer, relaxation, temperature,
pre-sliding friction with a Stribeck level.
"""

import math
from typing import Final, final

from tormagd.physics.friction import Friction
from tormagd.physics.relaxation import PronySeries
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import force_over_moment, moment_over_gap

SMALLEST_GAP_MM: Final = 45.0


@final
class Element:
    """State of the element: the field's branch, the elastomer's memory, the bristles, the temperature.

    Advances in equal steps of `dt_s`. `force_N` is the rendered force, the friction at the roller surface as a torque
    sensor feels it: positive resists positive motion, negative resists negative motion, and just after a reversal the
    bristles still point the old way. `kinetic_N`, never negative, is the level it slides at. Raises
    tormagd.physics.errors.DomainError when the parameters leave the force law's domain somewhere in the stroke.
    """

    __slots__ = (
        "_ambient_C",
        "_branch_Tm",
        "_deflection_mm",
        "_drift_K_s",
        "_dt_s",
        "_force",
        "_force_per_K",
        "_friction",
        "_lag_Tm",
        "_memory",
        "_moment",
        "_moment_Tm",
        "_relax",
        "_turn_Tm",
        "_warming_K",
        "force_N",
        "kinetic_N",
        "temperature_C",
    )

    def __init__(self, plant: PlantParameters, gap_mm: float, dt_s: float) -> None:
        self._dt_s = dt_s
        self._moment = moment_over_gap(plant)
        largest_Tm = self._moment.at(SMALLEST_GAP_MM)
        self._branch_Tm = plant.field.hysteresis_percent / 100.0 * largest_Tm
        self._turn_Tm = plant.assumed.hysteresis_scale * largest_Tm
        weakest_Tm = self._moment.at(2.0 * plant.open_stop_mm) - self._branch_Tm
        strongest_Tm = self._moment.at(2.0 * plant.closed_stop_mm) + self._branch_Tm
        self._force = force_over_moment(plant, weakest_Tm, strongest_Tm)
        friction = plant.friction
        self._friction = Friction(
            presliding_stiffness_N_mm=friction.presliding_stiffness_N_mm,
            viscous_N_s_mm=friction.viscous_N_s_mm,
            static_ratio=friction.static_to_kinetic,
            stribeck_speed_mm_s=friction.stribeck_speed_mm_s,
        )
        self._force_per_K = plant.thermal.force_percent_K / 100.0
        self._ambient_C = plant.assumed.ambient_C
        self._warming_K = plant.assumed.warm_C - plant.assumed.ambient_C
        self._drift_K_s = plant.thermal.drift_K_h / 3600.0
        series = PronySeries(plant.relaxation.fractions, plant.relaxation.times_s)
        self._relax = series.discretise(dt_s)

        self.temperature_C = self._ambient_C
        self._moment_Tm = self._moment.at(gap_mm)
        self._lag_Tm = 0.0
        # the device has been standing at this gap for long before the power came
        self._memory = series.relaxed(self._force.at(self._moment_Tm))
        self._deflection_mm = 0.0
        self.force_N = 0.0
        self.kinetic_N, self._memory = self._relax.advance(self._memory, self._memory[0])

    def advance(self, time_s: float, gap_mm: float, speed_mm_s: float) -> None:
        """One step that ends at that time, at that gap, with the handle at that mean speed."""
        moment_Tm = self._moment.at(gap_mm)
        change_Tm = moment_Tm - self._moment_Tm
        if change_Tm != 0.0:
            # rate-independent: the lag moves along |change| towards the branch that change leads to
            branch_Tm = -self._branch_Tm if change_Tm > 0.0 else self._branch_Tm
            self._lag_Tm += (self._lag_Tm - branch_Tm) * math.expm1(-abs(change_Tm) / self._turn_Tm)
            self._moment_Tm = moment_Tm
        if self._warming_K > 0.0:
            self.temperature_C = self._ambient_C - self._warming_K * math.expm1(
                -self._drift_K_s * time_s / self._warming_K
            )
        warm = 1.0 + self._force_per_K * (self.temperature_C - self._ambient_C)
        driving_N = self._force.at(moment_Tm + self._lag_Tm) * warm
        relaxed_N, self._memory = self._relax.advance(self._memory, driving_N)
        # relaxing from a high force may pull the insert off the shaft, but never push the handle on
        self.kinetic_N = max(relaxed_N, 0.0)
        self.force_N, self._deflection_mm = self._friction.advance(
            self._deflection_mm, speed_mm_s, self.kinetic_N, self._dt_s
        )
