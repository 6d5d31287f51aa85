"""`benchmark scenes`: how exactly, and at what cost of the daemon, each scene is served.

Without options it prints what the package carries. `--live` measures scenes again. The ways to serve a scene are rates
and searches; they are screened on the scene's own signal and samples 1 to 3. The cheapest is chosen that does what the
usual way does in every situation, on devices that decide; others then judge. An error is accepted within TOLERATED of
the scene's tolerance, or at most WORSE of it over the usual way's. `--shares` measures what each way takes of a
processor, with daemons on simulated devices in turns. `--store` writes the file that comes with the package.
"""

import argparse
import contextlib
import statistics
import tempfile
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path

import msgspec
from devices import SAMPLES, SECOND

from benchmarks import loop
from benchmarks.scene_runs import OF_A_HANDLE, ROOT, SITUATIONS, Case, run_all
from tormag_lab import executors
from tormag_lab.arrays import Json
from tormagd.config import RealTime
from tormagd.control.assembly.build import choose_solver
from tormagd.headroom.machine_loop import machine_us
from tormagd.scenes.measured import (
    FILE,
    MeasuredScene,
    Measurements,
    OperatingPoint,
    Share,
    Tried,
    WorstDevice,
    allowed_N,
    measured,
)
from tormagd.scenes.scene import TERMS, Scene, load_scene, scene_path, shipped_scenes
from tormagd.simulation.parameters import PLANTS_INSERT
from tormagd_client import Client
from tormagd_client.endpoints import ConfigError

STORED = ROOT / "tormagd" / "scenes" / FILE
RATES_HZ = (1_000, 500), (1_000, 83), (500, 500), (500, 83)
"Of control and of plans: the usual ones, and what may be chosen in their place."
SEARCHES = "newton", "nearest"
THESIS = OperatingPoint(500, 83, "thesis")
FIRST_DECIDING, FIRST_JUDGING = 80, 100
"Draws of the plant card; twice as many judge as decide."
DRAWS = 10
PAIRS, SETTLES_S, LASTS_S = 5, 3.0, 5.0
SHARED_SCENE, FIFO = "coronary", 50
KEYS = "daemon", "tick_us", "plan_us"

Runs = Callable[[Collection[Case]], dict[Case, float]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--live", nargs="*", metavar="NAME", help="measure these scenes (names, files; none: all)")
    parser.add_argument("--shares", action="store_true", help="measure what each way takes of a processor")
    parser.add_argument("--store", action="store_true", help="write the file that comes with the package")
    executors.add_options(parser, 1, needed="tormagd, and tools/ on their path")


def measure(options: argparse.Namespace) -> Json:
    file = measured()
    if options.shares:
        ways = [*(OperatingPoint(*hz, search) for hz in RATES_HZ for search in SEARCHES), THESIS]
        shares = tuple(shares_of(ways))
        file = msgspec.structs.replace(file, shares=shares, pairs=PAIRS, machine_us=round(machine_us(), 1))
        store(file, options.store)
    if options.live is not None:
        known: dict[Case, float] = {}
        with executors.chosen(options) as executor:
            runs = partial(run_all, executor=executor, known=known)
            for name in options.live or shipped_scenes():
                found = measured_scene(name, runs)
                scenes = {scene.name: scene for scene in (*file.scenes, found)}
                file = msgspec.structs.replace(file, draws=DRAWS, scenes=tuple(scenes[name] for name in sorted(scenes)))
                store(file, options.store)
    return {"scenes": [figures(scene, file) for scene in file.scenes], "measured_machine_us": file.machine_us}


def store(file: Measurements, is_wanted: bool) -> None:
    if is_wanted:
        STORED.write_bytes(msgspec.json.format(msgspec.json.encode(file), indent=1) + b"\n")


def figures(scene: MeasuredScene, file: Measurements) -> Json:
    chosen, usual = file.share(scene.chosen), file.share(scene.usual.way)
    return {
        "name": scene.name,
        "terms_in": list(TERMS),
        "terms_out": [],
        "control_hz": scene.chosen.control_hz,
        "inference_hz": scene.chosen.inference_hz,
        "solver": scene.chosen.search,
        "rms_N": scene.of(scene.chosen).rms_N[0],
        "rms_full_N": scene.usual.rms_N[0],
        "tolerance_N": scene.tolerance_N,
        "cost_us_per_s": chosen and chosen.ticks_us_s,
        "cost_full_us_per_s": usual and usual.ticks_us_s,
        "daemon_share": chosen and chosen.daemon,
        "daemon_share_full": usual and usual.daemon,
        "plan_us": chosen and chosen.plan_us,
        "judged": [msgspec.to_builtins(each) | {"tolerance_N": scene.tolerance_N} for each in scene.judged],
    }


def measured_scene(name: str, runs: Runs) -> MeasuredScene:
    scene = load_scene(name)
    if scene.signal is None:
        raise ConfigError(f"scene {scene.name}: signal is missing: without one nothing is known of what it asks for")
    own = choose_solver(scene).solver
    ways = [OperatingPoint(*hz, own) for hz in RATES_HZ]
    tried = [tried_way(name, way, runs) for way in ways]
    tolerance_N = scene.force.tolerance_rms_N
    usual, *others = tried
    chosen, judged = usual.way, judge(name, scene, usual.way, usual.way, runs)
    for other in sorted(others, key=lambda each: each.way.control_hz + each.way.inference_hz):
        pairs = zip(other.rms_N, usual.rms_N, strict=True)
        if usual.worst_N > tolerance_N or any(error_N > allowed_N(usual_N, tolerance_N) for error_N, usual_N in pairs):
            continue
        found = judge(name, scene, other.way, usual.way, runs)
        if all(item.rms_N <= allowed_N(item.usual_N, tolerance_N) for item in found if item.group == "deciding"):
            chosen, judged = other.way, found
            break
    hz = chosen.control_hz, chosen.inference_hz
    tried += [tried_way(name, OperatingPoint(*hz, search), runs) for search in SEARCHES if search != own]
    if scene.element == "torque":
        tried.append(tried_way(name, THESIS, runs))
    return MeasuredScene(scene.name, scene.fingerprint, tolerance_N, chosen, tuple(tried), judged)


def tried_way(name: str, way: OperatingPoint, runs: Runs) -> Tried:
    cases = [case_of(name, way, device, "signal", is_learning=True) for device in SAMPLES]
    found = runs(cases)
    return Tried(way, tuple(found[case] for case in cases))


def judge(name: str, scene: Scene, way: OperatingPoint, usual: OperatingPoint, runs: Runs) -> tuple[WorstDevice, ...]:
    tolerance_N = scene.force.tolerance_rms_N
    worst = []
    for group, situation, devices, learns in groups(scene):
        ours, theirs = ([case_of(name, each, device, situation, learns) for device in devices] for each in (way, usual))
        found = runs([*ours, *theirs])
        outcomes = [
            WorstDevice(group, one.device, situation, learns, found[one], found[other])
            for one, other in zip(ours, theirs, strict=True)
        ]
        worst.append(max(outcomes, key=lambda item: item.rms_N - allowed_N(item.usual_N, tolerance_N)))
    return tuple(worst)


def groups(scene: Scene) -> list[tuple[str, str, tuple[str, ...], bool]]:
    """Return group, situation, devices, and whether they learn: what decides, then what judges."""
    if scene.element == "tactile":
        stays = [each for each in SITUATIONS if each not in OF_A_HANDLE]
        return [*(("deciding", each, SAMPLES, True) for each in stays), ("deciding", "signal", SAMPLES, False)]
    deciding, judging = (
        tuple(f"draw {first + number}" for number in range(count))
        for first, count in ((FIRST_DECIDING, DRAWS), (FIRST_JUDGING, 2 * DRAWS))
    )
    # the second plant is an element of its own: no other insert fits into it
    second = (SECOND,) if scene.insert.name == PLANTS_INSERT else ()
    many, held_on = (*SAMPLES, *deciding, *second), (*SAMPLES, *second)
    return [
        *(("deciding", each, held_on if each == "hold" else many, True) for each in SITUATIONS),
        ("deciding", "signal", SAMPLES, False),
        ("judging", "signal", judging, True),
        ("judging", "contact", judging, True),
    ]


def case_of(name: str, way: OperatingPoint, device: str, situation: str, is_learning: bool) -> Case:
    return Case(name, device, situation, way.search, is_learning, way.control_hz, way.inference_hz)


def shares_of(ways: list[OperatingPoint]) -> list[Share]:
    found: dict[OperatingPoint, list[Share]] = {way: [] for way in ways}
    for turn in range(PAIRS):
        for way in ways if turn % 2 == 0 else ways[::-1]:
            found[way].append(share_of(way))
    return [
        Share(way, *(round(statistics.median(getattr(each, key) for each in found[way]), 4) for key in KEYS))
        for way in ways
    ]


def share_of(way: OperatingPoint) -> Share:
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
        scene = Path(folder) / "scene.toml"
        stated = scene_path(SHARED_SCENE).read_text(encoding="utf-8")
        scene.write_text(f'{stated}\n[solver]\nname = "{way.search}"\n', encoding="utf-8")
        rates_hz = way.control_hz, way.inference_hz
        stand = loop.Stand(RealTime(FIFO, lock_memory=True), way.inference_hz, None, rates_hz, str(scene))
        with loop.daemon(stand, Path(folder)) as (config, pid):
            time.sleep(SETTLES_S)
            _, daemon, _ = loop.spent(pid, partial(time.sleep, LASTS_S))
            with contextlib.closing(Client(config.endpoints, 5.0)) as client:
                rates = client.request("status")["rates"]
    return Share(way, daemon, rates["control"]["exec_us"]["p50"], rates["inference"]["exec_us"]["p50"])
