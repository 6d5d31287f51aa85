"""The black box's file, and every recording that may be run again: the entries of `/core`, exact to the bit.

Each message of `/core` is one part that the daemon handed over. The metadata say which core it was, and it is built
again from them. What people see, in the other topics, is compared with what `/core` gives.
"""

from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from mcap.records import Message

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import Config, checked
from tormagd.control.assembly.build import Core, build_core, platform_name, sources_hash
from tormagd.ground.files import in_place_of
from tormagd.record.journal import FORMAT, MISSING
from tormagd.record.reader import Contents, RecordingError, damage_in, opened
from tormagd.record.telemetry import COLUMNS
from tormagd.record.writer import (
    CORE_TOPIC,
    FRAMES_TOPIC,
    NUMBER_COLUMN,
    TELEMETRY_TOPIC,
    TICKS_TOPIC,
    Derived,
    RecordingWriter,
    is_tick,
)
from tormagd.scenes.scene import Scene
from tormagd_client.endpoints import ConfigError

MAX_BYTES, MAX_ENTRIES = 50_000_000, 1_000_000
"Bounds on what is read of one file, a minute of 1 kHz; what comes after is passed over."
NO_BLACK_BOX = f"no black box of tormagd: it has nothing in {CORE_TOPIC}, or not what a replay needs"
NEEDED = (
    "format", "version", "sources_sha256", "platform", "configuration", "scene", "scene_folder", "model",
    "core_sha256", "columns",
)  # fmt: skip
SHOWN = 12
"Digits of a hash that messages show."


class ReplayError(ValueError):
    """A black box that cannot be run again here."""


class BlackBoxFile(msgspec.Struct, frozen=True):
    """One black box as read: its header, and the entries of all parts in their order, as plain data."""

    header: dict[str, str]
    entries: list[Any]
    is_complete: bool = True
    "False for a file that was cut short, or is longer than what is read: entries up to there are there."
    odd: str = ""
    """The first message of another topic that `/core` does not give, or why an entry of `/core` gives none."""


def write_black_box(path: Path, header: dict[str, str], parts: Iterable[bytes]) -> None:
    """Write a black box of these entries, whole or not at all."""
    columns = msgspec.json.decode(header["columns"], type=tuple[str, ...])
    with in_place_of(path) as beside, RecordingWriter(beside, header) as writer:
        for part in parts:
            writer.entries(columns, msgspec.msgpack.decode(part, type=list[Any]), part)


def read_black_box(path: Path) -> BlackBoxFile:
    """Read the black box in `path`; one that was cut short is returned as far as it reads, with `is_complete` False."""
    found = _Reading()
    with opened(path) as file:
        contents = Contents(file, str(path))
        for topic, sent in contents.messages(file):
            if "format" not in contents.metadata or found.is_over:
                break  # before all of a long recording has been read
            if contents.lost:
                found.expected.clear()  # what is derived is compared no more
            found.take(topic, sent, contents.metadata.get("columns", "[]"))
        damage = damage_in(file)
    if not found.entries:
        raise RecordingError(f"{path}: {NO_BLACK_BOX}")
    is_complete = contents.is_complete and not found.is_over
    for topic, expected in found.expected.items() if is_complete else ():
        if expected and not found.odd:
            found.odd = f"message {expected[0][0]} is missing in {topic}, and {CORE_TOPIC} has it"
    return BlackBoxFile(contents.metadata, found.entries, is_complete, found.odd or damage)


class _Reading:
    """A black box while it is read: each message of another topic is compared with what `/core` gives."""

    def __init__(self) -> None:
        self.entries: list[Any] = []
        topics = TICKS_TOPIC, FRAMES_TOPIC, TELEMETRY_TOPIC
        self.expected: dict[str, deque[tuple[int, int, bytes]]] = {topic: deque() for topic in topics}
        self.odd, self.is_over = "", False
        self._derived = Derived()
        self._size = 0
        self._tick: int | None = None

    def take(self, topic: str, sent: Message, columns: str) -> None:
        """Keep the entries in a message of `/core`, or compare one that is derived with them, or pass it over."""
        if topic == CORE_TOPIC:
            self._part(msgspec.json.decode(columns, type=tuple[str, ...]), sent.data)
        elif topic in self.expected and not self.odd:
            expected = self.expected[topic]
            if not expected or (sent.sequence, sent.log_time, sent.data) != expected.popleft():
                self.odd = f"message {sent.sequence} in {topic} is not what {CORE_TOPIC} has"

    def _part(self, columns: tuple[str, ...], data: bytes) -> None:
        entries, self._size = msgspec.msgpack.decode(data, type=list[Any]), self._size + len(data)
        self.is_over = self._size > MAX_BYTES or len(self.entries) + len(entries) > MAX_ENTRIES
        if self.is_over:
            return
        try:
            self._join([each[columns.index(NUMBER_COLUMN)] for each in entries if is_tick(each)])
            for topic, t_ns, number, shown in self._derived.of(columns, entries) if self.expected else ():
                self.expected[topic].append((number, t_ns, msgspec.json.encode(shown)))
        except (ValueError, TypeError, AttributeError, OverflowError, LookupError) as error:
            self.odd = self.odd or f"{CORE_TOPIC}: {str(error)[:100]}"
        self.entries.extend(entries)

    def _join(self, numbers: list[int]) -> None:
        """Note that entries are missing before these, which were lost on the way or are another daemon's."""
        if numbers and self._tick is not None and not self._tick <= numbers[0] <= self._tick + 1:
            self.entries.append([MISSING])
        self._tick = numbers[-1] if numbers else self._tick


class Recorded(NamedTuple):
    """A black box whose header has been checked."""

    box: BlackBoxFile
    config: Config
    scene: Scene
    beside: Path
    "The file's folder, where the model may be, too."


def told(path: Path, run: Callable[[Recorded], dict[str, Any]]) -> dict[str, Any]:
    """Return what a black box is, what differs here, and what `run` gives for it."""
    box = read_black_box(path)
    try:
        known = recorded(box, path.absolute().parent)
        return {
            "file": str(path),
            "odd": box.odd,
            "version": box.header["version"],
            "reason": box.header.get("reason", ""),
            "build": str(settle()),
            "is_complete": box.is_complete,
            "differences": differences(box.header),
            **run(known),
        }
    except ReplayError as error:
        other = box.header.get("sources_sha256", "") not in ("", sources_hash())
        hint = "; another tormagd wrote it: replay it with that one" if other else ""
        raise ReplayError(f"{path}: {error}{hint}") from error


def recorded(box: BlackBoxFile, beside: Path) -> Recorded:
    """Check a black box's header."""
    header = box.header
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise ReplayError(f"its header has no {missing[0]!r}: it is no black box of this version")
    if header["format"] != str(FORMAT):
        raise ReplayError(
            f"format = {header['format'][:20]!r}, written by tormagd {header['version'][:20]!r}: allowed is {FORMAT}, "
            f"which tormagd {__version__} writes; replay it with the version that wrote it"
        )
    if _json(header, "columns", tuple[str, ...]) != COLUMNS:
        raise ReplayError(f"its ticks have other columns: tormagd {header['version'][:20]!r} wrote it")
    try:
        config = checked(_json(header, "configuration", dict[str, Any]), Config)
        return Recorded(box, config, checked(_json(header, "scene", dict[str, Any]), Scene), beside)
    except (ConfigError, RecursionError) as error:
        raise ReplayError(f"its configuration is refused: {error}") from error


def rebuilt(known: Recorded, config: Config | None = None) -> Core:
    """Build the recorded core, or that of another configuration with the recorded scene."""
    found, model = "", known.box.header["model"]
    for folder in (Path(known.box.header["scene_folder"]), known.beside):
        try:
            core = build_core(config or known.config, known.scene, folder)
        except (ConfigError, ValueError, OSError) as error:
            found = found or str(error)
            continue
        if core.model == model:
            return core
        found = f"the model {known.scene.insert.model!r} that is here has the hash {core.model[:SHOWN]}"
    raise ReplayError(f"the model with the hash {model[:SHOWN]!r} has to be beside the file: {found}")


def differences(header: dict[str, str]) -> list[str]:
    """List what differs since the file was written: build, platform."""
    found = []
    here, there = sources_hash(), header["sources_sha256"]
    if here != there:
        found.append(
            f"build: tormagd {header['version'][:20]} with the sources {there[:SHOWN]} was recorded, here is "
            f"tormagd {__version__} with {here[:SHOWN]}"
        )
    if header["platform"] != platform_name():
        found.append(f"platform: {header['platform'][:80]} was recorded, here is {platform_name()}")
    return found


def _json(header: dict[str, str], name: str, kind: Any) -> Any:
    try:
        return msgspec.json.decode(header[name], type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ReplayError(f"{name}: {str(error)[:100]}") from error
