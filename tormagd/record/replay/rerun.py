"""Runs a core again over its recorded inputs: the same bits, or the first tick and field that differ.

The core is rebuilt from the file's header, and what differs between its origin and here is told.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import Config, checked, load_config
from tormagd.control.assembly.build import Core, build_core, platform_name, sources_hash
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.sensor import Disputed
from tormagd.control.core import PLAN_ERRORS
from tormagd.control.records import Duty, TimedSetpoint
from tormagd.control.safety.codes import Fault, Limit
from tormagd.control.safety.operating_state import RefusedError
from tormagd.element.inverse.solution import Answer
from tormagd.ground.plain_values import packed, plain, restore, restored
from tormagd.hardware.measurement import Measurement
from tormagd.record import journal
from tormagd.record.black_box import BlackBoxFile, read_black_box
from tormagd.record.journal import FORMAT, KNOWN, core_hash
from tormagd.record.replay.conversation import Conversation, Found, differing
from tormagd.record.telemetry import COLUMNS, Moment, TickRecord, measurement_of
from tormagd.record.writer import frames_in, is_tick
from tormagd.scenes.scene import Scene, load_scene
from tormagd_client.endpoints import ConfigError

NEEDED = (
    "format", "version", "sources_sha256", "platform", "configuration", "configuration_sha256", "scene",
    "scene_sha256", "scene_folder", "model", "core_sha256", "columns",
)  # fmt: skip
SHOWN = 12
"Digits of a hash that messages show."


class ReplayError(ValueError):
    """A black box that cannot be run again here."""


class Recorded(NamedTuple):
    config: Config
    scene: Scene
    model: str
    model_folders: tuple[Path, ...]
    columns: tuple[str, ...]
    header: dict[str, str]


def told(
    path: Path, config_file: Path | None, run: Callable[[Recorded, BlackBoxFile], dict[str, Any]]
) -> dict[str, Any]:
    """Return what a black box is, what differs here, and what `run` gives for it."""
    configured = None if config_file is None else load_config(config_file)
    box = read_black_box(path)
    try:
        known = recorded(box, path.absolute().parent)
        return {
            "file": str(path),
            "odd": box.odd,
            "version": known.header["version"],
            "reason": box.header.get("reason", ""),
            "build": str(settle()),
            "is_complete": box.is_complete,
            "differences": differences(known, configured),
            **run(known, box),
        }
    except ReplayError as error:
        other = box.header.get("sources_sha256", "") not in ("", sources_hash())
        hint = "; another tormagd wrote it: replay it with that one" if other else ""
        raise ReplayError(f"{path}: {error}{hint}") from error


def recorded(box: BlackBoxFile, beside: Path) -> Recorded:
    """Check a black box's header and return its contents; the model may also lie in `beside`."""
    header = box.header
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise ReplayError(f"its header has no {missing[0]!r}: it is no black box of this version")
    if header["format"] != str(FORMAT):
        raise ReplayError(
            f"format = {header['format'][:20]!r}, written by tormagd {header['version'][:20]!r}: allowed is {FORMAT}, "
            f"which tormagd {__version__} writes; replay it with the version that wrote it"
        )
    columns = _json(header, "columns", tuple[str, ...])
    lacking = [name for name in COLUMNS if name not in columns]
    if lacking:
        raise ReplayError(f"its ticks have no column {lacking[0]!r}: tormagd {header['version'][:20]!r} wrote it")
    try:
        return Recorded(
            checked(_intact(header, "configuration"), Config),
            checked(_intact(header, "scene"), Scene),
            header["model"],
            (Path(header["scene_folder"]), beside),
            columns,
            header,
        )
    except (ConfigError, RecursionError) as error:
        raise ReplayError(f"its configuration is refused: {error}") from error


def rebuilt(known: Recorded, config: Config | None = None) -> Core:
    found = ""
    for folder in known.model_folders:
        try:
            core = build_core(config or known.config, known.scene, folder)
        except (ConfigError, ValueError, OSError) as error:
            found = found or str(error)
            continue
        if core.model == known.model:
            return core
        found = f"the model {known.scene.insert.model!r} that is here has the hash {core.model[:SHOWN]}"
    raise ReplayError(f"the model with the hash {known.model[:SHOWN]!r} has to be beside the file: {found}")


def differences(known: Recorded, configured: Config | None) -> list[str]:
    """List what differs since the file was written: build, platform, scene, configuration."""
    found = []
    here, there = sources_hash(), known.header["sources_sha256"]
    if here != there:
        found.append(
            f"build: tormagd {known.header['version'][:20]} with the sources {there[:SHOWN]} was recorded, here is "
            f"tormagd {__version__} with {here[:SHOWN]}"
        )
    if known.header["platform"] != platform_name():
        found.append(f"platform: {known.header['platform'][:80]} was recorded, here is {platform_name()}")
    try:
        scene = load_scene((configured or known.config).scene)
    except ConfigError as error:
        found.append(f"scene: the recorded one is used; here is none: {error}")
    else:
        _compare(found, "scene", known.header["scene_sha256"], msgspec.json.encode(scene))
    if configured is not None:
        _compare(found, "configuration", known.header["configuration_sha256"], msgspec.json.encode(configured))
    return found


def _compare(found: list[str], what: str, there: str, data: bytes) -> None:
    here = hashlib.sha256(data).hexdigest()
    if here != there:
        found.append(f"{what}: {there[:SHOWN]} was recorded and is used, here is {here[:SHOWN]}")


def _intact(header: dict[str, str], name: str) -> dict[str, Any]:
    told = hashlib.sha256(header[name].encode()).hexdigest()
    if told != header[f"{name}_sha256"]:
        raise ReplayError(f"{name}: its hash is {told[:SHOWN]}, beside it stands {header[f'{name}_sha256'][:SHOWN]!r}")
    tables: dict[str, Any] = _json(header, name, dict[str, Any])
    return tables


def _json(header: dict[str, str], name: str, kind: Any) -> Any:
    try:
        return msgspec.json.decode(header[name], type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ReplayError(f"{name}: {str(error)[:100]}") from error


UNTAKEN = (
    TypeError, AttributeError, ValueError, ArithmeticError, LookupError, AssertionError, RuntimeError, RecursionError,
)  # fmt: skip
"The core may raise these for values that it never makes itself."
SETPOINT = tuple[
    float, float, float, float | None, float | None, tuple[float, ...], float, int, tuple[Limit, ...], float | None,
    Any,
]  # fmt: skip
NOT_THE_CORES = 1
"Leading columns that the core does not make: `t_ns`, from the clock."


def planned_for(entry: Any) -> tuple[float, TimedSetpoint | None]:
    """Return when a recorded plan began, and its setpoint."""
    now_s, fields = msgspec.convert(entry[1:], tuple[float, SETPOINT | None])
    return now_s, None if fields is None else TimedSetpoint(*fields[:-1], restored(fields[-1], KNOWN))


class Rerun(msgspec.Struct, frozen=True):
    """What a replay gave: `ticks` that agree to the bit, from `from_s` to `to_s`."""

    ticks: int
    from_s: float
    to_s: float
    snapshots: int
    gaps: int
    frames: int
    difference: Found | None


def ticks_of(columns: tuple[str, ...], entries: list[Any]) -> dict[int, Any]:
    order = None if columns == COLUMNS else [columns.index(name) for name in COLUMNS]
    records: dict[int, Any] = {}
    for place, entry in enumerate(entries):
        if is_tick(entry):
            if len(entry) != len(columns):
                raise ReplayError(f"tick {len(records) + 1} has {len(entry)} values: allowed is {len(columns)}")
            try:
                row = entry if order is None else [entry[index] for index in order]
                records[place] = msgspec.convert(row, TickRecord)
            except msgspec.ValidationError as error:
                raise ReplayError(f"tick {len(records) + 1}: {error}") from error
    if not records:
        raise ReplayError("there is no tick in it")
    return records


def rerun(core: Core, columns: tuple[str, ...], entries: list[Any], from_s: float = 0.0) -> Rerun:
    """Run `core` over the entries, up to the first difference or the last tick."""
    records = ticks_of(columns, entries)
    places = list(records)
    first_s = records[places[0]].monotonic_s
    lasts_s = records[places[-1]].monotonic_s - first_s
    if not 0.0 <= from_s <= lasts_s:
        raise ReplayError(f"--from = {from_s:g}: allowed is 0..{lasts_s:.3f} s")
    start = _start(entries, records, first_s + from_s)
    try:
        running = _Running(core, sum(len(frames_in(entry)) for entry in entries[:start]))
    except (ValueError, TypeError) as error:
        raise ReplayError(f"before the start: no frames: {_short(error)}") from error
    number = bisect_right(places, start)
    from_s, agreed, to_s = records[places[number]].monotonic_s - first_s, 0, 0.0
    difference: Found | None = None
    for place in range(start, places[-1] + 1):
        # a step's inputs are in the record of its period, which comes after the period's other entries
        record = records[places[number]]
        time_s = record.monotonic_s - first_s
        try:
            differs = running.compare(record) if place in records else running.take(entries[place], record)
        except UNTAKEN as error:
            raise ReplayError(
                f"tick {number + 1}: the core does not take what stands there: {_short(error)}"
            ) from error
        if differs is not None:
            told = {"recorded": _short(differs.recorded), "replayed": _short(differs.replayed)}
            difference = msgspec.structs.replace(differs, tick=number + 1, time_s=round(time_s, 6), **told)
            break
        if place in records:
            number += 1
            if running.is_known:
                agreed, to_s = agreed + 1, time_s
    return Rerun(agreed, from_s, to_s, running.snapshots, running.gaps, running.conversation.frames, difference)


def _start(entries: list[Any], records: dict[int, Any], until_s: float) -> int:
    """Return the index of the newest snapshot that a tick follows by `until_s`, else of the first."""
    found: int | None = None
    waiting: int | None = None
    for place, entry in enumerate(entries):
        if name_of(entry) == journal.STATE:
            waiting = place
        elif place in records and waiting is not None:
            if found is not None and records[place].monotonic_s > until_s:
                return found
            found, waiting = waiting, None
    if found is None:
        raise ReplayError("there is no snapshot in it that is followed by a tick: under a second was kept")
    return found


class _Running:
    def __init__(self, core: Core, frame: int) -> None:
        self.conversation, self._core = Conversation(frame), core_hash(core.config, core.scene, core.model)
        self._of_frames: Found | None = None
        self._stepper, self._planner = core.stepper(), core.planner()
        self._used = self._planner.planned
        self._failure: Exception | None = None
        self._output: Duty | None = None
        self._measurement: Measurement | None = None
        self.is_known = False
        self.snapshots = self.gaps = 0

    def take(self, entry: Any, record: Any) -> Found | None:
        """Take one entry that is no tick, and return the first difference."""
        name = name_of(entry)
        if name == journal.TOLD:
            return None
        self.conversation.frame += len(frames_in(entry))
        if name == journal.STATE:
            return self._begin(entry)
        if name == journal.MISSING:
            self.gaps += self.is_known
            self.is_known = False
            self.conversation.begin(None)
        elif name == journal.READ:
            self.conversation.read(entry)
        elif name == journal.CONNECTED:
            self.conversation.begin(entry[1])
        elif self.is_known:
            return self._run(name, entry, record)
        return None

    def _run(self, name: str, entry: Any, record: Any) -> Found | None:
        """Do what one entry tells: step, plan, learning, command or fault."""
        match name:
            case journal.STEP:
                self._measurement = measurement_of(record)
                self._of_frames = self.conversation.compare(self._measurement)
                self._used = self._planner.planned
                self._output = self._stepper.step(record.monotonic_s, self._measurement, self._used)
            case journal.WROTE:
                if self._output is None:
                    raise ValueError("something written without a step")
                self._of_frames = self._of_frames or self.conversation.wrote(entry, self._output)
            case journal.PLAN:
                now_s, timed = planned_for(entry)
                try:
                    self._planner.plan(now_s, timed, self._stepper.measured, self._stepper.is_followed)
                except PLAN_ERRORS as error:
                    self._failure = error
            case journal.FORESEE:
                self._planner.governor.foresee()
            case journal.AFRESH:
                self._failure = None
                self._planner.afresh(msgspec.convert(entry[1], float))
            case journal.TEACH | journal.ANSWER:
                match restored(entry[1], KNOWN):
                    case Learned() as learned:
                        self._planner.believe.teach(learned)
                    case Answer() as answer:
                        self._planner.aim.answer = answer
                    case other:
                        raise ValueError(f"{other!r}: allowed is what is learned of a device, or what a search found")
            case journal.CONFIRM:
                self._planner.believe.confirm(msgspec.convert(entry[1], Disputed))
            case journal.COMMAND:
                command, now_s, was_refused, given = msgspec.convert(entry[1:], tuple[str, float, bool, dict[str, Any]])
                try:
                    self._stepper.command(command, now_s, restored(given, KNOWN))
                except RefusedError as error:
                    return None if was_refused else Found(command, "taken", f"refused: {error.message}")
                if was_refused:
                    return Found(command, "refused", "taken")
            case journal.LATCH:
                self._stepper.latch(Fault(entry[1]))
            case journal.LOSE_LINK:
                self._stepper.lose_link()
            case _:
                raise ValueError(f"{name[:40]!r}: no entry of a black box")
        return None

    def compare(self, record: Any) -> Found | None:
        """Return the first column that differs from the recorded tick, or else what its frames show."""
        if not self.is_known:
            return None
        if self._output is None:
            raise ValueError("a tick without a step")
        timing = record.lateness_us, record.exec_us, record.tick
        if self._failure is not None:
            return Found("plan", "made", f"failed: {self._failure}")
        given = Moment(self._stepper, self._output, self._used, self._measurement, *timing).row()
        left, right = msgspec.structs.astuple(record)[NOT_THE_CORES:], msgspec.structs.astuple(given)[NOT_THE_CORES:]
        if packed(left) == packed(right):
            return self._of_frames
        rows = zip(COLUMNS[NOT_THE_CORES:], left, right, strict=True)
        return next(Found(*row) for row in rows if packed(row[1]) != packed(row[2]))

    def _begin(self, entry: Any) -> Found | None:
        """Compare the states with a snapshot's, if they are known, and then take them."""
        _, step, plan, connection, core = entry
        if core != self._core:
            return Found("core", core, self._core)
        differs = None
        if self.is_known:
            self.snapshots += 1
            for what, recorded, own in (("step", step, self._stepper), ("plan", plan, self._planner)):
                differs = differs or differing(f"state.{what}", recorded, plain(own))
            differs = differs or self.conversation.compare_memory(connection)
        self.conversation.begin(connection)
        restore(self._stepper, step, KNOWN)
        restore(self._planner, plan, KNOWN)
        self._failure, self.is_known = None, True
        return differs


def name_of(entry: Any) -> str:
    """Return an entry's name, a word by itself or at the head of a list; empty for a tick."""
    if isinstance(entry, str):
        return entry
    if isinstance(entry, list) and entry and isinstance(entry[0], str):
        return entry[0]
    return ""


def _short(thing: object) -> str:
    text = str(thing) if isinstance(thing, Exception | str) else repr(thing)
    return text if len(text) <= 200 else f"{text[:197]}..."
