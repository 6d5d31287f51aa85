"""One scene on the simulated device in virtual time, with any of its terms left out: how far the true force is off.

The signal is played from its beginning; after LEARN_S the error counts. A frozen run learns until then, and no more.
Every outcome is kept under a hash of all that it depends on; runs are spread over any `concurrent.futures.Executor`.
"""

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, as_completed
from functools import cache, partial
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from rendering.publisher import PREVIEW_S, publisher
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config, Rates
from tormagd.control.core import Core, build_core
from tormagd.control.estimate import Estimate
from tormagd.control.governor import TimedSetpoint
from tormagd.control.plan import Planner, PlanState
from tormagd.control.step import StepState
from tormagd.hardware.measurement import Measurement
from tormagd.scenes.measured import Cost
from tormagd.scenes.scene import EVERY_TERM, Bandwidth, Scene, Solver, load_scene, scene_path, terms_of
from tormagd.scenes.signal import asked
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import PRESSES_AT_S, PRESSING_MM_S, Hand, PressingHand, RecordedHand
from tormagd.simulation.parameters import PlantParameters, load_plant, with_insert

Array = npt.NDArray[np.float64]
Call = Callable[[], object]

ROOT = Path(__file__).parents[2]
LEARN_S = 4.0
APPROACH_S = 2.0
"The signal's first force is held for so long before it."
HAND_S, HAND_STEP_S, HAND_LASTS_S = 5.3, 0.02, 90.0
"The handle's speed swings between the scene's in this time, evenly in its logarithm."
OPEN_MM = 0.1
"So near its open end a gap is open: too much force there is the device's, and no error of any model."
TIMED_S, ROUNDS = 0.5, 7
VALID_S = 0.1
DEPENDS_ON = (
    "tools/rendering/scene_runs.py",
    "tools/rendering/publisher.py",
    "tormagd/closed_loop.py",
    *(f"tormagd/{room}" for room in ("control", "hardware", "inverse", "model", "physics", "safety", "simulation")),
    "firmware_protocol",
    "tormagd/scenes/signal.py",
)


class Case(msgspec.Struct, frozen=True):
    """One run. `left_out` are names of terms, `search` takes the place of the scene's own where it is given; setpoints
    come `inference_hz` times a second."""

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
    played = _Play(case)
    rows = []
    for time_s, loop in played.ticks(case.seconds):
        truth = loop.device.truth
        if loop.step_state.safety.faults:
            return float(np.sqrt(np.mean(played.force_N**2)))
        if time_s >= LEARN_S:
            rows.append((truth.time_s - played.begins_s, truth.force_N, truth.gap_mm))
    at_s, rendered_N, gap_mm = np.array(rows).T
    error_N = rendered_N - np.interp(at_s, played.time_s, played.force_N)
    is_least = (gap_mm >= played.core.scene.insert.gap_open_mm - OPEN_MM) & (error_N > 0.0)
    return float(np.sqrt(np.mean(np.where(is_least, 0.0, error_N) ** 2)))


def costs(case: Case, others: Sequence[Case]) -> list[Cost]:
    """What steps and plans take in the other cases' models: all are given what the case's own was given in the loop, in
    rounds over all of them, so that a disturbance of the machine meets all alike. Of each step and plan the least of
    ROUNDS counts, and of those the mean."""
    played = _Play(case)
    given: list[tuple[StepState, PlanState, float, TimedSetpoint | None, Measurement | None, Estimate | None]] = []
    before = None
    for time_s, loop in played.ticks(TIMED_S):
        if before is not None and time_s >= LEARN_S:
            now_s = loop.now_s
            given.append((*before, now_s, played.publish(now_s), loop.measurement, loop.step_state.estimate))
        if loop.plan_state is not None:
            before = loop.step_state, loop.plan_state
    cores = [build_core(played.config, _modelled(played.core.scene, other)) for other in others]
    made: list[tuple[list[Call], list[Call]]] = []
    for core in cores:
        planner, stepper = core.planner, core.stepper
        steps: list[Call] = []
        plans: list[Call] = []
        for step_state, plan_state, now_s, setpoint, measurement, estimate in given:
            steps.append(partial(stepper.step, step_state, now_s, measurement, plan_state.plan))
            plans.append(partial(_planned, planner, plan_state, now_s, setpoint, estimate))
        made.append((steps, plans))
    rounds = [[(_each_us(steps), _each_us(plans)) for steps, plans in made] for _ in range(ROUNDS)]
    return [
        Cost(*(round(float(np.mean(np.min([one[index][kind] for one in rounds], axis=0))), 3) for kind in range(2)))
        for index in range(len(others))
    ]


def _modelled(scene: Scene, case: Case) -> Scene:
    """The scene with the case's terms and search."""
    solver = Solver(name=case.search) if case.search else scene.solver
    return msgspec.structs.replace(scene, terms=EVERY_TERM.without(*case.left_out), solver=solver)


def _planned(
    planner: Planner, state: PlanState, now_s: float, setpoint: TimedSetpoint | None, estimate: Estimate | None
) -> None:
    planner.foresee(planner.plan(state, now_s, setpoint, estimate))


def _each_us(calls: list[Call]) -> list[float]:
    spent = []
    for call in calls:
        start_ns = time.thread_time_ns()
        call()
        spent.append((time.thread_time_ns() - start_ns) * 1e-3)
    return spent


class _Play:
    """A case's loop, armed, and its signal behind an approach."""

    def __init__(self, case: Case) -> None:
        rates = Rates(control_hz=case.control_hz, inference_hz=min(case.inference_hz, case.control_hz))
        self.config = config = Config(scene=case.scene, rates=rates)
        stated = load_scene(case.scene)
        free = Bandwidth(control_hz=case.control_hz, inference_hz=rates.inference_hz)
        scene = _modelled(msgspec.structs.replace(stated, bandwidth=free), case)
        self.core = build_core(config, scene)
        self._frozen = None if case.is_learning else _frozen(config, scene)
        self._loop = ClosedLoop(
            config, self.core.stepper, self.core.planner, VirtualDevice(_plant(scene, case), _hand(scene), seed=1)
        )
        self._loop.arm()
        self.time_s, self.force_N = signal_of(self.core, case.scene, LEARN_S + case.seconds, case.inference_hz)
        approach_s = APPROACH_S
        if scene.finger is not msgspec.UNSET:
            approach_s += PRESSES_AT_S + scene.finger.depth_mm / PRESSING_MM_S - self._loop.now_s
        before_s = np.arange(round(approach_s * case.inference_hz)) / case.inference_hz
        self.begins_s = self._loop.now_s + approach_s
        times = np.concatenate([self._loop.now_s + before_s, self.begins_s + self.time_s])
        forces = np.concatenate([np.full(len(before_s), self.force_N[0]), self.force_N])
        is_known = scene.signal is not None and scene.signal.is_known_ahead
        self.publish: Callable[[float], TimedSetpoint | None] = publisher(
            times, forces, PREVIEW_S if is_known else 0.0, VALID_S
        )

    def ticks(self, seconds: float) -> Iterable[tuple[float, ClosedLoop]]:
        """The loop after each tick, with the time in the signal, from the approach to `seconds` after LEARN_S."""
        loop = self._loop
        ends_s = self.begins_s + min(LEARN_S + seconds, float(self.time_s[-1]))
        while loop.now_s < ends_s:
            time_s = loop.now_s - self.begins_s
            if self._frozen is not None and time_s >= LEARN_S:
                loop.plan_with(self._frozen.planner)
                self._frozen = None
            loop.tick(self.publish(loop.now_s))
            yield time_s, loop


def _frozen(config: Config, scene: Scene) -> Core:
    terms = msgspec.structs.replace(terms_of(scene), learning=False)
    return build_core(config, msgspec.structs.replace(scene, terms=terms))


def signal_of(core: Core, scene_name: str, longest_s: float, rate_hz: int) -> tuple[Array, Array]:
    """The scene's signal, up and down again until the time is over; a recording is played once."""
    scene = core.scene
    if scene.signal is None:
        raise ValueError(f"scene {scene.name}: it has no [signal]: nothing is known of what it asks for")
    range_N = max(scene.force.least_N, core.planner.portrait.least_N), scene.force.most_N
    time_s, force_N = asked(scene.signal, Path(scene_path(scene_name)).parent, range_N, longest_s, rate_hz)
    if not scene.signal.file and time_s[-1] < longest_s:
        force_N = np.tile(force_N, math.ceil(longest_s * rate_hz / len(force_N)))[: round(longest_s * rate_hz)]
        time_s = np.arange(len(force_N)) / rate_hz
    return time_s, force_N


def _plant(scene: Scene, case: Case) -> PlantParameters:
    """The sample with the scene's insert in it, or the pad on the sample's carriages."""
    if scene.element == "tactile":
        return load_plant(case.plant.replace("sample", "pad"))
    return with_insert(load_plant(case.plant), scene.insert.name)


def _hand(scene: Scene) -> Hand:
    if scene.finger is not msgspec.UNSET:
        return PressingHand(scene.finger.depth_mm)
    low, high = math.log(scene.handle.least_mm_s), math.log(scene.handle.most_mm_s)
    time_s = np.arange(0.0, HAND_LASTS_S, HAND_STEP_S)
    speed_mm_s = np.exp((low + high) / 2.0 + (high - low) / 2.0 * np.sin(2.0 * math.pi * time_s / HAND_S))
    return RecordedHand(tuple(time_s.tolist()), tuple((np.cumsum(speed_mm_s) * HAND_STEP_S).tolist()))


@cache
def sources_hash() -> str:
    """Of everything but the case that an outcome depends on."""
    seen = hashlib.sha256()
    for place in DEPENDS_ON:
        path = ROOT / place
        files = [path] if path.is_file() else sorted(path.rglob("*"))
        for file in files:
            if file.suffix in (".py", ".toml", ".json", ".safetensors", ".csv"):
                seen.update(file.name.encode() + b"\0" + file.read_bytes())
    return seen.hexdigest()


def key(case: Case) -> str:
    """The content hash under which a case's outcome is kept: sources, scene and case."""
    scene = load_scene(case.scene)
    named = msgspec.structs.replace(case, scene=scene.fingerprint)
    file = b""
    if scene.signal is not None and scene.signal.file:
        file = (Path(scene_path(case.scene)).parent / scene.signal.file).read_bytes()
    return hashlib.sha256(sources_hash().encode() + msgspec.json.encode(named) + file).hexdigest()


def run_all(
    cases: Iterable[Case],
    executor: Executor,
    kept: Path | None = None,
    progress: Callable[[int, int], object] = lambda finished, total: None,
) -> dict[Case, float]:
    """The outcome of every case, in their order. With `kept`, a JSON file, those that are in it are taken from there,
    and new ones are added as they come: what was stopped goes on where it was."""
    wanted = list(dict.fromkeys(cases))
    known: dict[str, float] = {}
    if kept is not None and kept.exists():
        known = msgspec.json.decode(kept.read_bytes(), type=dict[str, float])
    keys = {case: key(case) for case in wanted}
    pending = {executor.submit(run, case): case for case in wanted if keys[case] not in known}
    progress(len(wanted) - len(pending), len(wanted))
    try:
        for finished, future in enumerate(as_completed(pending), len(wanted) - len(pending) + 1):
            known[keys[pending[future]]] = future.result()
            if kept is not None:
                partial_file = kept.with_name(kept.name + ".part")
                partial_file.parent.mkdir(parents=True, exist_ok=True)
                partial_file.write_bytes(msgspec.json.encode(known))
                partial_file.replace(kept)
            progress(finished, len(wanted))
    finally:
        for future in pending:
            future.cancel()
    return {case: known[keys[case]] for case in wanted}
