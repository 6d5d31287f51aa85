"""One carriage of the device: motor, gearbox, lead screw, nut with backlash, guide with drag.

Everything is referred to the gearbox output, the screw, in SI. Positive is opening: away from the centre plane.

Friction is Coulomb friction proper, by time stepping (J. J. Moreau): in each step it takes as much of the momentum as
its impulse can, and the screw truly stands when it can take all. A regularised sign function would creep under the
magnets' pull and hide the question whether the device holds its gap with the power off. Where the screw turns round,
friction changes sides with it within the step; the speed is linear in between. The load of the nut is a step behind.

The carriage is taken as massless: its 0.3 kg at 1 m/s2 are 0.3 N beside some 60 N of attraction.
"""

import math
from typing import Final, final

from tormagd.simulation.parameters import PlantError, PlantParameters

MAX_STEP_SHARE: Final = 0.25
"The samples stay under 0.07."
ROUNDING: Final = 1e-6
"Share of a substep by which sums of time steps may be off."


def lead_m(load_N: float, backlash_m: float, stiffness_N_m: float) -> float:
    """Return how far the nut is ahead of a carriage that loads it so."""
    return (backlash_m if load_N > 0.0 else -backlash_m) + load_N / stiffness_N_m


@final
class Axis:
    """State and laws of one carriage with its drive."""

    def __init__(
        self, plant: PlantParameters, drag_N: float, start_mm: float, attraction_N: float, dt_s: float
    ) -> None:
        motor, gear, screw = plant.motor, plant.gear, plant.screw
        self._dt_s = dt_s
        self._resistance_Ohm = motor.resistance_Ohm
        self._coupling_Nm_A = gear.ratio * motor.back_emf_V_s_rad
        # exact for the mean speed of the step: L/R is under a millisecond
        self._electrical_time_s = motor.inductance_mH * 1e-3 / motor.resistance_Ohm
        self._decay = math.exp(-dt_s / self._electrical_time_s)
        self._remaining = (1.0 - self._decay) * self._electrical_time_s / dt_s
        self._current_limit_A = plant.electronics.current_limit_A
        self._impulse_rad_s_Nm = dt_s / (motor.inertia_kg_m2 * gear.ratio**2)
        self._mesh_loss = 1.0 - gear.efficiency
        self._lead_m_rad = screw.lead_mm * 1e-3 / math.tau
        self.backlash_m = 0.5e-6 * screw.backlash_um
        self._stiffness_N_m = screw.stiffness_N_um * 1e6
        self._closed_stop_m = plant.closed_stop_mm * 1e-3
        self._open_stop_m = plant.open_stop_mm * 1e-3
        spring = self._stiffness_N_m * self._lead_m_rad**2 * self._impulse_rad_s_Nm * dt_s
        braking = self._coupling_Nm_A**2 / motor.resistance_Ohm * self._impulse_rad_s_Nm
        # back-EMF over the step follows the mean of both speeds: the change of speed brakes itself
        self._driven_rad_s_Nm = self._impulse_rad_s_Nm / (1.0 + 0.5 * braking * (1.0 - self._remaining))
        if max(math.sqrt(spring), braking) > MAX_STEP_SHARE:
            raise PlantError(
                f"motor.inertia_kg_m2 = {motor.inertia_kg_m2}: allowed is more, for this screw.stiffness_N_um = "
                f"{screw.stiffness_N_um} and motor.back_emf_V_s_rad = {motor.back_emf_V_s_rad}; a substep of {dt_s} s "
                "would not follow the motion"
            )
        self.gear_friction_Nm = self._new_gear_Nm = gear.output_friction_Nm
        self.screw_friction_m = self._new_screw_m = (
            screw.friction_coefficient * 0.5e-3 * plant.assumed.screw_mean_diameter_mm
        )
        self.drag_N = drag_N
        self.angle_rad = 0.0
        self.speed_rad_s = 0.0
        self.current_A = 0.0
        self.voltage_V: float | None = None
        "At the motor; None: its bridge is open."
        self._early_V = 0.0
        "What earlier voltages add to the mean over the substep that has begun."
        self.position_m = start_mm * 1e-3
        # at power-on the nut carries the whole attraction
        self.contact_N = attraction_N
        self._nut_zero_m = self.position_m + lead_m(attraction_N, self.backlash_m, self._stiffness_N_m)

    @property
    def back_emf_V(self) -> float:
        return self._coupling_Nm_A * self.speed_rad_s

    def wear(self, divisor: float) -> None:
        """Leave gearbox and screw this part of their friction when new."""
        self.gear_friction_Nm, self.screw_friction_m = self._new_gear_Nm / divisor, self._new_screw_m / divisor

    def drive(self, share: float, voltage_V: float | None) -> None:
        """Put another voltage at the motor when this share of a substep has passed."""
        share = float(round(share)) if voltage_V is None else share
        self._early_V += share * (self._applied_V(self.voltage_V) - self._applied_V(voltage_V))
        self.voltage_V = voltage_V

    def mean_V(self) -> float | None:
        """Return the mean voltage over the substep that has begun; the next one begins with the voltage of now."""
        early_V, self._early_V = self._early_V, 0.0
        return None if self.voltage_V is None and not early_V else self._applied_V(self.voltage_V) + early_V

    def _applied_V(self, voltage_V: float | None) -> float:
        return self.back_emf_V if voltage_V is None else voltage_V

    def step(self, voltage_V: float | None, attraction_N: float) -> None:
        # runs four times per simulated millisecond: hence local names
        coupling_Nm_A = self._coupling_Nm_A
        before_rad_s, contact_N = self.speed_rad_s, self.contact_N
        if voltage_V is None:
            drive_Nm, impulse_rad_s_Nm = 0.0, self._impulse_rad_s_Nm
        else:
            settled_A = (voltage_V - coupling_Nm_A * before_rad_s) / self._resistance_Ohm
            start_A, limit_A = self.current_A, self._current_limit_A
            end_A = settled_A + (start_A - settled_A) * self._decay
            if -limit_A <= end_A <= limit_A:
                mean_A = settled_A + (start_A - settled_A) * self._remaining
                impulse_rad_s_Nm = self._driven_rad_s_Nm
            else:
                # straight up to the limit, and held there
                held_A = limit_A if end_A > 0.0 else -limit_A
                mean_A = held_A - 0.5 * (held_A - start_A) ** 2 / (end_A - start_A)
                impulse_rad_s_Nm = self._impulse_rad_s_Nm
            drive_Nm = coupling_Nm_A * mean_A

        gear_friction_Nm, lead_m_rad = self.gear_friction_Nm, self._lead_m_rad
        friction_Nm = gear_friction_Nm + self.screw_friction_m * abs(contact_N)
        transmitted_Nm = abs(drive_Nm) - gear_friction_Nm
        if transmitted_Nm > 0.0:
            friction_Nm += self._mesh_loss * transmitted_Nm
        push_rad_s = (drive_Nm - lead_m_rad * contact_N) * impulse_rad_s_Nm
        grip_rad_s = friction_Nm * impulse_rad_s_Nm
        if before_rad_s:
            against_rad_s = -grip_rad_s if before_rad_s > 0.0 else grip_rad_s
            speed_rad_s = before_rad_s + push_rad_s + against_rad_s
            if (speed_rad_s > 0.0) != (before_rad_s > 0.0):
                # only what pushes harder than friction holds turns it back from there
                back_rad_s = push_rad_s - against_rad_s
                rest = speed_rad_s / (speed_rad_s - before_rad_s)
                speed_rad_s = back_rad_s * rest if (back_rad_s > 0.0) != (before_rad_s > 0.0) else 0.0
        else:
            speed_rad_s = push_rad_s - min(max(push_rad_s, -grip_rad_s), grip_rad_s)
        self.speed_rad_s = speed_rad_s
        mean_rad_s = 0.5 * (before_rad_s + speed_rad_s)
        self.angle_rad = angle_rad = self.angle_rad + self._dt_s * mean_rad_s
        if voltage_V is None:
            self.current_A = 0.0
        else:
            settled_A = (voltage_V - coupling_Nm_A * mean_rad_s) / self._resistance_Ohm
            end_A = settled_A + (start_A - settled_A) * self._decay
            self.current_A = -limit_A if end_A < -limit_A else limit_A if end_A > limit_A else end_A

        # the carriage stands while the guide's drag holds it, else slides to the limit
        nut_m = self._nut_zero_m + angle_rad * lead_m_rad
        drag_N, backlash_m, stiffness_N_m = self.drag_N, self.backlash_m, self._stiffness_N_m
        innermost_m = nut_m - lead_m(attraction_N + drag_N, backlash_m, stiffness_N_m)
        outermost_m = nut_m - lead_m(attraction_N - drag_N, backlash_m, stiffness_N_m)
        position_m = min(max(self.position_m, innermost_m), outermost_m)
        self.position_m = position_m = min(max(position_m, self._closed_stop_m), self._open_stop_m)
        ahead_m = nut_m - position_m
        self.contact_N = stiffness_N_m * (ahead_m - min(max(ahead_m, -backlash_m), backlash_m))

    def shaft_after(self, age_s: float) -> tuple[float, float]:
        """Return the screw's (angle_rad, current_A) at `age_s` after the last step."""
        if age_s < ROUNDING * self._dt_s:
            return self.angle_rad, self.current_A
        speed_rad_s = self.speed_rad_s
        angle_rad = self.angle_rad + age_s * speed_rad_s
        if self.voltage_V is None:
            return angle_rad, 0.0
        voltage_V = self.voltage_V + self._dt_s / age_s * self._early_V
        settled_A = (voltage_V - self._coupling_Nm_A * speed_rad_s) / self._resistance_Ohm
        current_A = settled_A + (self.current_A - settled_A) * math.exp(-age_s / self._electrical_time_s)
        limit_A = self._current_limit_A
        return angle_rad, -limit_A if current_A < -limit_A else limit_A if current_A > limit_A else current_A
