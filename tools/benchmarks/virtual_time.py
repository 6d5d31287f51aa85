"""`benchmark virtual-time`: how many times faster than real time the closed loop runs, and what limits it.

The full plant with its firmware and protocol bytes, once under the whole core that follows 500 setpoints a second, once
under the position loop alone. Each build of the core, and with `--against` another checkout, is a process of its own,
and they take turns in stretches of some milliseconds: what a shared machine gives at a time, it gives to all of them.
Processor time of one thread; the median over stretches, and of their ratios. Profiled shares charge each function with
its own time, calls excluded; profiling makes short functions look longer than they are, and does not see into compiled
ones: it is the interpreted build that is profiled.
"""

import argparse
import contextlib
import cProfile
import json
import pstats
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import firmware_protocol
import tormagd
from benchmarks.against import add_against_argument, environment
from benchmarks.step import START_MM, STEP_MM, hold
from tormagd.closed_loop import ClosedLoop, stream
from tormagd.config import Config
from tormagd.control.core import build_core
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

SETPOINT_HZ = 500
MEAN_N, SWING_N, PULSE_HZ = 1.2, 0.3, 1.2
STRETCH_TICKS = 100
BUILDS = ("compiled", "interpreted")
LOOPS = ("whole_core", "position_loop")
SHOWN = 12
"Functions in the profile."

Run = Callable[[int], None]


def force_loop(config: Config, plant: str) -> Run:
    """Runs so many ticks of the whole core, asked for a pulse without end."""
    loop = armed_loop(config, plant)
    times_s = np.arange(0.0, 600.0, 1.0 / SETPOINT_HZ)
    setpoint = stream(times_s, MEAN_N + SWING_N * np.sin(2.0 * np.pi * PULSE_HZ * times_s))

    def run(ticks: int) -> None:
        for _ in range(ticks):
            loop.tick(setpoint(loop.now_s))

    return run


def gap_loop(config: Config, plant: str) -> Run:
    """Runs so many ticks of the position loop alone, asked for a step of the gap every 0.1 s."""
    loop = armed_loop(config, plant)

    def run(ticks: int) -> None:
        for _ in range(ticks):
            gap_mm = START_MM + STEP_MM * (int(loop.now_s * 10.0) % 2)
            loop.tick(plan=hold(gap_mm, loop.now_s))

    return run


def armed_loop(config: Config, plant: str) -> ClosedLoop:
    """Homed and enabled."""
    core = build_core(config)
    loop = ClosedLoop(config, core.stepper, core.planner, VirtualDevice(load_plant(plant), SteadyHand(), seed=1))
    loop.arm()
    return loop


class Build:
    """One build of one checkout in a process of its own. A context manager.

    `root` is a checkout, None for the one that runs here. Raises RuntimeError where the process does not start, or
    measures another package than it should.
    """

    def __init__(self, plant: str, root: Path | None = None, interpreted: bool = False) -> None:
        package = Path(tormagd.__path__[0]) if root is None else root / "tormagd"
        child_environment = environment(root)
        if interpreted:
            child_environment["TORMAG_COMPILED"] = "0"
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(Path(__file__).with_name("virtual_time_worker.py")), plant],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=child_environment,
            text=True,
        )
        try:
            hello = json.loads(self._line())
            if not Path(hello["package"]).samefile(package):
                raise RuntimeError(f"{hello['package']} was measured in place of {package}")
        except BaseException:
            self._end()
            raise
        self.is_compiled = bool(hello["compiled"])

    def __enter__(self) -> "Build":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def tick_us(self, loop: str, ticks: int) -> float:
        """Processor time of a tick in the next stretch of that loop."""
        return float(self._asked(f"{loop} {ticks}"))

    def profile(self, ticks: int) -> dict[str, Any]:
        """Where so many ticks of the whole core spend their time: see `profiled`."""
        found: dict[str, Any] = json.loads(self._asked(f"profile {ticks}"))
        return found

    def _asked(self, question: str) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{question}\n")
        self._process.stdin.flush()
        return self._line()

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the loop in a process of its own ended with status {self._process.wait()}")
        return line

    def _end(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._process.communicate(timeout=30)


Stretches = dict[str, dict[str, list[float]]]
"""Processor times of a tick, us: a list for each build and loop; stretches of one number were run side by side."""


def compared(plant: str, ticks: int, against: Path | None) -> Stretches:
    """Every build there is, `interpreted` always, `compiled` and `against` where there is one, taking turns."""
    with contextlib.ExitStack() as stack:
        ours = stack.enter_context(Build(plant))
        builds = {"interpreted": ours}
        if ours.is_compiled:
            builds = {"compiled": ours, "interpreted": stack.enter_context(Build(plant, interpreted=True))}
            if builds["interpreted"].is_compiled:
                raise RuntimeError("TORMAG_COMPILED=0 did not switch the compiled core off")
        if against is not None:
            builds["against"] = stack.enter_context(Build(plant, against))
        return take_turns({name: build.tick_us for name, build in builds.items()}, ticks)


def take_turns(builds: Mapping[str, Callable[[str, int], float]], ticks: int) -> Stretches:
    """`ticks` of each loop and build, in stretches; who begins changes from one to the next."""
    found: Stretches = {name: {loop: [] for loop in LOOPS} for name in builds}
    order = list(builds)
    for loop in LOOPS:
        for name in order:
            builds[name](loop, STRETCH_TICKS)  # not counted: caches and branches are learned
    for _ in range(max(1, ticks // STRETCH_TICKS)):
        for loop in LOOPS:
            for name in order:
                found[name][loop].append(builds[name](loop, STRETCH_TICKS))
        order.append(order.pop(0))
    return found


def summary(found: Stretches, period_us: float) -> dict[str, Any]:
    """The contract's object. `whole_core` and `position_loop` at the top are those of the build that runs by default;
    each `ratio` is one build's factor over the other's, the median over stretches."""
    shown: dict[str, Any] = {name: _build(found[name], period_us) if name in found else None for name in BUILDS}
    default = "compiled" if "compiled" in found else "interpreted"
    result = {loop: _loop(found[default][loop], period_us) for loop in LOOPS} | {"build": default} | shown
    if "compiled" in found:
        result["ratio"] = _ratios(found, "compiled", "interpreted")
    if "against" in found:
        ratios = {name: _ratios(found, name, "against") for name in BUILDS if name in found}
        result["against"] = _build(found["against"], period_us) | {"ratio": ratios}
    return result


def _build(loops: dict[str, list[float]], period_us: float) -> dict[str, Any]:
    parts = {loop: _loop(taken_us, period_us) for loop, taken_us in loops.items()}
    factors: dict[str, Any] = {loop: part["factor"] for loop, part in parts.items()}
    return factors | {"tick_us": {loop: part["tick_us"] for loop, part in parts.items()}}


def _loop(taken_us: list[float], period_us: float) -> dict[str, Any]:
    typical_us, best_us = statistics.median(taken_us), float(np.percentile(taken_us, 10.0))
    return {
        "factor": round(period_us / typical_us, 2),
        "tick_us": {"p50": round(typical_us, 1), "p10": round(best_us, 1)},
    }


def _ratios(found: Stretches, faster: str, slower: str) -> dict[str, float]:
    return {
        loop: round(statistics.median(np.divide(found[slower][loop], found[faster][loop]).tolist()), 3)
        for loop in LOOPS
    }


def profiled(run: Run, ticks: int) -> dict[str, Any]:
    """Share of each room in the time, those of the functions, and how many calls a tick all of them are."""
    profile = cProfile.Profile()
    profile.runcall(run, ticks)
    rooms: Counter[str] = Counter()
    functions: Counter[str] = Counter()
    total_calls = 0
    # the stubs do not know of `stats`: (file, line, name) to (calls, primitive calls, own time, cumulative time, ...)
    for (file, _, name), (_, calls, own_s, _, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        rooms[_room(file)] += own_s
        total_calls += calls
        functions[f"{_room(file)}: {Path(file).stem}.{name}, {calls / ticks:.3g} a tick"] += own_s
    total_s = rooms.total()
    return {
        "calls_per_tick": round(total_calls / ticks),
        "rooms": {room: round(own_s / total_s, 3) for room, own_s in rooms.most_common()},
        "functions": {name: round(own_s / total_s, 3) for name, own_s in functions.most_common()},
    }


def _room(file: str) -> str:
    for package in (tormagd, firmware_protocol):
        # by where the packages are, whatever the folders above them are called
        folder = Path(package.__path__[0])
        if Path(file).is_relative_to(folder):
            inside = Path(file).relative_to(folder).parts[0].removesuffix(".py")
            return inside if package is tormagd else package.__name__
    return "Python and NumPy"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark virtual-time`."""
    parser.add_argument("--seconds", type=float, default=10.0, help="virtual time of each loop")
    parser.add_argument("--plant", default="sample_1", help="plant file or the name of a committed sample")
    parser.add_argument("--profile", action="store_true", help="also say where the time goes")
    add_against_argument(parser)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The contract's object; `factor` and `tick_us` (median, and the fastest tenth); `profile` of the whole core."""
    config = Config()
    ticks = round(options.seconds * config.rates.control_hz)
    result: dict[str, Any] = {"plant": options.plant, "seconds": options.seconds}
    result |= summary(compared(options.plant, ticks, options.against), 1e6 / config.rates.control_hz)
    if options.profile:
        with Build(options.plant, interpreted=True) as build:
            profile = build.profile(ticks)
        profile["functions"] = dict(list(profile["functions"].items())[:SHOWN])
        result["profile"] = profile
    return result


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    for name in (*BUILDS, "against"):
        found: dict[str, Any] = result.get(name) or {}
        for loop in LOOPS if found else ():
            tick_us = found["tick_us"][loop]
            print(
                f"{name:12s}{loop.replace('_', ' '):15s}{found[loop]:6.2f} times real time, a tick "
                f"{tick_us['p50']:.0f} us (fastest tenth {tick_us['p10']:.0f})"
            )
    if result["compiled"] is None:
        print("no compiled build")
    else:
        _print_ratio("compiled", "interpreted", result["ratio"])
    for name, ratio in result.get("against", {}).get("ratio", {}).items():
        _print_ratio(name, "against", ratio)
    if "profile" in result:
        print(f"the whole core calls {result['profile']['calls_per_tick']} functions a tick; its time goes into")
        for part in ("rooms", "functions"):
            for name, share in result["profile"][part].items():
                print(f"{share:7.1%}  {name}")


def _print_ratio(faster: str, slower: str, ratio: dict[str, float]) -> None:
    print(f"{faster} over {slower}: " + ", ".join(f"{loop.replace('_', ' ')} {ratio[loop]:.2f}" for loop in LOOPS))
