"""`tormagd`: reads the configuration, builds the core, runs the daemon."""

import argparse
import signal
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import Config, load_config
from tormagd.daemon.log import log_to_stderr
from tormagd.output import write_line
from tormagd.toml_file import placed
from tormagd_client.endpoints import ENDPOINTS, ConfigError, Endpoints
from tormagd_client.printable import printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from tormagd.assembly.build import Core
    from tormagd.hardware.backend import Backend
    from tormagd.keys import KeyRing

REFUSED = 2
EXIT_TEXT = """exit codes: 0 ended on request, 1 could not run, 2 configuration refused. SIGTERM opens the gap and ends;
SIGHUP reads keys and configuration again."""


def parser() -> argparse.ArgumentParser:
    """What `tormagd` understands; its man page is made from it, too."""
    made = argparse.ArgumentParser(prog="tormagd", description="Real-time haptic controller daemon.", epilog=EXIT_TEXT)
    made.add_argument("--config", type=Path, metavar="FILE", help="TOML configuration; defaults where it is silent")
    made.add_argument("--scene", metavar="NAME", help="this scene, or scene file, in place of the configuration's")
    made.add_argument("--check", action="store_true", help="print the resolved configuration and exit")
    made.add_argument("--version", action="version", version=f"tormagd {__version__}, {settle()}")
    return made


def main(arguments: list[str] | None = None) -> int:
    """Runs the daemon; returns the exit code: 0 ended on request, 1 could not run, 2 configuration refused."""
    options = parser().parse_args(arguments)
    log_to_stderr()
    # nothing moves until the daemon runs and takes the signal over: before that, Ctrl-C may simply end the process
    interrupt = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return _start(options)
    finally:
        signal.signal(signal.SIGINT, interrupt)


def _start(options: argparse.Namespace) -> int:
    try:
        load_config(options.config)  # what is wrong with it is said before the rest is loaded, which takes a moment
    except ConfigError as error:
        return _refused(str(error))
    # here, not above: the signal has to be seen to first
    import uvloop

    from tormagd.assembly.build import build_core
    from tormagd.hardware.backend import choose

    try:
        config = _configured(options)
        keys = _keys(config.endpoints)
        core = build_core(config)
        backend = choose(config.device, config.rates)
    except ConfigError as error:
        return _refused(placed(options.config, str(error)))
    if options.check:
        _print_resolved(config, core, backend.options)
        return 0
    try:
        uvloop.run(_run(config, core, backend.open, keys, partial(_configured, options)))
    except (ConfigError, OSError) as error:
        write_line(f"tormagd: {printable(str(error))}", sys.stderr)
        return 1
    return 0


def _refused(why: str) -> int:
    write_line(f"tormagd: {printable(why)}", sys.stderr)
    return REFUSED


def _configured(options: argparse.Namespace) -> Config:
    """What the file says, and the command line beside it. Raises ConfigError."""
    from tormagd.assembly.build import at_rates_of
    from tormagd.scenes.scene import load_scene

    config = load_config(options.config)
    if options.scene is not None:
        config = msgspec.structs.replace(config, scene=options.scene)
    return at_rates_of(load_scene(config.scene), config)


def _keys(endpoints: Endpoints) -> "KeyRing | None":
    """The daemon's keys where an endpoint demands them. Raises ConfigError."""
    from tormagd.keys import KeyRing

    return KeyRing(endpoints) if any(endpoints.is_guarded(name) for name in ENDPOINTS) else None


async def _run(
    config: Config,
    core: "Core",
    open_backend: "Callable[[], Backend]",
    keys: "KeyRing | None",
    read_again: "Callable[[], Config]",
) -> None:
    from tormagd.daemon.black_box import BlackBox, header
    from tormagd.daemon.daemon import Daemon
    from tormagd.daemon.profiles import state_folder
    from tormagd.daemon.realtime import prepare
    from tormagd.daemon.search_process import SearchProcess

    # before this thread is a real-time one: the process that is started keeps off its processors
    folder = state_folder(config.black_box.folder, "blackbox")
    box = BlackBox(folder, {} if folder is None else header(config, core), config.rates.control_hz)
    beside = SearchProcess(core) if core.element.is_beside else None
    refused = prepare(config.realtime)
    await Daemon(config, core, open_backend, refused, keys, box, read_again, beside).run()


def _print_resolved(config: Config, core: "Core", options: msgspec.Struct) -> None:
    from tormagd.assembly.build import least_resolution_N
    from tormagd.hardware.backend import installed
    from tormagd.scenes.scene import terms_of

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
            "control_hz": config.rates.control_hz,
            "inference_hz": config.rates.inference_hz,
            "fingerprint": core.scene.fingerprint,
            "terms_out": terms_of(core.scene).left_out,
            "least_resolution_N": least_resolution_N(core.portrait, core.scene.force.most_N),
            "missed_rms_N": None if core.missed is None else core.missed.rms_N,
            "missed_share": None if core.missed is None else core.missed.share,
        },
        "backends": {name: reason or "loads" for name, reason in installed().items()},
    }
    write_line(msgspec.json.format(msgspec.json.encode(resolved), indent=2).decode(), sys.stdout)


if __name__ == "__main__":
    sys.exit(main())
