"""Starting the daemon, or printing what would run."""

import argparse
import asyncio
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import uvloop

from tormagd.config import Config, load_config
from tormagd.control.assembly.build import STANDBY_N, Core, build_core, least_resolution_N
from tormagd.daemon.black_box import BlackBox, header
from tormagd.daemon.daemon import Daemon
from tormagd.daemon.profiles import state_folder
from tormagd.daemon.realtime import OPEN_FILES, prepare
from tormagd.daemon.search_process import SearchProcess
from tormagd.ground.access_keys import KeyRing
from tormagd.ground.files import raise_open_files
from tormagd.ground.terminal import write_answer, write_line
from tormagd.ground.toml_file import placed
from tormagd.hardware.backend import Backend, choose, installed
from tormagd.scenes.measured import at_rates_of
from tormagd.scenes.scene import load_scene
from tormagd_client.endpoints import ENDPOINTS, ConfigError
from tormagd_client.printable import in_short, printable


def start(options: argparse.Namespace) -> int:
    try:
        config = _configured(options)
        keys = KeyRing(config.endpoints) if any(map(config.endpoints.is_guarded, ENDPOINTS)) else None
        _require_folders(config)
        core = build_core(config)
        backend = choose(config.device, config.rates)
    except ConfigError as error:
        raise ConfigError(placed(options.config, str(error))) from error
    if options.check:
        return 0 if write_answer(_resolved(config, core, backend.options), "tormagd") else 1
    try:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(_run(config, core, backend.open, keys, options))
    except (ConfigError, OSError) as error:
        write_line(f"tormagd: {printable(str(error))}", sys.stderr)
        return 1
    return 0


def _configured(options: argparse.Namespace) -> Config:
    config = load_config(options.config)
    if options.scene is not None:
        config = msgspec.structs.replace(config, scene=options.scene)
    return at_rates_of(load_scene(config.scene), config)


def _require_folders(config: Config) -> None:
    for key, given, mode, allowed in (
        ("black_box.folder", config.black_box.folder, os.W_OK, "write to, or make"),
        ("device.profiles", config.device.profiles, os.W_OK, "write to, or make"),
        ("device.calibrations", config.device.calibrations, os.R_OK, "read"),
    ):
        folder = Path(given or "/").absolute()
        there = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
        if given and not (given.isprintable() and there.is_dir() and os.access(there, mode | os.X_OK)):
            said = f"allowed is a folder that this process may {allowed}; {there} is none"
            raise ConfigError(f"{key} = {in_short(given)}: {said}")


async def _run(
    config: Config,
    core: Core,
    open_backend: Callable[[], Backend],
    keys: KeyRing | None,
    options: argparse.Namespace,
) -> None:
    """Start the processes beside it, make this thread a real-time one, and run the daemon to its end."""
    raise_open_files(OPEN_FILES)
    # before this thread becomes a real-time one: child processes would inherit its processors
    folder = state_folder(config.black_box.folder, "blackbox")
    box = BlackBox(folder, header(config, core), config.rates.control_hz)
    beside = SearchProcess(core) if core.element.is_beside else None
    refused = prepare(config.realtime)
    file = None if options.config is None else str(options.config.absolute())
    await Daemon(config, core, open_backend, refused, keys, box, partial(_configured, options), beside, file).run()


def _resolved(config: Config, core: Core, options: msgspec.Struct) -> str:
    """Return what `--check` prints, as JSON."""
    device = msgspec.structs.replace(config.device, options=msgspec.to_builtins(options))
    resolved = {
        "config": msgspec.to_builtins(msgspec.structs.replace(config, device=device)),
        "scene": msgspec.to_builtins(core.scene),
        "derived": {
            "least_N": core.portrait.min_N,
            "most_N": core.portrait.max_N,
            "phase_margin_deg": core.margins.phase_margin_deg,
            "gain_margin_dB": core.margins.gain_margin_dB,
            "solver": core.solver._asdict(),
            "backend": config.device.backend,
            "control_hz": config.rates.control_hz,
            "inference_hz": config.rates.inference_hz,
            "plan_every_setpoint": config.rates.plan_every_setpoint,
            "fingerprint": core.scene.fingerprint,
            "terms_out": core.scene.terms.left_out,
            "least_resolution_N": least_resolution_N(core.portrait, core.scene.force.most_N),
            "missed_rms_N": None if core.missed is None else core.missed.rms_N,
            "missed_share": None if core.missed is None else core.missed.share,
            "approaches_s": _approaches_s(core),
        },
        "backends": {name: reason or "loads" for name, reason in installed().items()},
    }
    return msgspec.json.format(msgspec.json.encode(resolved), indent=2).decode()


def _approaches_s(core: Core) -> list[tuple[float, float]]:
    """Return forces at which a brake may wait, N, and how long the gap takes from there to the middle force, s."""
    if core.scene.element == "tactile":
        return []
    reach, force = core.portrait, core.scene.force
    waits_N = [max(force.waiting_N, reach.min_N), *(reach.min_N + share * STANDBY_N for share in (1 / 3, 2 / 3, 1.0))]
    middle_mm = reach.gap_mm_at((waits_N[0] + force.most_N) / 2.0)
    return [(wait_N, (reach.gap_mm_at(wait_N) - middle_mm) / core.gap_speeds.sure_mm_s) for wait_N in waits_N]
