"""`python -m tormagd.simulation.rehearse FILE`: a black box again, with the simulated device in place of the real one.

Setpoints, commands and the handle's motion are a black box's; the configuration may be another. The simulator is not
the recorded device, so it runs with the recorded configuration too, to compare with.
"""

import argparse
import json
import logging
import sys
import tomllib
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tormagd.config import Config, checked
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.operating_state import OperatingState, RefusedError
from tormagd.ground.command_line import add, option
from tormagd.ground.plain_values import InexactError
from tormagd.ground.terminal import write_line
from tormagd.record import stream
from tormagd.record.reader import RecordingError
from tormagd.record.rerun import Recorded, ReplayError, name_of, planned_for, rebuilt, reopened, ticks_of
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import FaultError, parse_fault
from tormagd.simulation.hand import RecordedHand
from tormagd.simulation.parameters import PlantError, load_plant
from tormagd_client.endpoints import ConfigError

HOMED_S, CONNECTED_S = 8.0, 0.5
"""Times before the file's first tick, in virtual time."""
PATIENCE_S = 0.5
"How long a refused command is repeated: the simulated device may come to rest later than the real one."
SEED = 1
DRIVEN = (OperatingState.ENABLED, OperatingState.PAUSED)
OPTIONS = (
    option("file", type=Path),
    option("--set", dest="settings", action="append", default=[]),
    option("--plant", default="sample_1"),
    option("--fault", dest="faults", action="append", default=[]),
)


class Happened(msgspec.Struct, frozen=True):
    """What a run met: when each fault was first latched, and how long each limit held."""

    faults: dict[str, float]
    limits: dict[str, float]
    refused: list[str]

    def note(self, at_s: float, faults: Iterable[str], held: Iterable[str], for_s: float) -> None:
        for fault in faults:
            self.faults.setdefault(str(fault), round(at_s, 3))
        for limit in dict.fromkeys(map(str, held)):
            self.limits[limit] = round(self.limits.get(limit, 0.0) + for_s, 6)


class Script(NamedTuple):
    """What a black box's core was asked to do; times are seconds from its first tick."""

    lasts_s: float
    is_homed: bool
    is_driven: bool
    hand: RecordedHand
    setpoints: list[tuple[float, TimedSetpoint | None]]
    commands: list[tuple[float, str]]
    recorded: Happened

    @property
    def begins_s(self) -> float:
        return HOMED_S if self.is_homed else CONNECTED_S


def changed(config: Config, settings: Sequence[str]) -> Config:
    """Return a copy of the configuration with `KEY=VALUE` settings, as in limits.skew_fault_mm=2."""
    tables: dict[str, Any] = msgspec.to_builtins(config)
    for setting in settings:
        key, equals, text = setting.partition("=")
        table, names = tables, key.strip().split(".")
        for name in names[:-1]:
            inner = table.get(name)
            if not isinstance(inner, dict):
                raise ReplayError(f"--set {setting[:80]}: there is no {key.strip()[:60]!r} in the configuration")
            table = inner
        if not equals or names[-1] not in table:
            raise ReplayError(f"--set {setting[:80]}: allowed is KEY=VALUE, as in limits.skew_fault_mm=2")
        try:
            table[names[-1]] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            table[names[-1]] = text.strip()
        except (ValueError, RecursionError) as error:  # an integer of thousands of digits, or endless nesting
            raise ReplayError(f"--set {setting[:80]}: {error}") from error
    try:
        return checked(tables, Config)
    except ConfigError as error:
        raise ReplayError(f"--set: {error}") from error


def script(entries: list[Any]) -> Script:
    """Return the setpoints, taken commands and handle positions of a black box's entries."""
    ticks = list(ticks_of(entries).values())
    first_s = ticks[0].monotonic_s
    setpoints: list[tuple[float, TimedSetpoint | None]] = []
    commands: list[tuple[float, str]] = []
    try:
        for entry in entries:
            if name_of(entry) == stream.PLAN:
                now_s, setpoint = planned_for(entry)
                setpoints.append((now_s - first_s, None if setpoint is None else _later(setpoint, -first_s)))
            elif name_of(entry) == stream.COMMAND:
                name, now_s, was_refused = msgspec.convert(entry[1:4], tuple[str, float, bool])
                if not was_refused:
                    commands.append((now_s - first_s, name))
    except (msgspec.ValidationError, InexactError) as error:
        raise ReplayError(str(error)) from error
    met = next((tick for tick in ticks if tick.measurement is not None), ticks[0])
    is_driven = ticks[0].operating_state in DRIVEN
    return Script(
        lasts_s=ticks[-1].monotonic_s - first_s,
        is_homed=is_driven or met.left_mm is not None,
        is_driven=is_driven,
        hand=_hand(ticks),
        setpoints=setpoints,
        commands=commands,
        recorded=_recorded(ticks),
    )


def rehearse(core: Core, config: Config, todo: Script, plant: str, faults: Sequence[str]) -> Happened:
    try:
        delayed = [fault._replace(at_s=fault.at_s + todo.begins_s) for fault in map(parse_fault, faults)]
        hand = RecordedHand(tuple(time_s + todo.begins_s for time_s in todo.hand.times_s), todo.hand.positions_mm)
        device = VirtualDevice(load_plant(plant), hand, delayed, SEED)
    except (FaultError, PlantError) as error:
        raise ReplayError(str(error)) from error
    loop = ClosedLoop(config, core.stepper(), core.planner(), device)
    try:
        if todo.is_homed:
            loop.arm()
            if not todo.is_driven:
                loop.command("disable")
    except (RuntimeError, RefusedError) as error:
        raise ReplayError(f"the simulated device could not be prepared: {error}") from error
    newest = next((setpoint for _, setpoint in todo.setpoints), None) if todo.is_driven else None
    if loop.now_s > todo.begins_s:
        raise ReplayError(f"the simulated device took {loop.now_s:.1f} s to home: allowed is {todo.begins_s:g} s")
    while loop.now_s < todo.begins_s:
        # as if it had been asked for all along
        loop.tick(None if newest is None else newest.replaced(stamp_s=loop.now_s, valid_for_s=1.0))
    return _run(loop, todo, 1.0 / config.rates.control_hz)


def _run(loop: ClosedLoop, todo: Script, period_s: float) -> Happened:
    happened = Happened({}, {}, [])
    setpoints, commands = list(reversed(todo.setpoints)), list(reversed(todo.commands))
    newest: TimedSetpoint | None = None
    while (time_s := loop.now_s - todo.begins_s) < todo.lasts_s:
        while commands and commands[-1][0] <= time_s:
            at_s, name = commands[-1]
            try:
                loop.command(name)
            except RefusedError as error:
                if time_s - at_s < PATIENCE_S:
                    break
                happened.refused.append(f"{name} at {at_s:.3f} s: {error.message}")
            commands.pop()
        while setpoints and setpoints[-1][0] <= time_s:
            _, setpoint = setpoints.pop()
            newest = None if setpoint is None else _later(setpoint, todo.begins_s)
        sample = loop.tick(newest)
        is_driven = sample.safety.operating_state in DRIVEN
        held = (*sample.plan.limits, *sample.output.limits) if is_driven else ()
        happened.note(time_s, sample.safety.faults, held, period_s)
    return happened


def _recorded(ticks: list[Any]) -> Happened:
    happened, first_s = Happened({}, {}, []), ticks[0].monotonic_s
    for before, tick in pairwise([ticks[0], *ticks]):
        happened.note(tick.monotonic_s - first_s, tick.faults, tick.limits, tick.monotonic_s - before.monotonic_s)
    return happened


def _later(setpoint: TimedSetpoint, by_s: float) -> TimedSetpoint:
    return setpoint.replaced(stamp_s=setpoint.stamp_s + by_s)


def _hand(ticks: list[Any]) -> RecordedHand:
    places: dict[float, float] = {}
    for tick in ticks:
        if tick.sensed_s is not None and tick.device_handle_mm is not None:
            places.setdefault(tick.sensed_s - ticks[0].monotonic_s, tick.device_handle_mm)
    times_s = sorted(places) or [0.0]
    return RecordedHand(tuple(times_s), tuple(places.get(time_s, 0.0) for time_s in times_s))


def _rehearsed(known: Recorded, options: argparse.Namespace) -> dict[str, Any]:
    todo = script(known.box.entries)
    config = changed(known.config, options.settings)
    # a file keeps its own scene only: another one is this machine's
    core = rebuilt(known, config) if config.scene == known.config.scene else build_core(config)
    simulated = rehearse(rebuilt(known), known.config, todo, options.plant, options.faults)
    instead = rehearse(core, config, todo, options.plant, options.faults) if options.settings else None
    return {
        "plant": options.plant,
        "faults": options.faults,
        "settings": options.settings,
        "recorded": msgspec.to_builtins(todo.recorded),
        "simulated": msgspec.to_builtins(simulated),
        "instead": msgspec.to_builtins(instead),
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add(parser, OPTIONS)
    options = parser.parse_args(arguments)

    try:
        with reopened(options.file) as (known, told):
            result = told | _rehearsed(known, options)
    except (ConfigError, RecordingError, ReplayError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0 if write_line(json.dumps(result), sys.stdout) is None else 1


if __name__ == "__main__":
    logging.disable()  # a replayed connection has no news
    sys.exit(main())
