"""A hand that pushes into a wall and draws back, in virtual time, and what ideal carriages would make of it.

The patient's tip is where the handle was half a round trip ago; what it feels comes back as late. The bound moves the
gap by the device's own motors, which stop at once, along the device's true force over gap; it knows what the run's
controller knows: the newest message, and the handle's place and speed. *Infinite* is the same without motors.
"""

import math
import random
from collections import deque
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rendering.device_draws import device as device_of
from rendering.following import VALID_S, armed
from rendering.hands import Legs, WaitingHand
from tormagd.assembly.build import Core, build_core
from tormagd.config import Config, Rates
from tormagd.control.ask.governor import EARLY_N
from tormagd.control.ask.path import TIMES_S, nearest_path_mm
from tormagd.control.records import TimedSetpoint, Travel, Wall
from tormagd.lab.arrays import Array
from tormagd.lab.ideal_carriage import Brake, Drive, brake_of, drive_of
from tormagd.safety.codes import Limit
from tormagd.scenes.scene import load_scene
from tormagd.simulation.hand import FeltHand, Impedance
from tormagd.simulation.plant import Plant, Truth

PERIOD_S = 1e-3
SETPOINT_TICKS = 2
MOST_N = 2.0
"What hand and wall come to rest at."
FREE_MM = 20.0
"From where the hand begins to push to the wall."
LEARNING: Legs = [(3.0, 15.0), (1.0, 0.0)]
LEARNT_S = sum(lasts_s for lasts_s, _ in LEARNING)
LEARNING_N, LEARNS_FOR_S = 1.2, 2.5
"The device is asked for this while the hand slides, so that it is known."
RESTS_S = 1.0
ONSET_N, COUNTED_N = 0.2, 0.3
"Over the waiting level: where a wall is felt, and what it has to reach in order to count."
HELD_N = 0.1
PULLS_N = 0.05
GRID_MM = 0.05
MASS_KG = 0.15


class Case(NamedTuple):
    """One touch. `hand_N_mm` is the hand's stiffness, `mode` one of force, way, law, with _standby or without; jitter
    and loss are the network's."""

    device: str
    hand_N_mm: float
    wall_N_mm: float
    push_mm_s: float
    round_trip_ms: float
    mode: str
    jitter_ms: float = 0.0
    loss: float = 0.0


class Touch(NamedTuple):
    """A row for each tick from when the hand begins to push: time, s, the handle's place behind the wall's, mm, and
    speed, mm/s; the kinetic force and that on the handle, N; whether the hand has turned."""

    time_s: Array
    depth_mm: Array
    speed_mm_s: Array
    kinetic_N: Array
    force_N: Array
    faults: tuple[str, ...]
    limits: tuple[str, ...]


class Line:
    """One direction of the network: what is sent arrives after `delay_s` and some jitter, in the order of arrival."""

    def __init__(self, delay_s: float, jitter_s: float, loss: float, seed: str) -> None:
        self._delay_s, self._jitter_s, self._loss = delay_s, jitter_s, loss
        self._random = random.Random(seed)
        self._lost_until_s = -math.inf
        self._flying: deque[tuple[float, Any]] = deque()

    def send(self, now_s: float, thing: Any) -> None:
        """Bursts of 50 ms are lost, so often that the share comes out."""
        if self._random.random() < self._loss * PERIOD_S * SETPOINT_TICKS / 0.05:
            self._lost_until_s = now_s + 0.05
        if now_s >= self._lost_until_s:
            self._flying.append((now_s + self._delay_s + self._jitter_s * self._random.random(), thing))

    def arrived(self, now_s: float) -> list[Any]:
        """What has arrived by now."""
        there = [thing for at_s, thing in self._flying if at_s <= now_s + 1e-9]
        if there:
            self._flying = deque(each for each in self._flying if each[0] > now_s + 1e-9)
        return there


class Patient:
    """Feels the wall with a tip that is where the handle was, and sends a setpoint for that."""

    def __init__(self, case: Case, wall: Wall, withdraw_N: float) -> None:
        one_way_s, jitter_s = 5e-4 * case.round_trip_ms, 1e-3 * case.jitter_ms
        self._there = Line(one_way_s, jitter_s, case.loss, "there")
        self._back = Line(one_way_s, jitter_s, case.loss, "back")
        self._wall, self._tip_mm, self._ticks = wall, -math.inf, 0
        self._is_law, self._withdraw_N = case.mode.startswith("law"), withdraw_N
        self._is_way = not case.mode.startswith("force")
        self.newest: TimedSetpoint | None = None

    def update(self, now_s: float, handle_mm: float) -> TimedSetpoint | None:
        """The newest setpoint that has arrived at the console."""
        self._there.send(now_s, handle_mm)
        for tip_mm in self._there.arrived(now_s):
            self._tip_mm = tip_mm
        self._ticks += 1
        if self._ticks % SETPOINT_TICKS == 0:
            self._back.send(now_s, self._setpoint(now_s))
        for setpoint in self._back.arrived(now_s):
            if self.newest is None or setpoint.stamp_s > self.newest.stamp_s:
                self.newest = setpoint
        return self.newest

    def _setpoint(self, now_s: float) -> TimedSetpoint:
        return TimedSetpoint(
            self._wall.force_N(self._tip_mm),
            now_s,
            4.0 * VALID_S,
            withdraw_N=self._withdraw_N if self._is_way else None,
            wall=self._wall if self._is_law else None,
        )


def core_of(case: Case) -> Core:
    """The controller of the scene `aorta_2`, at 1000 and 500 Hz, with every term."""
    config = Config(scene="aorta_2", rates=Rates(control_hz=1000, inference_hz=500))
    scene = msgspec.structs.replace(load_scene("aorta_2"), signal=None)
    core = build_core(config, scene)
    if not case.mode.endswith("standby"):
        return core
    force = msgspec.structs.replace(scene.force, standby_N=core.portrait.min_N + 0.3)
    return build_core(config, msgspec.structs.replace(scene, force=force))


class Scenario:
    """The hand and the patient of a case, and what shows of the touch."""

    def __init__(self, case: Case, core: Core) -> None:
        self._case, self.core = case, core
        self._hand = WaitingHand()
        damping_N_s_mm = 2e-3 * math.sqrt(MASS_KG * 1e3 * case.hand_N_mm)
        self.felt = FeltHand(self._hand, Impedance(MASS_KG, case.hand_N_mm, damping_N_s_mm))
        self.wall = Wall(sum(lasts_s * speed_mm_s for lasts_s, speed_mm_s in LEARNING) + FREE_MM, case.wall_N_mm)
        self._patient = Patient(case, self.wall, core.scene.force.least_N)
        self._start_s = 0.0
        self._rows: list[tuple[float, ...]] = []
        self._limits: set[str] = set()

    def begin(self, now_s: float) -> range:
        """The hand sets out now; the ticks that it takes."""
        case = self._case
        push_s = (FREE_MM + MOST_N / case.wall_N_mm + MOST_N / case.hand_N_mm) / case.push_mm_s
        there: Legs = [(push_s, case.push_mm_s), (RESTS_S, 0.0)]
        legs = [*LEARNING, *there, (push_s, -case.push_mm_s), (RESTS_S, 0.0)]
        self._hand.begin(legs, now_s)
        self._start_s = now_s
        return range(round(sum(lasts_s for lasts_s, _ in legs) / PERIOD_S))

    def setpoint(self, now_s: float, truth: Truth) -> TimedSetpoint | None:
        """The newest that the console has."""
        since_s = now_s - self._start_s
        sent = self._patient.update(now_s, truth.handle_mm)
        if since_s >= LEARNT_S:
            return sent
        return TimedSetpoint(LEARNING_N if since_s < LEARNS_FOR_S else 0.0, now_s, VALID_S)

    def see(self, truth: Truth, limits: tuple[Limit, ...] = ()) -> None:
        """One tick."""
        time_s = truth.time_s - self._start_s - LEARNT_S
        if time_s >= 0.0:
            depth_mm = truth.handle_mm - self.wall.place_mm
            self._rows.append((time_s, depth_mm, truth.handle_mm_s, truth.kinetic_N, truth.force_N))
            self._limits.update(map(str, limits))

    def touch(self, faults: tuple[str, ...] = ()) -> Touch:
        """All that showed."""
        return Touch(*np.array(self._rows).reshape(-1, 5).T, faults, tuple(sorted(self._limits)))


def rendered(case: Case) -> Touch:
    """Plays one case by the controller. Raises RuntimeError where the device is not enabled."""
    scenario = Scenario(case, core_of(case))
    loop = armed(scenario.core, device_of(case.device), scenario.felt)
    truth, faults = loop.simulated.truth, ()
    for _ in scenario.begin(loop.now_s):
        sample = loop.tick(scenario.setpoint(loop.now_s, truth))
        truth, faults = sample.truth, tuple(map(str, sample.safety.faults))
        scenario.see(truth, (*sample.plan.limits, *sample.output.limits))
        if faults:
            break
    return scenario.touch(faults)


def ideal(case: Case, *, has_motors: bool = True) -> Touch:
    """The same by the bound; without motors the gap is at once where it should be."""
    parameters = device_of(case.device)
    scenario = Scenario(case, core_of(case))
    plant = Plant(parameters, scenario.felt)
    bound = Bound(scenario.core, brake_of(parameters), drive_of(parameters) if has_motors else None)
    bound.move(plant, scenario.core.scene.insert.gap_open_mm)
    plant.advance(PERIOD_S)
    for _ in scenario.begin(plant.time_s):
        bound.update(plant, scenario.setpoint(plant.time_s, plant.truth))
        plant.advance(PERIOD_S)
        scenario.see(plant.truth)
    return scenario.touch()


class Bound:
    """A gap that the device's own motors move, to where its true force is the one wanted."""

    def __init__(self, core: Core, brake: Brake, drive: Drive | None) -> None:
        self._core, self._drive = core, drive
        force = core.scene.force
        self._waiting_N, self._most_N = force.waiting_N, force.most_N
        self._gap_mm = np.arange(brake.gap_mm[0], brake.gap_mm[-1], GRID_MM)
        moment_Tm = np.interp(self._gap_mm, brake.gap_mm, brake.moment_Tm)
        self._fresh_N = np.interp(moment_Tm, brake.strength_Tm, brake.fresh_N)
        self._speed_mm_s, self._is_pushing = 0.0, True

    def update(self, plant: Plant, setpoint: TimedSetpoint | None) -> None:
        """Moves the gap for the next tick."""
        truth = plant.truth
        if abs(truth.force_N) > PULLS_N:
            self._is_pushing = truth.force_N > 0.0
        strength = truth.kinetic_N / float(np.interp(truth.gap_mm, self._gap_mm, self._fresh_N))
        self.move(plant, self._moved(truth.gap_mm, self._wanted_mm(setpoint, truth, strength)))

    def move(self, plant: Plant, gap_mm: float) -> None:
        """Puts both carriages there, and turns their screws with them."""
        lead_mm_rad = plant.parameters.screw.lead_mm / math.tau
        by_mm = 0.5 * (gap_mm - plant.gap_mm)
        for axis in (plant.left, plant.right):
            axis.position_m += 1e-3 * by_mm
            axis.angle_rad += by_mm / lead_mm_rad

    def _gap_for(self, force_N: float, strength: float) -> float:
        bounded_N = min(max(force_N, self._waiting_N), self._most_N)
        return float(np.interp(-bounded_N / strength, -self._fresh_N, self._gap_mm))

    def _wanted_mm(self, setpoint: TimedSetpoint | None, truth: Truth, strength: float) -> float:
        if setpoint is None:
            return self._gap_for(0.0, strength)
        travel = Travel(truth.handle_mm, truth.handle_mm_s, self._is_pushing)
        wall = setpoint.wall
        if wall is None or not self._is_pushing or self._drive is None:
            return self._gap_for(setpoint.asked_N(travel), strength)
        places_mm = [truth.handle_mm + truth.handle_mm_s * after_s for after_s in TIMES_S]
        wanted_mm = [self._gap_for(wall.force_N(place_mm), strength) for place_mm in places_mm]
        slopes = np.interp(wanted_mm, self._gap_mm[1:], np.diff(self._fresh_N) / GRID_MM)
        weights = [
            max(slope * slope, 1e-6) * lasts_s for slope, lasts_s in zip(slopes, np.gradient(TIMES_S), strict=True)
        ]
        speed_mm_s = max(abs(self._speed_mm_s), self._core.gap_speed_mm_s)
        path_mm = nearest_path_mm(truth.gap_mm, PERIOD_S, TIMES_S, wanted_mm, weights, speed_mm_s, 1)[0]
        most_N = wall.force_N(truth.handle_mm) + max(self._waiting_N, self._fresh_N[-1] * strength) + EARLY_N
        return max(path_mm, self._gap_for(most_N, strength))

    def _moved(self, gap_mm: float, wanted_mm: float) -> float:
        drive = self._drive
        if drive is None:
            return wanted_mm
        asked_mm_s = (wanted_mm - gap_mm) / PERIOD_S
        highest = max(drive.highest_mm_s(gap_mm, max(self._speed_mm_s, 0.0), PERIOD_S), 0.0)
        lowest = min(drive.lowest_mm_s(gap_mm, min(self._speed_mm_s, 0.0), PERIOD_S), 0.0)
        self._speed_mm_s = min(max(asked_mm_s, lowest), highest)
        return gap_mm + self._speed_mm_s * PERIOD_S
