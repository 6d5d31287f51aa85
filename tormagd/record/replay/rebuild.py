"""Rebuilds a black box's core from the file, and tells what differs between its origin and here."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import Config, checked, load_config
from tormagd.control.assembly.build import Core, build_core, platform_name, sources_hash
from tormagd.record.black_box import BlackBoxFile, read_black_box
from tormagd.record.journal import FORMAT
from tormagd.record.telemetry import COLUMNS
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
