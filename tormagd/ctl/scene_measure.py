"""`tormagctl scene measure`: a scene served live beside simulated devices, in each way: error and price of one run.

This process publishes to a daemon of its own: the scene's signal, the same seldom, steps, a wall's force. A step counts
from COMES_S on. Of two devices the first chooses rates and search; the chosen way is then tried with one thing more
each, of what a hand or its publisher gives.
"""

import contextlib
import math
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.processes import begun, first_line, is_linked, processor_s
from tormagd.ctl.scene import as_toml, derived_of, loaded, write_scene
from tormagd.element.physics.force import TORMAG
from tormagd.ground.files import in_place_of
from tormagd.ground.machine_loop import machine_us
from tormagd.ground.scheduling import ask_for_fifo
from tormagd.ground.terminal import write_line
from tormagd.scenes.measured import AHEAD_MS, ENDING, MeasuredScene, OperatingPoint, Served, own_way, served_like
from tormagd.scenes.scene import MIN_CONTROL_HZ, Scene, scene_path
from tormagd.scenes.signal import asked
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ENDPOINTS

RATES_HZ = (1_000, 500), (500, 500), (500, 83)
"Of control and plans; the usual first."
CHOOSES, JUDGES = 2, 3
"Samples; models learned from the first."
DENSE_HZ, PREVIEW_STEP_S = 1_000, 0.02
SELDOM_HZ = 20.0
STEP_S, COMES_S, STEPS = 1.5, 1.1, (0.8, 0.2)
"Shares of the range."
CONTACT_S = 2.0
"So long the wall's force rises from 0."
LASTS_S = {"approach": 1.0, "signal": 3.0, "seldom": 1.4, "steps": len(STEPS) * STEP_S, "contact": CONTACT_S + 0.2}
PRESSES_S = 9.0
"A finger comes late: the approach of a pad lasts so much longer."
NEARER, NEARER_N = 0.25, 0.2
"A standby is above the least force by this share of the range, and at most so much."
SLOWER_MM_S = 38.0
"The gap closes as slowly as it opens: a motor is spared."
PRICED, LOOKS_HZ = ("signal", "steps"), 2.0
"Where setpoints come as often as plans; meanwhile the machine is looked at."
MM_S_AT_1_RPM = 1e3 * math.tau * TORMAG.roller_radius_m / 60.0
"So fast the simulated roller's surface is."
OPEN_MM = 0.1
"A gap so near its end is open: excess force is the device's."
VALID_FOR_MS = 200.0
STARTS_S, FIFO = 30.0, 50
LOG = "log"


class Part(NamedTuple):
    """One situation of a run."""

    name: str
    begins_s: float
    ends_s: float
    sent_hz: float
    ahead_s: float = 0.0
    "How far ahead the publisher knows."


class Course(NamedTuple):
    """Forces at DENSE_HZ; the first part does not count."""

    time_s: npt.NDArray[np.float64]
    force_N: npt.NDArray[np.float64]
    parts: tuple[Part, ...]


class Heard(NamedTuple):
    """The plant's true state over a run, the daemon's last status; when it began, CLOCK_REALTIME."""

    truth: Any
    status: dict[str, Any]
    start_ns: int
    share: float
    machine_us: float


def measure_scene(name: str) -> Outcome:
    """Measure the scene live, and keep what was found beside it."""
    scene, derived, out = loaded(name), derived_of(name, None), scene_path(name).with_suffix(ENDING)
    if scene.signal is None:
        raise usage_error(
            f"scene {scene.name}: signal is missing: without one nothing is known of what it asks for",
            "tormagctl guide scene says how one is stated",
        )
    range_N = max(scene.force.least_N, derived["least_N"]), min(scene.force.most_N, derived["most_N"])
    ways, machines = ways_of(scene, derived["solver"]["solver"]), list[float]()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that what was begun is ended

    def run(way: OperatingPoint, sample: int) -> Served:
        found, machine = served(name, scene, way, sample, range_N, Path(profiles))
        machines.append(machine)
        found = msgspec.structs.replace(found, share=round(found.share * machines[0] / machine, 4))
        errors = ", ".join(f"{situation} {1e3 * error_N:.1f}" for situation, error_N in found.rms_N.items())
        write_line(f"{way} on {found.device}: {errors} mN, {found.share:.1%} of a processor", sys.stderr)
        return found

    with tempfile.TemporaryDirectory(prefix="tormag-") as profiles:
        write_line(f"{scene.name}: up to {len(ways) + 7} live runs, about three minutes", sys.stderr)
        runs = _runs(scene, ways, range_N, run)
    found = MeasuredScene(scene.fingerprint, scene.force.tolerance_rms_N, round(machines[0], 1), *runs)
    with as_usage_error(OSError, hint="copy the scene to a folder that you may write to"), in_place_of(out) as beside:
        beside.write_bytes(msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n")
    return Outcome(
        msgspec.to_builtins(found) | {"file": str(out)},
        f"{out} is written; chosen: {found.chosen.way}. tormagctl scene explain {name} shows all",
    )


def _runs(
    scene: Scene, ways: list[OperatingPoint], range_N: tuple[float, float], run: Callable[[OperatingPoint, int], Served]
) -> tuple[tuple[Served, ...], ...]:
    """Return what was served, judged, and given more; the best of that is judged too."""

    def like(runs: list[Served]) -> list[Served]:
        return served_like(runs, scene.force.tolerance_rms_N, scene.bandwidth)

    tried = [run(way, CHOOSES) for way in ways]
    cheapest = min(like(tried), key=lambda each: each.way.sum_hz)
    judged = [run(way, JUDGES) for way in dict.fromkeys((cheapest.way, ways[0]))]
    if judged[0] not in like(judged[::-1]):
        judged.reverse()
    chosen = tried[ways.index(judged[0].way)]
    more = [run(way, CHOOSES) for way in more_of(scene, chosen.way, range_N)]
    best = min(like([chosen, *more]), key=lambda each: each.worst_N)
    return tuple(tried), (*judged, *([run(best.way, JUDGES)] if best in more else [])), tuple(more)


def ways_of(scene: Scene, runs: str) -> list[OperatingPoint]:
    """Return the ways to try, the usual one first."""
    # newton is refused where none but nearest is chosen
    first, *others = [runs] if runs == "nearest" != scene.solver.name else dict.fromkeys(["newton", "nearest", runs])
    stated_hz = max(scene.bandwidth.control_hz, MIN_CONTROL_HZ), scene.bandwidth.inference_hz
    usual_hz = max(stated_hz[0], RATES_HZ[0][0]), max(stated_hz[1], RATES_HZ[0][1])
    ways = [own_way(scene, *hz, first) for hz in dict.fromkeys((usual_hz, *RATES_HZ[1:], stated_hz))]
    return ways + [own_way(scene, *stated_hz, search) for search in others]


def more_of(scene: Scene, way: OperatingPoint, range_N: tuple[float, float]) -> list[OperatingPoint]:
    """Return the way with one thing more each that the scene does not state."""
    nearer_N = range_N[0] + min(NEARER * (range_N[1] - range_N[0]), NEARER_N)
    more = {"ahead_ms": AHEAD_MS, "slid_s": sum(LASTS_S.values())}
    if scene.element == "torque":
        more |= {"standby_N": round(nearer_N, 3), "gap_speed_mm_s": SLOWER_MM_S}
    return [msgspec.structs.replace(way, **{key: value}) for key, value in more.items() if not getattr(way, key)]


def served(
    name: str, scene: Scene, way: OperatingPoint, sample: int, range_N: tuple[float, float], profiles: Path
) -> tuple[Served, float]:
    """Return errors and price of one run, and `machine_us` meanwhile. A way that is learned follows the same one."""
    course = course_of(name, scene, way, range_N)
    profile = profiles / f"{sample} {hash(msgspec.structs.replace(way, slid_s=0.0))}"
    heard = _heard(name, scene, way, sample, course, profile)
    if heard.status["faults"] or heard.status["rates"]["control"]["stalls"]:  # a busy host causes some
        heard = _heard(name, scene, way, sample, course, profile)
    if heard.status["faults"]:  # no force at all
        rms_N = {part.name: range_N[1] for part in course.parts[1:]}
    else:
        rms_N = errors_N(course, heard, scene.insert.gap_open_mm, way.standby_N)
    plan_us = heard.status["rates"]["inference"]["exec_us"]["p50"]
    return Served(way, f"{_kind(scene)}_{sample}", rms_N, round(heard.share, 4), plan_us), heard.machine_us


def _kind(scene: Scene) -> str:
    return "pad" if scene.element == "tactile" else "sample"


def course_of(name: str, scene: Scene, way: OperatingPoint, range_N: tuple[float, float]) -> Course:
    assert scene.signal is not None, "its forces are asked for"
    low_N, high_N = range_N
    lasts = LASTS_S | {"approach": LASTS_S["approach"] + (PRESSES_S if scene.element == "tactile" else 0.0)}
    counts = {part: round(lasts_s * DENSE_HZ) for part, lasts_s in lasts.items()}
    played = counts["signal"] + counts["seldom"]
    _, signal_N = asked(scene.signal, scene_path(name).parent, range_N, played / DENSE_HZ, DENSE_HZ)
    signal_N = np.resize(signal_N, played)
    step_N = low_N + (high_N - low_N) * np.repeat(STEPS, counts["steps"] // len(STEPS))
    approach_N = np.full(counts["approach"], signal_N[0])
    contact_N = np.clip(scene.force.most_N / CONTACT_S * np.arange(counts["contact"]) / DENSE_HZ, *range_N)
    force_N = np.concatenate([approach_N, signal_N, step_N, contact_N])
    usual_hz = (
        way.inference_hz if scene.signal.setpoint_hz is UNSET else min(scene.signal.setpoint_hz, way.inference_hz)
    )
    parts, begins_s = [], 0.0
    for part, lasts_s in lasts.items():
        hz = min(SELDOM_HZ, usual_hz) if part == "seldom" else usual_hz
        parts.append(Part(part, begins_s, begins_s + lasts_s, hz, 0.0 if part == "steps" else 1e-3 * way.ahead_ms))
        begins_s += lasts_s
    if scene.element == "tactile":  # a finger in a pad meets no wall
        parts.pop()
    return Course(np.arange(len(force_N)) / DENSE_HZ, force_N, tuple(parts))


def errors_N(course: Course, heard: Heard, gap_open_mm: float, standby_N: float) -> dict[str, float]:
    """Return the RMS of true less asked force by situation; below `standby_N`, that is asked."""
    truth, found = heard.truth, dict[str, float]()
    time_s = (truth["t_ns"] - heard.start_ns) * 1e-9
    for name, begins_s, ends_s, *_ in course.parts[1:]:
        if name == "seldom":  # the step after it may be known ahead
            ends_s -= 1e-3 * AHEAD_MS
        inside = (time_s >= begins_s) & (time_s < ends_s)
        if name == "steps":
            phase_s = (time_s - begins_s) % STEP_S
            inside &= (phase_s >= COMES_S) & (phase_s < STEP_S - 2.0 / DENSE_HZ)  # the next is not yet asked for
        asked_N = np.interp(time_s, course.time_s, course.force_N)
        error_N = (truth["force_N"] - np.maximum(asked_N, standby_N))[inside]
        is_least = (truth["gap_mm"][inside] >= gap_open_mm - OPEN_MM) & (error_N > 0.0)
        found[name] = round(float(np.sqrt(np.mean(np.where(is_least, 0.0, error_N) ** 2))), 5)
    return found


def _heard(name: str, scene: Scene, way: OperatingPoint, sample: int, course: Course, profile: Path) -> Heard:
    with tempfile.TemporaryDirectory(prefix="tormag-") as made, contextlib.ExitStack() as stack:
        folder = Path(made)
        port = _device(stack, folder, scene, sample)
        write_scene(name, way, folder / "scene.toml")
        tables = {
            "scene": str(folder / "scene.toml"),
            "device": {"backend": "can", "port": port, "profiles": str(profile)},
            "device.options": {"interface": "tormagsim"},
            "endpoints": {each: f"ipc://{folder}/{each}" for each in ENDPOINTS},
            "rates": {"control_hz": way.control_hz, "inference_hz": way.inference_hz},
            "realtime": {"fifo_priority": FIFO, "lock_memory": True},
        }
        (folder / "tormagd.toml").write_text(as_toml(tables), encoding="utf-8")
        daemon = begun(stack, folder / LOG, "-P", "-m", "tormagd.daemon.main", "--config", str(folder / "tormagd.toml"))
        client = stack.enter_context(contextlib.closing(Client.local(str(folder), STARTS_S, "measure")))
        if not is_linked(client, daemon, STARTS_S):
            raise _ended("the daemon", folder)
        client.arm(STARTS_S)
        played = _play(client, course, daemon.pid)
        status = client.request("status")
        stack.close()  # the device writes the rest as it ends
        truth = np.genfromtxt(folder / "truth.csv", delimiter=",", names=True)
    return Heard(truth, status, *played)


def _device(stack: contextlib.ExitStack, folder: Path, scene: Scene, sample: int) -> str:
    rpm, finger = scene.handle.most_mm_s / MM_S_AT_1_RPM, scene.finger
    hand = f"steady={rpm:g}" if finger is UNSET else f"pressing={finger.depth_mm:g}"
    arguments = ["--can", "--truth", str(folder / "truth.csv"), "--plant", f"{_kind(scene)}_{sample}", "--hand", hand]
    arguments += ["--insert", scene.insert.name] if scene.element == "torque" else []
    device = begun(stack, folder / LOG, "-P", "-m", "tormagd.simulation", *arguments)
    if not (port := first_line(device)):
        raise _ended("the simulated device", folder)
    return port


def _ended(what: str, folder: Path) -> CommandError:
    said = (folder / LOG).read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return CommandError(Exit.REFUSED, "not_measured", f"{what} ended: {said[-1] if said else ''}", "try it again")


def _play(client: Client, course: Course, pid: int) -> tuple[int, float, float]:
    ask_for_fifo(FIFO - 20)
    start_s, start_ns = time.monotonic(), time.time_ns()
    spent_s, took_s, machine = 0.0, 0.0, list[float]()
    for part in course.parts:
        fields: dict[str, Any] = {"preview_dt_ms": 1e3 * PREVIEW_STEP_S} if part.ahead_s else {}
        ahead_s = PREVIEW_STEP_S * np.arange(round(part.ahead_s / PREVIEW_STEP_S) + 1)
        begun_s, before_s = time.monotonic(), processor_s(pid)
        for at_s in np.arange(part.begins_s, part.ends_s, 1.0 / part.sent_hz):
            time.sleep(max(start_s + at_s - time.monotonic(), 0.0))
            force_N, *ahead_N = np.interp(at_s + ahead_s, course.time_s, course.force_N).tolist()
            if part.ahead_s:
                fields["preview_N"] = tuple(ahead_N)
            client.publish(force_N, VALID_FOR_MS, start_ns + round(at_s * 1e9), **fields)
            if part.name in PRICED and (at_s - course.parts[1].begins_s) * LOOKS_HZ >= len(machine):
                machine.append(machine_us(1))
        if part.name in PRICED:
            spent_s, took_s = spent_s + processor_s(pid) - before_s, took_s + time.monotonic() - begun_s
    return start_ns, spent_s / took_s, statistics.median(machine)
