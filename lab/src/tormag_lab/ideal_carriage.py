"""The least error with which a device's carriages can render a force: without delay, and with foresight.

The device is known exactly, by the laws of the simulated axis and element: torque-speed line, current limit, friction,
the magnets' pull, remanence, relaxation. Windings, backlash, bristles, sensors and the exchange only hold the carriages
back and are left out: no controller moves this gap faster. The force is clipped to what the open gap brakes and to the
scenes' greatest. Steps are 1 ms or less.

*Without delay*, a step knows the force at its end and how fast it changes. *With foresight*, the whole signal is known,
and the RMS error is the least that the drive allows, to 2 %. Sequential quadratic programmes find it (Gauss-Newton,
each solved by Clarabel); without the field's lag a search of everything agrees to 0.4 %. A scene's greatest force and
tolerance are judged by these figures.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from tormag_lab.arrays import Array, Json, rms
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.relaxation import PronySeries
from tormagd.ground.force_file import read_forces
from tormagd.scenes.scene import Scene, load_scene, scene_path, shipped_scenes
from tormagd.scenes.signal import asked
from tormagd.simulation.curve import Curve
from tormagd.simulation.element import SMALLEST_GAP_MM
from tormagd.simulation.parameters import PLANTS_INSERT, PlantParameters, SecondParameters, load_plant, with_insert
from tormagd.simulation.second_element import fresh_N, rate_factor, shaft_field_mT
from tormagd.simulation.static_laws import MOMENT_POINTS, force_over_moment, pull_over_gap, radial_moment_Tm

TURNED_MM_S = 42.0
"Speed of the roller's surface at the thesis's 20 rpm."
STEP_S = 1e-3
MAX_N = 2.0
MAX_STEPS = 300_000
ROUNDS = 30
SETTLED = 1e-3
"The rounds end once the RMS error changes by less than this share."
EXACT_N = 1e-6
SECANT_MM_S = 5.0
"A secant, as the limit has a kink at 0."
MIN_BRAKING_MM_S2 = 50.0
SIGNAL_S, SIGNAL_HZ = 5.0, 200
"This much of a scene's signal is enough."


GRID_MM = 2e-3
NEWTON_STEPS = 6
MIN_GAIN = 0.1
"Least slope of the strength over the moment: just after a turn the lag nearly cancels the moment."


class Drive(NamedTuple):
    """Drive of the gap as accelerations; opening is positive. Full voltage gives `stall_mm_s2` at rest and `per_s`
    less for each mm/s. The nut's load is the magnets' pull (`pull_mm_s2_N` for each newton) and the guides' drag, and
    `screw_friction` of it is friction besides."""

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
        """Return the speed after `dt_s` of opening at full voltage against the magnets' pull."""
        return self._sped_up(self.pull_mm_s2_N * self.pull_N.at(gap_mm), speed_mm_s, dt_s)

    def lowest_mm_s(self, gap_mm: float, speed_mm_s: float, dt_s: float) -> float:
        """Return the speed after `dt_s` of closing at full voltage with the magnets' pull."""
        return -self._sped_up(-self.pull_mm_s2_N * self.pull_N.at(gap_mm), -speed_mm_s, dt_s)

    def _sped_up(self, pull_mm_s2: float, speed_mm_s: float, dt_s: float) -> float:
        if speed_mm_s < 0.0:
            braking = self._acceleration(pull_mm_s2, speed_mm_s, -1.0)
            if speed_mm_s + braking * dt_s <= 0.0:
                return speed_mm_s + braking * dt_s
            # the gap turns round within the step, and speeds up for the rest of it
            dt_s += speed_mm_s / braking
            speed_mm_s = 0.0
        # friction holds the gap where no force is left to start it
        return max(speed_mm_s + self._acceleration(pull_mm_s2, speed_mm_s, 1.0) * dt_s, 0.0)

    def _acceleration(self, pull_mm_s2: float, speed_mm_s: float, direction: float) -> float:
        """Return the gap's acceleration at the full voltage that opens, within the current limit."""
        driving = min(self.stall_mm_s2 - self.per_s * speed_mm_s, self.most_mm_s2)
        nut = pull_mm_s2 + direction * self.drag_mm_s2
        friction = self.gear_mm_s2 + self.screw_friction * abs(nut)
        friction += self.mesh_loss * max(driving - self.gear_mm_s2, 0.0)
        return driving - nut - direction * friction


class Lag(NamedTuple):
    """Law of remanence: the field's moment lags by `branch_Tm` while it rises or falls, and most of the lag turns over
    a change by `turn_Tm`."""

    branch_Tm: float
    turn_Tm: float

    def after_Tm(self, lag_Tm: float, change_Tm: float) -> float:
        """Return the lag after the moment has changed by `change_Tm` in one direction."""
        branch_Tm = math.copysign(self.branch_Tm, -change_Tm)
        return branch_Tm + (lag_Tm - branch_Tm) * math.exp(-abs(change_Tm) / self.turn_Tm)

    def along_Tm(self, moments_Tm: Array, lag_Tm: float, before_Tm: float) -> Array:
        """Return the lag (n) along `moments_Tm` (n), which begin at `before_Tm` with the lag `lag_Tm`."""
        found = []
        for moment_Tm in moments_Tm.tolist():
            if moment_Tm != before_Tm:
                lag_Tm = self.after_Tm(lag_Tm, moment_Tm - before_Tm)
                before_Tm = moment_Tm
            found.append(lag_Tm)
        return np.array(found)


def lag_of(plant: PlantParameters) -> Lag:
    largest_Tm = float(radial_moment_Tm(np.array([SMALLEST_GAP_MM]), plant)[0])
    return Lag(plant.field.hysteresis_percent / 100.0 * largest_Tm, plant.assumed.hysteresis_scale * largest_Tm)


class Brake(NamedTuple):
    """Force of the gap while the handle slides. A gap gives a moment of the field, which lags. Moment and lag
    together, the strength, give the force of the fresh insert, part of which relaxes. `sliding_N` makes the felt force
    of a kinetic level, N, and the handle's speed, mm/s."""

    gap_mm: Array
    moment_Tm: Array
    lag: Lag
    strength_Tm: Array
    fresh_N: Array
    relaxation: PronySeries
    rested_mm: float
    sliding_N: Callable[[float, float], float]

    def fresh_at_N(self, moment_Tm: float, lag_Tm: float = 0.0) -> float:
        return float(np.interp(moment_Tm + lag_Tm, self.strength_Tm, self.fresh_N))

    def open_N(self, hand_mm_s: float) -> float:
        return self.sliding_N(self.fresh_at_N(float(self.moment_Tm[-1])), hand_mm_s)

    def felt(self, hand_mm_s: float) -> tuple[float, float]:
        """Return the offset, N, and the scale that turn a kinetic level into the felt force."""
        offset_N = self.sliding_N(0.0, hand_mm_s)
        return offset_N, self.sliding_N(1.0, hand_mm_s) - offset_N

    def lags_Tm(self, moments_Tm: Array) -> Array:
        """Return the lag (n) along moments (n), of a gap that had been opened before."""
        return self.lag.along_Tm(moments_Tm, self.lag.branch_Tm, float(self.moment_Tm[-1]))

    def moment_for_Tm(self, strength_Tm: float, moment_Tm: float, lag_Tm: float) -> float:
        """Return the moment that together with its lag makes `strength_Tm`, coming from `moment_Tm` and `lag_Tm`."""
        wanted_Tm = moment_Tm
        for _ in range(NEWTON_STEPS):
            change_Tm = wanted_Tm - moment_Tm
            short_Tm = strength_Tm - wanted_Tm - self.lag.after_Tm(lag_Tm, change_Tm)
            # at a standstill, take the branch that leads to the wanted strength
            branch_Tm = math.copysign(self.lag.branch_Tm, -(change_Tm or short_Tm))
            fading = abs(lag_Tm - branch_Tm) * math.exp(-abs(change_Tm) / self.lag.turn_Tm) / self.lag.turn_Tm
            wanted_Tm += short_Tm / max(1.0 - fading, MIN_GAIN)
        return wanted_Tm


def drive_of(plant: PlantParameters) -> Drive:
    """Return the drive of both carriages together, with the mean of the guides' drag."""
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
    """Tabulate the brake between the plant's stops."""
    assumed = plant.assumed
    closed_mm, open_mm = 2.0 * assumed.closed_mm, 2.0 * assumed.home_mm
    gap_mm = np.linspace(closed_mm, open_mm, math.ceil((open_mm - closed_mm) / GRID_MM) + 1)
    if plant.second is not None:
        return _second_brake(gap_mm, plant, plant.second)
    moment_Tm, lag = np.asarray(radial_moment_Tm(gap_mm, plant), dtype=np.float64), lag_of(plant)
    weakest_Tm, strongest_Tm = float(moment_Tm[-1]) - lag.branch_Tm, float(moment_Tm[0]) + lag.branch_Tm
    force = force_over_moment(plant, weakest_Tm, strongest_Tm)
    strength_Tm = np.linspace(weakest_Tm, strongest_Tm, MOMENT_POINTS)
    friction = plant.friction.law
    return Brake(
        gap_mm,
        moment_Tm,
        lag,
        strength_Tm,
        np.array([force.at(strength) for strength in strength_Tm.tolist()]),
        plant.relaxation.law,
        assumed.start_left_mm + assumed.start_right_mm,
        lambda kinetic_N, hand_mm_s: friction.level_N(hand_mm_s, kinetic_N) + friction.viscous_N_s_mm * abs(hand_mm_s),
    )


def _second_brake(gap_mm: Array, plant: PlantParameters, second: SecondParameters) -> Brake:
    """Approximate the second plant: a field in T stands for the moment, exponentials for creep and play."""
    field_T = np.array([1e-3 * shaft_field_mT(gap, plant, second.concentration) for gap in gap_mm.tolist()])
    shares_T = [1e-3 * share * half_mT for share, half_mT in zip(second.play_shares, second.play_mT, strict=True)]
    branch_T = sum(shares_T, 0.0)
    strength_T = np.linspace(float(field_T[-1]) - branch_T, float(field_T[0]) + branch_T, MOMENT_POINTS)
    return Brake(
        gap_mm,
        field_T,
        Lag(branch_T, 1e-3 * max(second.play_mT)),
        strength_T,
        np.array([fresh_N(1e3 * strength, second) for strength in strength_T.tolist()]),
        PronySeries((second.creeping_share,), (second.creep_s,)),
        plant.assumed.start_left_mm + plant.assumed.start_right_mm,
        lambda kinetic_N, hand_mm_s: (
            kinetic_N * rate_factor(hand_mm_s, second.renewed_mm / max(hand_mm_s, second.slow_mm_s), second)
        ),
    )


class Asked(NamedTuple):
    """A force in even steps, clipped to what can be asked, and the field strength that gives it. `scale`, `offset_N`
    and `relaxed_N` turn the fresh insert's force into the rendered one."""

    force_N: Array
    strength_Tm: Array
    relaxed_N: Array
    scale: float
    offset_N: float

    def rendered_N(self, brake: Brake, gap_mm: Array) -> Array:
        moment_Tm = np.interp(gap_mm, brake.gap_mm, brake.moment_Tm)
        fresh_N = np.interp(moment_Tm + brake.lags_Tm(moment_Tm), brake.strength_Tm, brake.fresh_N)
        return self.scale * (fresh_N - self.relaxed_N) + self.offset_N


class Bound(NamedTuple):
    """The asked force, clipped, and what ideal carriages render of it, in even steps."""

    time_s: Array
    asked_N: Array
    no_delay_N: Array
    foresight_N: Array

    def figures(self, start_s: float = -math.inf) -> Json:
        inside = self.time_s >= start_s
        asked_N = self.asked_N[inside]
        return {
            "sd_N": float(asked_N.std()),
            "no_delay_rms_N": rms(self.no_delay_N[inside] - asked_N),
            "foresight_rms_N": rms(self.foresight_N[inside] - asked_N),
        }


def bound(
    plant: PlantParameters,
    time_s: Array,
    force_N: Array,
    *,
    step_s: float = STEP_S,
) -> Bound:
    steps = (time_s[-1] - time_s[0]) / step_s
    if not 2.0 <= steps <= MAX_STEPS:
        raise DomainError("t_s", f"{time_s[0]} .. {time_s[-1]}", f"2 to {MAX_STEPS} steps of {step_s:g} s")
    axis_s = time_s[0] + step_s * np.arange(math.floor(steps + 1e-6) + 1)
    wanted_N = np.interp(axis_s, time_s, force_N)
    brake, drive = brake_of(plant), drive_of(plant)
    asked = asked_of(brake, wanted_N, most_N=MAX_N, hand_mm_s=TURNED_MM_S, step_s=step_s)
    greedy_mm = no_delay_mm(drive, brake, asked, step_s)
    best_mm = foresight_mm(drive, brake, asked, step_s)
    return Bound(axis_s, asked.force_N, asked.rendered_N(brake, greedy_mm), asked.rendered_N(brake, best_mm))


def asked_of(brake: Brake, force_N: Array, *, most_N: float, hand_mm_s: float, step_s: float) -> Asked:
    """Clip the force (n) to the device's range and `most_N`, and find the relaxation while exactly that is rendered."""
    offset_N, scale = brake.felt(hand_mm_s)
    # a gap that was opened brakes a little more than one that was never closed
    least_N = brake.fresh_at_N(float(brake.moment_Tm[-1]), brake.lag.branch_Tm)
    greatest_N = brake.fresh_at_N(float(brake.moment_Tm[0]), -brake.lag.branch_Tm)
    series = brake.relaxation
    rested_Tm = float(np.interp(brake.rested_mm, brake.gap_mm, brake.moment_Tm))
    relax, memory = series.discretise(step_s), series.relaxed(brake.fresh_at_N(rested_Tm))
    relaxed_N = sum(series.fractions, 0.0) * memory[0]
    rendered, relaxed = [], []
    for wanted_N in force_N.tolist():
        fresh_N = min(max((min(wanted_N, most_N) - offset_N) / scale + relaxed_N, least_N), greatest_N)
        kinetic_N, memory = relax.advance(memory, fresh_N)
        relaxed_N = fresh_N - kinetic_N
        relaxed.append(relaxed_N)
        rendered.append(scale * kinetic_N + offset_N)
    fresh = (np.array(rendered) - offset_N) / scale + np.array(relaxed)
    return Asked(
        np.array(rendered), np.interp(fresh, brake.fresh_N, brake.strength_Tm), np.array(relaxed), scale, offset_N
    )


def no_delay_mm(drive: Drive, brake: Brake, asked: Asked, step_s: float) -> Array:
    gaps_mm, moments_Tm = brake.gap_mm[::-1], brake.moment_Tm[::-1]
    moment_Tm, lag_Tm = float(brake.moment_Tm[-1]), brake.lag.branch_Tm

    def wanted_mm(strength_Tm: float) -> float:
        return float(np.interp(brake.moment_for_Tm(strength_Tm, moment_Tm, lag_Tm), moments_Tm, gaps_mm))

    strengths_Tm = asked.strength_Tm.tolist()
    before_Tm, gap_mm, speed_mm_s = strengths_Tm[0], wanted_mm(strengths_Tm[0]), 0.0
    found: list[float] = []
    for now_Tm in strengths_Tm:
        if found:
            highest = drive.highest_mm_s(gap_mm, speed_mm_s, step_s)
            lowest = drive.lowest_mm_s(gap_mm, speed_mm_s, step_s)
            target_mm = wanted_mm(before_Tm)
            moves_mm_s, behind_mm = (wanted_mm(now_Tm) - target_mm) / step_s, target_mm - gap_mm
            # the fastest approach that can still brake to the target's own speed within the remaining way
            towards = math.copysign(1.0, behind_mm)
            faster_mm_s = min(max(moves_mm_s, lowest), highest) + towards * SECANT_MM_S
            slowed = drive.lowest_mm_s if behind_mm > 0.0 else drive.highest_mm_s
            braking = towards * (faster_mm_s - slowed(gap_mm, faster_mm_s, step_s)) / step_s
            change = max(braking, MIN_BRAKING_MM_S2) * step_s
            closing = (math.sqrt(change * change + 8.0 * change * abs(behind_mm) / step_s) - change) / 2.0
            wanted_mm_s = moves_mm_s + towards * min(closing, abs(behind_mm) / step_s)
            speed_mm_s = min(max(wanted_mm_s, lowest), highest)
            gap_mm += speed_mm_s * step_s
        found.append(gap_mm)
        arrived_Tm = float(np.interp(gap_mm, brake.gap_mm, brake.moment_Tm))
        if arrived_Tm != moment_Tm:
            lag_Tm = brake.lag.after_Tm(lag_Tm, arrived_Tm - moment_Tm)
        moment_Tm, before_Tm = arrived_Tm, now_Tm
    return np.array(found)


def foresight_mm(drive: Drive, brake: Brake, asked: Asked, step_s: float) -> Array:
    """Return the gap (n) with the least RMS error of force that the drive allows."""
    steps = len(asked.force_N)
    slope_Tm_mm = np.gradient(brake.moment_Tm, brake.gap_mm)
    slope_N_Tm = asked.scale * np.gradient(brake.fresh_N, brake.strength_Tm)
    gap_mm = np.full(steps, float(np.interp(-asked.strength_Tm.mean(), -brake.moment_Tm, brake.gap_mm)))
    no_load_mm_s = drive.stall_mm_s2 / drive.per_s
    differ = sparse.diags([-1.0, 1.0], [0, 1], shape=(steps - 1, steps), format="csr")
    earlier, later, gaps = differ[:-1], differ[1:], sparse.identity(steps, format="csr")
    last_N, radius_mm = math.inf, float(np.ptp(brake.gap_mm))
    for _ in range(ROUNDS):
        speeds_mm_s = np.diff(gap_mm) / step_s
        highest, highest_slope = _reached(drive.highest_mm_s, gap_mm, speeds_mm_s, step_s)
        lowest, lowest_slope = _reached(drive.lowest_mm_s, gap_mm, speeds_mm_s, step_s)
        limits = [
            (later - sparse.diags(highest_slope) @ earlier, (highest - speeds_mm_s[1:]) * step_s),
            (sparse.diags(lowest_slope) @ earlier - later, (speeds_mm_s[1:] - lowest) * step_s),
            # the first speed has no predecessor
            (differ[:1], (no_load_mm_s - speeds_mm_s[:1]) * step_s),
            (-differ[:1], (no_load_mm_s + speeds_mm_s[:1]) * step_s),
            (gaps, np.minimum(brake.gap_mm[-1] - gap_mm, radius_mm)),
            (-gaps, np.minimum(gap_mm - brake.gap_mm[0], radius_mm)),
        ]
        moment_Tm = np.interp(gap_mm, brake.gap_mm, brake.moment_Tm)
        lag_Tm = brake.lags_Tm(moment_Tm)
        turned = np.interp(gap_mm, brake.gap_mm, slope_Tm_mm)
        felt = np.interp(moment_Tm + lag_Tm, brake.strength_Tm, slope_N_Tm)
        # in millimetres of gap, so that gaps and lags are of one size
        unit_Tm = float(np.abs(turned).max())
        error_N = asked.rendered_N(brake, gap_mm) - asked.force_N
        sensed = sparse.hstack([sparse.diags(felt * turned), sparse.diags(felt * unit_Tm)], format="csc")
        followed = sparse.hstack([*_lagging(brake, moment_Tm, lag_Tm, turned / unit_Tm)], format="csc")
        moved_mm = _least_squares(sensed, error_N, followed, limits)[:steps]
        gap_mm = gap_mm + moved_mm
        now_N = rms(asked.rendered_N(brake, gap_mm) - asked.force_N)
        if abs(now_N - last_N) <= SETTLED * now_N + EXACT_N:
            return gap_mm
        if now_N > last_N:
            # where the gap turns, one round may undo the other, so the next goes less far
            radius_mm = 0.5 * float(np.abs(moved_mm).max())
        last_N = now_N
    raise RuntimeError(f"foresight: no end after {ROUNDS} rounds, {last_N * 1e3:.2f} mN")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("force", metavar="FORCE.csv|SCENE", help="columns t_s,force_N; or a scene's file or name")
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample (sample_1)")
    parser.add_argument("--insert", help=f"insert in it (the scene's, or {PLANTS_INSERT})")


def run(options: argparse.Namespace) -> Found:
    is_scene = options.force in shipped_scenes() or options.force.endswith(".toml")
    scene = load_scene(options.force) if is_scene else None
    if scene is None:
        table, usual = read_forces(Path(options.force)).values, PLANTS_INSERT
        time_s, force_N = np.array(table["time_s"]), np.array(table["force_N"])
    else:
        (time_s, force_N), usual = signal_of(scene, options.force), scene.insert.name
    plant = with_insert(load_plant(options.plant), options.insert or usual)
    brake = brake_of(plant)
    most_N = brake.sliding_N(brake.fresh_at_N(float(brake.moment_Tm[0]), -brake.lag.branch_Tm), TURNED_MM_S)
    try:
        figures = bound(plant, time_s, force_N).figures()
    except RuntimeError as error:
        raise LabError(str(error)) from error
    found = {**figures, "least_N": brake.open_N(TURNED_MM_S), "most_N": most_N}
    if scene is None:
        return Found(found)
    limits = (
        ("force.most_N", scene.force.most_N, most_N),
        ("force.tolerance_rms_N", -scene.force.tolerance_rms_N, -found["foresight_rms_N"]),
    )
    unmet = [
        f"{name} = {abs(stated_N):.3g}: plant {options.plant} gives {abs(given_N):.3g}"
        for name, stated_N, given_N in limits
        if stated_N > given_N
    ]
    return Found(found | {"unmet": unmet}, exit_code=int(bool(unmet)))


def signal_of(scene: Scene, name: str) -> tuple[Array, Array]:
    """Return times, s, and forces, N: the scene's signal, or without one its range once up and down."""
    least_N, most_N = scene.force.least_N, scene.force.most_N
    if scene.signal is None:
        return np.array([0.0, SIGNAL_S / 2.0, SIGNAL_S]), np.array([least_N, most_N, least_N])
    return asked(scene.signal, Path(str(scene_path(name))).parent, (least_N, most_N), SIGNAL_S, SIGNAL_HZ)


def _reached(
    limit_mm_s: Callable[[float, float, float], float], gap_mm: Array, speeds_mm_s: Array, step_s: float
) -> tuple[Array, Array]:
    """Return the speed limit at the end of each step but the first, and its slope (n - 2 each) over the speed."""
    found = []
    for gap, speed in zip(gap_mm[1:-1].tolist(), speeds_mm_s[:-1].tolist(), strict=True):
        more, less = limit_mm_s(gap, speed + SECANT_MM_S, step_s), limit_mm_s(gap, speed - SECANT_MM_S, step_s)
        found.append((limit_mm_s(gap, speed, step_s), (more - less) / (2.0 * SECANT_MM_S)))
    reached, slope = np.array(found).T
    return reached, slope


def _lagging(brake: Brake, moment_Tm: Array, lag_Tm: Array, turned: Array) -> tuple[sparse.spmatrix, sparse.spmatrix]:
    """Linearise the lag's law, and return two matrices (n x n), for the changes of gaps and of lags."""
    steps = len(moment_Tm)
    change_Tm = np.diff(moment_Tm)
    kept = np.exp(-np.abs(change_Tm) / brake.lag.turn_Tm)
    pulled = np.sign(change_Tm) * (lag_Tm[:-1] + np.sign(change_Tm) * brake.lag.branch_Tm) / brake.lag.turn_Tm * kept
    # the first lag is given
    of_gaps = sparse.diags(
        [np.concatenate([[0.0], pulled]) * turned, -pulled * turned[:-1]], [0, -1], shape=(steps, steps)
    )
    of_lags = sparse.diags([np.ones(steps), -kept], [0, -1], shape=(steps, steps))
    return of_gaps, of_lags


def _least_squares(
    matrix: sparse.spmatrix, error: Array, nothing: sparse.spmatrix, limits: list[tuple[sparse.spmatrix, Array]]
) -> Array:
    """Return the x (p) that minimises |matrix x + error| with `nothing` x = 0 and within the limits."""
    unit = float(np.abs(matrix).max())
    below = sparse.vstack([limit for limit, _ in limits], format="csc")
    below.resize(below.shape[0], matrix.shape[1])
    bounds = np.concatenate([bound for _, bound in limits])
    import clarabel  # only the bound needs this package

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    # late rounds leave little room, and take ten times the iterations of early ones
    settings.max_iter = 1_000
    solver = clarabel.DefaultSolver(
        sparse.triu(matrix.T @ matrix / unit**2, format="csc"),
        matrix.T @ error / unit**2,
        sparse.vstack([nothing, below], format="csc"),
        np.concatenate([np.zeros(nothing.shape[0]), bounds]),
        [clarabel.ZeroConeT(nothing.shape[0]), clarabel.NonnegativeConeT(len(bounds))],
        settings,
    )
    solution = solver.solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise RuntimeError(f"foresight: the quadratic programme ended with {solution.status}")
    return np.array(solution.x)
