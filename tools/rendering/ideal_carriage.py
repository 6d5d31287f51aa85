"""The ideal carriages of a device: how fast its motors drive the gap, and what force a gap brakes.

Motors by their torque-speed line and current limit, friction of gearbox, screw and guide, the magnets' pull: the laws
of the simulated axis (`tormagd/simulation/axis.py`), both carriages together. Left out is what only holds them back:
windings, backlash, the bristles of friction, sensors, the exchange. So no controller drives this device's gap faster.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tormagd.physics.friction import Friction
from tormagd.physics.relaxation import PronySeries
from tormagd.simulation.curve import Curve
from tormagd.simulation.gap_field import SMALLEST_GAP_MM
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import MOMENT_POINTS, force_over_moment, pull_over_gap, radial_moment_Tm

Array = npt.NDArray[np.float64]


GRID_MM = 2e-3
"Of the moment over the gap."
NEWTON_STEPS = 6
LEAST_GAIN = 0.1
"Of the field on the gap, just turned round."


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
    """What the gap brakes while the handle slides.

    A gap gives a moment of the field (`moment_Tm` over `gap_mm`, from closed to open), which lags behind while it
    changes: up to `branch_Tm`, and by most of that within a change of `turn_Tm`. Moment and lag together give the force
    of the fresh, cool insert (`fresh_N` over `strength_Tm`), part of which relaxes; friction makes of it what is felt.
    `rested_mm` is the gap at which the insert has rested before.
    """

    gap_mm: Array
    moment_Tm: Array
    branch_Tm: float
    turn_Tm: float
    strength_Tm: Array
    fresh_N: Array
    relaxation: PronySeries
    rested_mm: float
    friction: Friction

    def sliding_N(self, kinetic_N: float, hand_mm_s: float) -> float:
        """The force at that level of kinetic friction, at that speed of the handle."""
        return self.friction.level_N(hand_mm_s, kinetic_N) + self.friction.viscous_N_s_mm * abs(hand_mm_s)

    def fresh_at_N(self, moment_Tm: float, lag_Tm: float = 0.0) -> float:
        """The force of the fresh insert at a moment and its lag."""
        return float(np.interp(moment_Tm + lag_Tm, self.strength_Tm, self.fresh_N))

    def open_N(self, hand_mm_s: float) -> float:
        """What the open gap brakes with its element fresh."""
        return self.sliding_N(self.fresh_at_N(float(self.moment_Tm[-1])), hand_mm_s)

    def lag_after_Tm(self, lag_Tm: float, change_Tm: float) -> float:
        """The lag once the moment has changed by that much, one way."""
        branch_Tm = math.copysign(self.branch_Tm, -change_Tm)
        return branch_Tm + (lag_Tm - branch_Tm) * math.exp(-abs(change_Tm) / self.turn_Tm)

    def lags_Tm(self, moments_Tm: Array) -> Array:
        """The lag of every moment of a series, before whose first the gap was open."""
        lag_Tm, before_Tm = self.branch_Tm, float(self.moment_Tm[-1])
        found = []
        for moment_Tm in moments_Tm.tolist():
            if moment_Tm != before_Tm:
                lag_Tm = self.lag_after_Tm(lag_Tm, moment_Tm - before_Tm)
                before_Tm = moment_Tm
            found.append(lag_Tm)
        return np.array(found)

    def moment_for_Tm(self, strength_Tm: float, moment_Tm: float, lag_Tm: float) -> float:
        """The moment that makes that strength, from a moment and its lag: Newton's method along the branch."""
        wanted_Tm = moment_Tm
        for _ in range(NEWTON_STEPS):
            change_Tm = wanted_Tm - moment_Tm
            short_Tm = strength_Tm - wanted_Tm - self.lag_after_Tm(lag_Tm, change_Tm)
            # where it stands still, the branch is the one that leads there
            branch_Tm = math.copysign(self.branch_Tm, -(change_Tm or short_Tm))
            fading = abs(lag_Tm - branch_Tm) * math.exp(-abs(change_Tm) / self.turn_Tm) / self.turn_Tm
            wanted_Tm += short_Tm / max(1.0 - fading, LEAST_GAIN)
        return wanted_Tm


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
    moment_Tm = np.asarray(radial_moment_Tm(gap_mm, plant), dtype=np.float64)
    largest_Tm = float(radial_moment_Tm(np.array([SMALLEST_GAP_MM]), plant)[0])
    branch_Tm = plant.field.hysteresis_percent / 100.0 * largest_Tm
    weakest_Tm, strongest_Tm = float(moment_Tm[-1]) - branch_Tm, float(moment_Tm[0]) + branch_Tm
    force = force_over_moment(plant, weakest_Tm, strongest_Tm)
    strength_Tm = np.linspace(weakest_Tm, strongest_Tm, MOMENT_POINTS)
    return Brake(
        gap_mm,
        moment_Tm,
        branch_Tm,
        assumed.hysteresis_scale * largest_Tm,
        strength_Tm,
        np.array([force.at(strength) for strength in strength_Tm.tolist()]),
        PronySeries(plant.relaxation.fractions, plant.relaxation.times_s),
        assumed.start_left_mm + assumed.start_right_mm,
        Friction(
            presliding_stiffness_N_mm=friction.presliding_stiffness_N_mm,
            viscous_N_s_mm=friction.viscous_N_s_mm,
            static_ratio=friction.static_to_kinetic,
            stribeck_speed_mm_s=friction.stribeck_speed_mm_s,
        ),
    )
