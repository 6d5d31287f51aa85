"""One scene in one situation on the simulated device in virtual time: how far the true force is off.

The situations are those of use: the scene's own signal, steps, a hold, a handle that reverses or creeps, a publisher
that seldom sends, and a hand that pushes into a wall. What is asked begins after an approach; the error counts from
LEARN_S on. A frozen run learns only until then. Runs are spread over any `concurrent.futures.Executor`.
"""

import math
from collections.abc import Collection
from concurrent.futures import Executor
from pathlib import Path

import msgspec
import numpy as np
from devices import device
from judge import touching
from judge.following import FILE_PREVIEW_S, armed, publisher, taught
from judge.hands import swinging

from tormag_lab.arrays import Array, rms
from tormag_lab.executors import finished
from tormagd.config import Config, Rates
from tormagd.control.assembly.build import Core, build_core
from tormagd.scenes.scene import Bandwidth, Handle, Scene, Solver, load_scene, scene_path
from tormagd.scenes.signal import asked
from tormagd.simulation.hand import PRESSES_AT_S, PRESSING_MM_S, Hand, PressingHand, RecordedHand
from tormagd.simulation.parameters import PlantParameters, load_plant, with_insert

ROOT = Path(__file__).parents[2]
LEARN_S = 4.0
APPROACH_S = 2.0
"The first force is held for so long before what is asked begins."
OPEN_MM = 0.1
"This near its open end a gap is open: too much force is then the device's, not the model's."
STEP_S, HOLD_S = 1.0, 30.0
HELD = 0.8
REVERSES_S, CREEP_MM_S, LASTS_S = 1.5, 1.0, 90.0
SELDOM_HZ = 20.0
CONTACT_MM, PUSH_MM_S, HAND_N_MM = 8.0, 30.0, 0.3
"Depth of a wall, mm, for the greatest force, the push's speed, and the hand's stiffness."
OF_A_HANDLE = "reversing", "creeping", "contact"
"What a finger in a pad cannot do."
SITUATIONS = "signal", "steps", "hold", "seldom", *OF_A_HANDLE


class Case(msgspec.Struct, frozen=True):
    """One run. `search` replaces the scene's own. Setpoints come `inference_hz` times a second, or as often as scene or
    situation say if that is less.
    """

    scene: str
    device: str = "sample_1"
    situation: str = "signal"
    search: str = ""
    is_learning: bool = True
    control_hz: int = 1_000
    inference_hz: int = 500
    seconds: float = 5.0


def run(case: Case) -> float:
    """Return the RMS of the true less the asked force; a fault counts as no force at all."""
    if case.situation == "contact":
        return _touched(case)
    played, rows = Play(case), []
    loop, ends_s = played.loop, played.begins_s + float(played.time_s[-1])
    while loop.now_s < ends_s:
        time_s = loop.now_s - played.begins_s
        if time_s >= LEARN_S:
            taught(loop).learns = case.is_learning
        loop.tick(played.publish(loop.now_s))
        truth = loop.device.truth
        if loop.stepper.safety.faults:
            return rms(played.force_N)
        if time_s >= LEARN_S:
            force_N = truth.kinetic_N if case.situation == "reversing" else truth.force_N
            rows.append((truth.time_s - played.begins_s, force_N, truth.gap_mm))
    at_s, rendered_N, gap_mm = np.array(rows).T
    error_N = rendered_N - np.interp(at_s, played.time_s, played.force_N)
    is_least = (gap_mm >= played.core.scene.insert.gap_open_mm - OPEN_MM) & (error_N > 0.0)
    return rms(np.where(is_least, 0.0, error_N))


def _touched(case: Case) -> float:
    core = core_of(case)
    most_N = core.scene.force.most_N
    wall = touching.Case(case.device, HAND_N_MM, most_N / CONTACT_MM, PUSH_MM_S, 0.0, "law", most_N=most_N)
    touch = touching.rendered(wall, core)
    if touch.faults:
        return most_N
    counts = (touch.depth_mm >= 0.0) & (touch.speed_mm_s > 0.0)
    wanted_N = np.clip(wall.wall_N_mm * touch.depth_mm, core.portrait.min_N, most_N)
    return rms((touch.kinetic_N - wanted_N)[counts])


def core_of(case: Case) -> Core:
    rates = Rates(control_hz=case.control_hz, inference_hz=min(case.inference_hz, case.control_hz))
    stated = load_scene(case.scene)
    scene = msgspec.structs.replace(
        stated,
        bandwidth=Bandwidth(control_hz=case.control_hz, inference_hz=rates.inference_hz),
        solver=Solver(name=case.search) if case.search else stated.solver,
    )
    return build_core(Config(scene=case.scene, rates=rates), scene)


class Play:
    def __init__(self, case: Case) -> None:
        self.core = core_of(case)
        scene = self.core.scene
        self.loop = armed(self.core, plant_of(case.device, scene), hand_of(case.situation, scene))
        self.time_s, self.force_N = self._asked(case)
        approach_s = APPROACH_S
        finger = scene.finger
        if finger is not msgspec.UNSET:
            approach_s += PRESSES_AT_S + finger.depth_mm / PRESSING_MM_S - self.loop.now_s
        before_s = np.arange(round(approach_s * case.inference_hz)) / case.inference_hz
        self.begins_s = self.loop.now_s + approach_s
        times = np.concatenate([self.loop.now_s + before_s, self.begins_s + self.time_s])
        forces = np.concatenate([np.full(len(before_s), self.force_N[0]), self.force_N])
        sent_hz = sends_hz(case, scene)
        if sent_hz < case.inference_hz:
            sent_s = np.arange(times[0], times[-1], 1.0 / sent_hz)
            times, forces = sent_s, np.interp(sent_s, times, forces)
        is_known = scene.signal is not None and scene.signal.is_known_ahead and case.situation != "steps"
        self.publish = publisher(times, forces, FILE_PREVIEW_S if is_known else 0.0)

    def _asked(self, case: Case) -> tuple[Array, Array]:
        scene, rate_hz = self.core.scene, case.inference_hz
        low_N, high_N = max(scene.force.least_N, self.core.portrait.min_N), scene.force.most_N
        lasts_s = LEARN_S + (HOLD_S if case.situation == "hold" else case.seconds)
        time_s = np.arange(round(lasts_s * rate_hz)) / rate_hz
        if case.situation == "hold":
            return time_s, np.full(len(time_s), low_N + HELD * (high_N - low_N))
        if case.situation == "steps":
            return time_s, np.where(time_s // STEP_S % 2.0 == 0.0, low_N, low_N + HELD * (high_N - low_N))
        return signal_of(scene, case.scene, (low_N, high_N), lasts_s, rate_hz)


def plant_of(name: str, scene: Scene) -> PlantParameters:
    if scene.element == "tactile":
        return load_plant(name.replace("sample", "pad"))
    return with_insert(device(name), scene.insert.name)


def hand_of(situation: str, scene: Scene) -> Hand:
    if scene.finger is not msgspec.UNSET:
        return PressingHand(scene.finger.depth_mm)
    if situation == "reversing":
        times_s = np.arange(0.0, LASTS_S, REVERSES_S)
        turns = np.arange(len(times_s)) % 2
        return RecordedHand(tuple(times_s.tolist()), tuple((turns * REVERSES_S * scene.handle.most_mm_s).tolist()))
    return swinging(Handle(CREEP_MM_S, CREEP_MM_S) if situation == "creeping" else scene.handle)


def sends_hz(case: Case, scene: Scene) -> float:
    if case.situation == "seldom":
        return SELDOM_HZ
    stated = msgspec.UNSET if scene.signal is None else scene.signal.setpoint_hz
    return case.inference_hz if stated is msgspec.UNSET else stated


def signal_of(
    scene: Scene, name: str, range_N: tuple[float, float], longest_s: float, rate_hz: int
) -> tuple[Array, Array]:
    """Return the scene's signal, up and down again until the time is over; a recording is played once."""
    assert scene.signal is not None, "its forces are asked for"
    time_s, force_N = asked(scene.signal, Path(scene_path(name)).parent, range_N, longest_s, rate_hz)
    if not scene.signal.file and time_s[-1] < longest_s:
        force_N = np.tile(force_N, math.ceil(longest_s * rate_hz / len(force_N)))[: round(longest_s * rate_hz)]
        time_s = np.arange(len(force_N)) / rate_hz
    return time_s, force_N


def run_all(cases: Collection[Case], executor: Executor, known: dict[Case, float]) -> dict[Case, float]:
    for case, future in finished(executor, run, [case for case in dict.fromkeys(cases) if case not in known], "run"):
        known[case] = future.result()
    return {case: known[case] for case in cases}
