"""A hand that pushes into a wall and draws back, in virtual time, and what ideal carriages would make of it.

The patient's tip is where the handle was half a round trip ago, and what it feels comes back as late. The bound moves
the gap by the device's own motors, which stop at once, along the device's true force over gap; it knows what the run's
controller knows. *Infinite* is the same without motors. *Opened* is the run until the hand pulls; from there its motors
only open.
"""

import math
from functools import cache
from typing import NamedTuple

import msgspec
import numpy as np
from devices import device as device_of
from msgspec import UNSET, UnsetType

from judge.following import VALID_S, armed
from judge.hands import Legs, WaitingHand
from tormag_lab.arrays import Array
from tormag_lab.ideal_carriage import brake_of, drive_of
from tormagd.config import Config, Rates
from tormagd.control.ask.path import FLATTEST_N_MM, SPEEDING_UP_S, TIMES_S, nearest_path_mm
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import GapSpeeds, TimedSetpoint, Travel, Wall
from tormagd.control.safety.codes import Limit
from tormagd.scenes.scene import load_scene
from tormagd.simulation.hand import FeltHand, Hand, Impedance
from tormagd.simulation.ideal_actuator import put_gap
from tormagd.simulation.parameters import PlantParameters, with_insert
from tormagd.simulation.patient import NetworkDelay
from tormagd.simulation.plant import Plant, Truth

PERIOD_S = 1e-3
SETPOINT_TICKS = 2
MAX_N = 2.0
FREE_MM = 20.0
LEARNING: Legs = [(2.0, 15.0), (0.8, 0.0)]
LEARNT_S = sum(lasts_s for lasts_s, _ in LEARNING)
LEARNS, LEARNS_FOR_S = 0.6, 1.6
"Share of the greatest force that is asked while the hand slides, so that the device is known."
RESTS_S = 0.8
ONSET_N, COUNTED_N = 0.2, 0.3
"Over the waiting level: where a wall is felt, and what it must reach to count."
HELD_N = EARLY_N = 0.1
PULLS_N = 0.05
RESTING_MM_S = 1.0
GRID_MM = 0.05
MASS_KG = 0.15


class Case(NamedTuple):
    """One touch. `hand_N_mm` is the hand's stiffness, `mode` one of force, way, law, with _standby or without."""

    device: str
    hand_N_mm: float
    wall_N_mm: float
    push_mm_s: float
    round_trip_ms: float
    mode: str


class Touch(NamedTuple):
    """A row for each tick of a push: time, s, the handle's place behind the wall's, mm, and speed, mm/s."""

    time_s: Array
    depth_mm: Array
    speed_mm_s: Array
    kinetic_N: Array
    force_N: Array
    hand_N: Array
    faults: tuple[str, ...]
    limits: tuple[str, ...]


def reached_ms(touch: Touch, wall_N_mm: float, force_N: float) -> float | None:
    """Return the time from when the wall's force at the handle's place reaches it until the kinetic force does."""
    there, felt = wall_N_mm * touch.depth_mm >= force_N, touch.kinetic_N >= force_N
    if not (there.any() and felt.any()):
        return None
    return 1e3 * float(touch.time_s[felt.argmax()] - touch.time_s[there.argmax()])


class Link:
    def __init__(self, case: Case, wall: Wall, withdraw_N: float) -> None:
        one_way_s = 5e-4 * case.round_trip_ms
        self._there: NetworkDelay[float] = NetworkDelay(one_way_s)
        self._back: NetworkDelay[TimedSetpoint] = NetworkDelay(one_way_s)
        self._wall, self._withdraw_N, self._mode = wall, withdraw_N, case.mode
        self._tip: tuple[float, float] | None = None
        self._newest: TimedSetpoint | None = None
        self._ticks = 0

    def update(self, now_s: float, handle_mm: float) -> TimedSetpoint | None:
        self._ticks += 1
        if self._ticks % SETPOINT_TICKS == 0:
            self._there.send(now_s, handle_mm)
        for told in self._there.arrived(now_s):
            self._tip = told
        if self._tip is not None and self._ticks % SETPOINT_TICKS == 0:
            self._back.send(now_s, self._setpoint(now_s, self._tip[1]))
        for _, setpoint in self._back.arrived(now_s):
            self._newest = setpoint
        return self._newest

    def _setpoint(self, now_s: float, tip_mm: float) -> TimedSetpoint:
        withdraw_N = None if self._mode.startswith("force") else self._withdraw_N
        wall = self._wall if self._mode.startswith("law") else None
        return TimedSetpoint(self._wall.force_N(tip_mm), now_s, VALID_S, withdraw_N=withdraw_N, wall=wall)


@cache
def core_with(standby_N: float | UnsetType = UNSET, name: str = "aorta_2") -> Core:
    scene = load_scene(name)
    force = msgspec.structs.replace(scene.force, standby_N=standby_N)
    config = Config(scene=name, rates=Rates(control_hz=1000, inference_hz=500))
    return build_core(config, msgspec.structs.replace(scene, force=force, signal=None))


def core_of(case: Case) -> Core:
    core = core_with()
    return core_with(core.portrait.min_N + 0.3) if case.mode.endswith("standby") else core


class Scenario:
    def __init__(self, case: Case, core: Core) -> None:
        self._case, self.core = case, core
        self._hand = WaitingHand()
        damping_N_s_mm = 2e-3 * math.sqrt(MASS_KG * 1e3 * case.hand_N_mm)
        self.felt = FeltHand(self._hand, Impedance(MASS_KG, case.hand_N_mm, damping_N_s_mm))
        self.wall = Wall(sum(lasts_s * speed_mm_s for lasts_s, speed_mm_s in LEARNING) + FREE_MM, case.wall_N_mm)
        self._patient = Link(case, self.wall, core.scene.force.least_N)
        self._start_s = self.turns_s = 0.0
        self._rows: list[tuple[float, ...]] = []
        self._limits: set[str] = set()

    def begin(self, now_s: float) -> range:
        case = self._case
        push_s = (FREE_MM + MAX_N / case.wall_N_mm + MAX_N / case.hand_N_mm) / case.push_mm_s
        there: Legs = [(push_s, case.push_mm_s), (RESTS_S, 0.0)]
        legs = [*LEARNING, *there, (push_s, -case.push_mm_s), (RESTS_S, 0.0)]
        self._hand.begin(legs, now_s)
        self._start_s, self.turns_s = now_s, now_s + LEARNT_S + push_s + RESTS_S
        return range(round(sum(lasts_s for lasts_s, _ in legs) / PERIOD_S))

    def setpoint(self, now_s: float, truth: Truth) -> TimedSetpoint | None:
        since_s = now_s - self._start_s
        sent = self._patient.update(now_s, truth.handle_mm)
        if since_s >= LEARNT_S:
            return sent
        return TimedSetpoint(LEARNS * MAX_N if since_s < LEARNS_FOR_S else 0.0, now_s, VALID_S)

    def see(self, truth: Truth, limits: tuple[Limit, ...] = ()) -> None:
        time_s = truth.time_s - self._start_s - LEARNT_S
        if time_s >= 0.0:
            depth_mm = truth.handle_mm - self.wall.place_mm
            forces_N = truth.kinetic_N, truth.force_N, self.felt.force_N
            self._rows.append((time_s, depth_mm, truth.handle_mm_s, *forces_N))
            self._limits.update(map(str, limits))

    def touch(self, faults: tuple[str, ...] = ()) -> Touch:
        time_s, depth_mm, speed_mm_s, kinetic_N, force_N, hand_N = np.array(self._rows).reshape(-1, 6).T
        return Touch(time_s, depth_mm, speed_mm_s, kinetic_N, force_N, hand_N, faults, tuple(sorted(self._limits)))


def rendered(case: Case, core: Core) -> Touch:
    scenario = Scenario(case, core)
    loop = armed(core, with_insert(device_of(case.device), core.scene.insert.name), scenario.felt)
    for _ in scenario.begin(loop.now_s):
        sample = loop.tick(scenario.setpoint(loop.now_s, loop.simulated.truth))
        scenario.see(sample.truth, (*sample.plan.limits, *sample.output.limits))
        if sample.safety.faults:
            break
    return scenario.touch(tuple(map(str, loop.stepper.safety.faults)))


def opened(case: Case, core: Core) -> Touch:
    scenario, parameters = Scenario(case, core), with_insert(device_of(case.device), core.scene.insert.name)
    loop = armed(core, parameters, scenario.felt)
    plant, has_pulled = loop.simulated.plant, False
    opening_V = min(core.config.motor.supply_V, parameters.electronics.supply_V)
    for _ in scenario.begin(loop.now_s):
        has_pulled = has_pulled or (plant.time_s > scenario.turns_s and plant.truth.force_N < -PULLS_N)
        if has_pulled:
            volts = opening_V if plant.gap_mm < core.scene.insert.gap_open_mm else 0.0
            plant.drive(volts, volts)
            plant.advance(PERIOD_S)
        else:
            loop.tick(scenario.setpoint(loop.now_s, plant.truth))
        scenario.see(plant.truth)
    return scenario.touch()


def ideal(case: Case, *, has_motors: bool = True) -> Touch:
    """Play the case by the bound; without motors the gap is at once where it should be."""
    scenario = Scenario(case, core_of(case))
    bound = Bound(scenario.core, device_of(case.device), scenario.felt, has_motors=has_motors)
    plant = bound.plant
    plant.advance(PERIOD_S)
    for _ in scenario.begin(plant.time_s):
        bound.tick(scenario.setpoint(plant.time_s, plant.truth))
        scenario.see(plant.truth)
    return scenario.touch()


class Bound:
    """A gap, open at first, that the device's motors move to where its true force is wanted."""

    def __init__(self, core: Core, device: PlantParameters, hand: Hand, *, has_motors: bool = True) -> None:
        self.plant = Plant(device, hand)
        put_gap(self.plant, core.scene.insert.gap_open_mm)
        self._core, self._drive = core, drive_of(device) if has_motors else None
        self._brake = brake = brake_of(device)
        self._gap_mm = np.arange(brake.gap_mm[0], brake.gap_mm[-1], GRID_MM)
        moment_Tm = np.interp(self._gap_mm, brake.gap_mm, brake.moment_Tm)
        self._fresh_N = np.interp(moment_Tm, brake.strength_Tm, brake.fresh_N)
        self._speed_mm_s, self._is_pushing, self._sets_out = 0.0, True, False
        self._offset_N, self._scale = 0.0, 1.0

    def tick(self, setpoint: TimedSetpoint | None) -> None:
        truth = self.plant.truth
        if abs(truth.force_N) > PULLS_N:
            self._is_pushing = truth.force_N > 0.0
        strength = truth.kinetic_N / float(np.interp(truth.gap_mm, self._gap_mm, self._fresh_N))
        rate_mm_s = abs(truth.handle_mm_s)
        # a hand that rests feels what it gives
        self._offset_N, self._scale = (0.0, 1.0) if rate_mm_s < RESTING_MM_S else self._brake.felt(rate_mm_s)
        put_gap(self.plant, self._moved(truth.gap_mm, self._wanted_mm(setpoint, truth, strength)))
        self.plant.advance(PERIOD_S)

    def _gaps_for(self, forces_N: Array, strength: float) -> Array:
        force = self._core.scene.force
        kinetic_N = (np.clip(forces_N, force.waiting_N, force.most_N) - self._offset_N) / self._scale
        return np.interp(-kinetic_N / strength, -self._fresh_N, self._gap_mm)

    def _wanted_mm(self, setpoint: TimedSetpoint | None, truth: Truth, strength: float) -> float:
        travel = Travel(truth.handle_mm, truth.handle_mm_s, self._is_pushing)
        wall = None if setpoint is None else setpoint.wall
        if wall is None or not self._is_pushing or self._drive is None:
            self._sets_out = False
            asked_N = 0.0 if setpoint is None else setpoint.asked_N(travel)
            return float(self._gaps_for(np.array(asked_N), strength))
        depths_mm = truth.handle_mm - wall.place_mm + truth.handle_mm_s * np.array(TIMES_S)
        wanted_mm = self._gaps_for(wall.friction_N + wall.stiffness_N_mm * np.maximum(depths_mm, 0.0), strength)
        slopes = np.interp(wanted_mm, self._gap_mm[1:], np.diff(self._fresh_N) / GRID_MM)
        weights = np.maximum(slopes * slopes, FLATTEST_N_MM**2) * np.gradient(TIMES_S)
        speeds = GapSpeeds(*[max(abs(self._speed_mm_s), self._core.gap_speeds.sure_mm_s)] * 3)
        path = nearest_path_mm(truth.gap_mm, PERIOD_S, TIMES_S, wanted_mm.tolist(), weights.tolist(), speeds, 1)
        open_N = self._scale * float(self._fresh_N[-1]) * strength + self._offset_N
        waiting_N = max(self._core.scene.force.waiting_N, open_N)
        waiting_mm, early_mm = self._gaps_for(np.array([waiting_N, waiting_N + EARLY_N]), strength).tolist()
        left_ticks = -depths_mm[0] / max(PERIOD_S * truth.handle_mm_s, PERIOD_S)
        self._sets_out = self._sets_out or self._ticks_to(early_mm, truth.gap_mm, left_ticks) >= left_ticks
        if not self._sets_out:
            return float(waiting_mm)
        soon_mm = truth.handle_mm + truth.handle_mm_s * SPEEDING_UP_S
        most_N = wall.force_N(soon_mm) - wall.friction_N + waiting_N + EARLY_N
        return max(min(path[0], float(wanted_mm[0])), float(self._gaps_for(np.array(most_N), strength)))

    def _ticks_to(self, closed_mm: float, gap_mm: float, most: float) -> int:
        """Return how many ticks the motors need to close the gap so far, or at least `most`."""
        assert self._drive is not None
        ticks, speed_mm_s = 0, self._speed_mm_s
        while gap_mm > closed_mm and ticks < most:
            speed_mm_s = min(self._drive.lowest_mm_s(gap_mm, min(speed_mm_s, 0.0), PERIOD_S), 0.0)
            gap_mm += PERIOD_S * speed_mm_s
            ticks += 1
        return ticks

    def _moved(self, gap_mm: float, wanted_mm: float) -> float:
        drive = self._drive
        if drive is None:
            return wanted_mm
        asked_mm_s = (wanted_mm - gap_mm) / PERIOD_S
        highest = max(drive.highest_mm_s(gap_mm, max(self._speed_mm_s, 0.0), PERIOD_S), 0.0)
        lowest = min(drive.lowest_mm_s(gap_mm, min(self._speed_mm_s, 0.0), PERIOD_S), 0.0)
        self._speed_mm_s = min(max(asked_mm_s, lowest), highest)
        return gap_mm + self._speed_mm_s * PERIOD_S
