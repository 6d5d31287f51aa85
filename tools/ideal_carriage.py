"""The ideal carriages of a device: how fast its motors drive the gap, and what force a gap brakes.

Motors by their torque-speed line and current limit, friction of gearbox, screw and guide, the magnets' pull: the laws
of the simulated axis (`tormagd/simulation/axis.py`), both carriages together. Left out is what only holds them back:
windings, backlash, the field's hysteresis, the bristles of friction, sensors, the exchange. So no controller drives
this device's gap faster.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tormagd.physics.friction import Friction
from tormagd.physics.relaxation import PronySeries
from tormagd.simulation.curve import Curve
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import force_over_moment, pull_over_gap, radial_moment_Tm

Array = npt.NDArray[np.float64]


GRID_MM = 2e-3
"Of the force over the gap."


class Drive(NamedTuple):
    """What moves the gap, as accelerations of the gap, mm/s^2; opening is positive.

    Full voltage gives `stall_mm_s2` at rest and `per_s` less for each mm/s, the current limit no more than
    `most_mm_s2`. Against it stand the gearbox's friction `gear_mm_s2`, a share `mesh_loss` of all beyond that, the
    magnets' pull, `pull_mm_s2_N` for each newton, and the guides' drag; `screw_friction` of the last two together is
    friction besides. Whatever is friction brakes too.
    """

    stall_mm_s2: float
    per_s: float
    most_mm_s2: float
    gear_mm_s2: float = 0.0
    mesh_loss: float = 0.0
    screw_friction: float = 0.0
    drag_mm_s2: float = 0.0
    pull_mm_s2_N: float = 0.0
    pull_N: Curve = Curve([0.0, 0.0], 0.0, 1.0)

    def highest_mm_s(self, gap_mm: float, speed_mm_s: float, dt_s: float) -> float:
        """The largest speed `dt_s` after that gap and speed; `dt_s` at most 1 / per_s."""
        return self._sped_up(self.pull_mm_s2_N * self.pull_N.at(gap_mm), speed_mm_s, dt_s)

    def lowest_mm_s(self, gap_mm: float, speed_mm_s: float, dt_s: float) -> float:
        """The smallest speed `dt_s` after that gap and speed: seen in a mirror, the pull drives instead of loading."""
        return -self._sped_up(-self.pull_mm_s2_N * self.pull_N.at(gap_mm), -speed_mm_s, dt_s)

    def _sped_up(self, load_mm_s2: float, speed_mm_s: float, dt_s: float) -> float:
        if speed_mm_s < 0.0:
            braking = self._acceleration(load_mm_s2, speed_mm_s, -1.0)
            if speed_mm_s + braking * dt_s <= 0.0:
                return speed_mm_s + braking * dt_s
            # it turns within the step, and what is left of that speeds it up
            dt_s += speed_mm_s / braking
            speed_mm_s = 0.0
        # it stands where nothing is left over to start with: friction holds it
        return max(speed_mm_s + self._acceleration(load_mm_s2, speed_mm_s, 1.0) * dt_s, 0.0)

    def _acceleration(self, load_mm_s2: float, speed_mm_s: float, direction: float) -> float:
        driving = min(self.stall_mm_s2 - self.per_s * speed_mm_s, self.most_mm_s2)
        nut = load_mm_s2 + direction * self.drag_mm_s2
        friction = self.gear_mm_s2 + self.screw_friction * abs(nut)
        friction += self.mesh_loss * max(driving - self.gear_mm_s2, 0.0)
        return driving - nut - direction * friction


class Brake(NamedTuple):
    """What the gap brakes while the handle slides: the forces of the fresh, cool insert, `fresh_N`, over rising gaps
    from closed to open, `gap_mm`; what relaxes of them, and where the insert has rested for long before; friction.
    """

    gap_mm: Array
    fresh_N: Array
    relaxation: PronySeries
    rested_mm: float
    friction: Friction

    def sliding_N(self, kinetic_N: float, hand_mm_s: float) -> float:
        """The force at that level of kinetic friction, at that speed of the handle."""
        return self.friction.level_N(hand_mm_s, kinetic_N) + self.friction.viscous_N_s_mm * abs(hand_mm_s)


def drive_of(plant: PlantParameters) -> Drive:
    """The drive of a device."""
    motor, gear, screw = plant.motor, plant.gear, plant.screw
    lead_m_rad = screw.lead_mm * 1e-3 / math.tau
    coupling_Nm_A = gear.ratio * motor.back_emf_V_s_rad
    inertia_kg_m2 = motor.inertia_kg_m2 * gear.ratio**2
    # each of the two carriages makes half of the gap's speed
    each_Nm = 2e3 * lead_m_rad / inertia_kg_m2
    return Drive(
        stall_mm_s2=each_Nm * coupling_Nm_A * plant.electronics.supply_V / motor.resistance_Ohm,
        per_s=coupling_Nm_A**2 / motor.resistance_Ohm / inertia_kg_m2,
        most_mm_s2=each_Nm * coupling_Nm_A * plant.electronics.current_limit_A,
        gear_mm_s2=each_Nm * gear.output_friction_Nm,
        mesh_loss=1.0 - gear.efficiency,
        screw_friction=screw.friction_coefficient * 0.5e-3 * plant.assumed.screw_mean_diameter_mm / lead_m_rad,
        drag_mm_s2=each_Nm * lead_m_rad * 0.5 * (screw.drag_left_N + screw.drag_right_N),
        pull_mm_s2_N=each_Nm * lead_m_rad,
        pull_N=pull_over_gap(plant),
    )


def brake_of(plant: PlantParameters) -> Brake:
    """The brake of a device, between its switches."""
    assumed, friction = plant.assumed, plant.friction
    closed_mm, open_mm = 2.0 * assumed.closed_mm, 2.0 * assumed.home_mm
    gap_mm = np.linspace(closed_mm, open_mm, math.ceil((open_mm - closed_mm) / GRID_MM) + 1)
    moment_Tm = radial_moment_Tm(gap_mm, plant)
    force = force_over_moment(plant, float(moment_Tm.min()), float(moment_Tm.max()))
    return Brake(
        gap_mm,
        np.array([force.at(moment) for moment in moment_Tm.tolist()]),
        PronySeries(plant.relaxation.fractions, plant.relaxation.times_s),
        assumed.start_left_mm + assumed.start_right_mm,
        Friction(
            presliding_stiffness_N_mm=friction.presliding_stiffness_N_mm,
            viscous_N_s_mm=friction.viscous_N_s_mm,
            static_ratio=friction.static_to_kinetic,
            stribeck_speed_mm_s=friction.stribeck_speed_mm_s,
        ),
    )
