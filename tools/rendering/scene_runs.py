"""One scene on the simulated device in virtual time, with any of its terms left out: how far the true force is off.

The signal is played from its beginning; after LEARN_S the error counts. A frozen run learns until then, and no more.
Runs are spread over any `concurrent.futures.Executor`.
"""

import math
import time
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rendering.following import FILE_PREVIEW_S, armed, publisher, taught
from rendering.hands import swinging
from tormagd.assembly.build import Core, build_core
from tormagd.assembly.journal import KNOWN
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config, Rates
from tormagd.control.records import Measured, Plan, TimedSetpoint
from tormagd.exact import plain, restore
from tormagd.hardware.measurement import Measurement
from tormagd.lab.arrays import Array, rms
from tormagd.lab.executors import finished
from tormagd.scenes.measured import Cost
from tormagd.scenes.scene import EVERY_TERM, Bandwidth, Scene, Solver, scene_path
from tormagd.scenes.signal import asked
from tormagd.simulation.hand import PRESSES_AT_S, PRESSING_MM_S, PressingHand
from tormagd.simulation.parameters import load_plant, with_insert
from tormagd.toml_file import convert

ROOT = Path(__file__).parents[2]
LEARN_S = 4.0
APPROACH_S = 2.0
"The signal's first force is held for so long before it."
OPEN_MM = 0.1
"So near its open end a gap is open: too much force there is the device's, and no error of any model."
TIMED_S, ROUNDS = 1.0, 7


Begun = tuple[Any, Any]
"A core's stepper and planner, as plain data."


class Tick(NamedTuple):
    """What a core's step and plan were given in one tick."""

    now_s: float
    measurement: Measurement | None
    plan: Plan
    setpoint: TimedSetpoint | None
    measured: Measured | None
    is_planned: bool


class Case(msgspec.Struct, frozen=True):
    """One run. `left_out` are names of terms, `search` takes the place of the scene's own where it is given; setpoints
    come `inference_hz` times a second, or as often as the scene says where that is less."""

    scene: str
    plant: str = "sample_1"
    left_out: tuple[str, ...] = ()
    search: str = ""
    is_learning: bool = True
    control_hz: int = 1_000
    inference_hz: int = 500
    seconds: float = 5.0


def run(case: Case) -> float:
    """RMS of the true force less the force asked, N; a run that ends in a fault counts as no force at all."""
    played = Play(case)
    rows = []
    for time_s, loop in played.ticks(case.seconds):
        truth = loop.device.truth
        if loop.stepper.safety.faults:
            return rms(played.force_N)
        if time_s >= LEARN_S:
            rows.append((truth.time_s - played.begins_s, truth.force_N, truth.gap_mm))
    at_s, rendered_N, gap_mm = np.array(rows).T
    error_N = rendered_N - np.interp(at_s, played.time_s, played.force_N)
    is_least = (gap_mm >= played.core.scene.insert.gap_open_mm - OPEN_MM) & (error_N > 0.0)
    return rms(np.where(is_least, 0.0, error_N))


def costs(cases: Sequence[Case]) -> list[Cost]:
    """What steps and plans take in the models of cases at equal rates: all are given what the first was given in the
    loop, in rounds over all of them, so that a disturbance of the machine meets all alike. Of each step and plan the
    least of ROUNDS counts."""
    played = Play(cases[0])
    begun, ticks = played.given(TIMED_S)
    cores = [build_core(played.config, _modelled(played.core.scene, case)) for case in cases]
    least_us = [_spent_us(core, begun, ticks) for core in cores]
    for _ in range(ROUNDS - 1):
        for place, core in enumerate(cores):
            spent_us = zip(least_us[place], _spent_us(core, begun, ticks), strict=True)
            least_us[place] = tuple(np.minimum(before, now) for before, now in spent_us)
    # a setpoint that comes a little late makes a plan more: what all have cost is shared by those that were asked for
    asked = len(ticks) * cases[0].inference_hz / cases[0].control_hz
    return [
        Cost(round(float(steps_us.sum()) / len(ticks), 3), round(float(plans_us.sum()) / asked, 3))
        for steps_us, plans_us in least_us
    ]


def _spent_us(core: Core, begun: Begun, ticks: list[Tick]) -> tuple[Array, ...]:
    """The time of every step and of every plan of a core that begins there and is given this."""
    stepper, planner = core.stepper(), core.planner()
    stepper_begun, planner_begun = begun
    restore(stepper, stepper_begun, KNOWN)
    own = planner.believe.memory
    planner.plan(ticks[0].now_s, None, ticks[0].measured)
    branches = len(own.free), len(own.added)
    restore(planner, planner_begun, KNOWN)
    # with no more of the elastomer's branches than a model of its own remembers
    own.free, own.added = own.free[: branches[0]], own.added[: branches[1]]
    steps_us, plans_us = [], []
    for tick in ticks:
        start_ns = time.thread_time_ns()
        stepper.step(tick.now_s, tick.measurement, tick.plan)
        stepped_ns = time.thread_time_ns()
        steps_us.append((stepped_ns - start_ns) * 1e-3)
        if tick.is_planned:
            planner.plan(tick.now_s, tick.setpoint, tick.measured)
            planner.foresee()
            plans_us.append((time.thread_time_ns() - stepped_ns) * 1e-3)
    return np.array(steps_us), np.array(plans_us)


def _modelled(scene: Scene, case: Case) -> Scene:
    """The scene with the case's terms and search."""
    solver = Solver(name=case.search) if case.search else scene.solver
    return msgspec.structs.replace(scene, terms=EVERY_TERM.without(*case.left_out), solver=solver)


class Play:
    """A case's loop, armed, and its signal behind an approach."""

    def __init__(self, case: Case) -> None:
        rates = Rates(control_hz=case.control_hz, inference_hz=min(case.inference_hz, case.control_hz))
        self.config = config = Config(scene=case.scene, rates=rates)
        stated = load_task(case.scene)
        free = Bandwidth(control_hz=case.control_hz, inference_hz=rates.inference_hz)
        scene = _modelled(msgspec.structs.replace(stated, bandwidth=free), case)
        self.core = build_core(config, scene)
        self._learns = case.is_learning
        finger = scene.finger
        hand = swinging(scene.handle) if finger is msgspec.UNSET else PressingHand(finger.depth_mm)
        # a pad is on the sample's carriages
        is_pad, pad = scene.element == "tactile", case.plant.replace("sample", "pad")
        plant = load_plant(pad) if is_pad else with_insert(load_plant(case.plant), scene.insert.name)
        self._loop = armed(self.core, plant, hand)
        self.time_s, self.force_N = signal_of(self.core, case.scene, LEARN_S + case.seconds, case.inference_hz)
        approach_s = APPROACH_S
        if finger is not msgspec.UNSET:
            approach_s += PRESSES_AT_S + finger.depth_mm / PRESSING_MM_S - self._loop.now_s
        before_s = np.arange(round(approach_s * case.inference_hz)) / case.inference_hz
        self.begins_s = self._loop.now_s + approach_s
        times = np.concatenate([self._loop.now_s + before_s, self.begins_s + self.time_s])
        forces = np.concatenate([np.full(len(before_s), self.force_N[0]), self.force_N])
        signal = scene.signal
        assert signal is not None, "its forces are asked for"
        if signal.setpoint_hz is not msgspec.UNSET and signal.setpoint_hz < case.inference_hz:
            sent_s = np.arange(times[0], times[-1], 1.0 / signal.setpoint_hz)
            times, forces = sent_s, np.interp(sent_s, times, forces)
        self.publish = publisher(times, forces, FILE_PREVIEW_S if signal.is_known_ahead else 0.0)

    def ticks(self, seconds: float) -> Iterable[tuple[float, ClosedLoop]]:
        """The loop after each tick, with the time in the signal, from the approach to `seconds` after LEARN_S."""
        loop = self._loop
        ends_s = self.begins_s + min(LEARN_S + seconds, float(self.time_s[-1]))
        while loop.now_s < ends_s:
            time_s = loop.now_s - self.begins_s
            if time_s >= LEARN_S:
                taught(loop).learns = self._learns
            loop.tick(self.publish(loop.now_s))
            yield time_s, loop

    def given(self, seconds: float) -> tuple[Begun, list[Tick]]:
        """What the core was LEARN_S into the signal, and what it was given in these seconds after that."""
        ticks: list[Tick] = []
        begun: Begun | None = None
        loop, planner = self._loop, self._loop.planner
        assert planner is not None, "this loop plans"
        before_s, plan = loop.now_s, planner.planned
        for time_s, _ in self.ticks(seconds):
            if begun is not None:
                setpoint, is_planned = self.publish(before_s), planner.planned is not plan
                ticks.append(Tick(loop.now_s, loop.measurement, plan, setpoint, loop.stepper.measured, is_planned))
            elif time_s >= LEARN_S:
                begun = plain(loop.stepper), plain(planner)
            before_s, plan = loop.now_s, planner.planned
        assert begun is not None, "the signal lasts longer than LEARN_S"
        return begun, ticks


def signal_of(core: Core, scene_name: str, longest_s: float, rate_hz: int) -> tuple[Array, Array]:
    """The scene's signal, up and down again until the time is over; a recording is played once."""
    scene = core.scene
    assert scene.signal is not None, "its forces are asked for"
    range_N = max(scene.force.least_N, core.portrait.min_N), scene.force.most_N
    time_s, force_N = asked(scene.signal, Path(scene_path(scene_name)).parent, range_N, longest_s, rate_hz)
    if not scene.signal.file and time_s[-1] < longest_s:
        force_N = np.tile(force_N, math.ceil(longest_s * rate_hz / len(force_N)))[: round(longest_s * rate_hz)]
        time_s = np.arange(len(force_N)) / rate_hz
    return time_s, force_N


def run_all(cases: Collection[Case], executor: Executor, known: dict[Case, float]) -> dict[Case, float]:
    """The outcome of every case, in their order. Those that are `known` are not run again; new ones are added there."""
    for case, future in finished(executor, run, [case for case in dict.fromkeys(cases) if case not in known], "run"):
        known[case] = future.result()
    return {case: known[case] for case in cases}


def load_task(name_or_path: str) -> Scene:
    """The same scene with every term, whatever its file says of them: what terms are measured on."""
    return msgspec.structs.replace(convert(scene_path(name_or_path), Scene), terms=EVERY_TERM)
