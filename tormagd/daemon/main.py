"""`tormagd`: reads the configuration, builds the core, runs the daemon."""

import argparse
import logging
import sys
from pathlib import Path

import msgspec
import torch
import uvloop

from tormagd import __version__
from tormagd.config import Config, ConfigError, load_config
from tormagd.control.core import Core, build_core
from tormagd.daemon.daemon import Daemon
from tormagd.daemon.realtime import prepare
from tormagd.hardware.backend import opener

REFUSED = 2


def main(arguments: list[str] | None = None) -> int:
    """Runs the daemon; returns the exit code: 0 ended on request, 1 could not run, 2 configuration refused."""
    parser = argparse.ArgumentParser(prog="tormagd", description="Real-time haptic controller daemon.")
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML configuration; defaults where it is silent")
    parser.add_argument("--check", action="store_true", help="print the resolved configuration and exit")
    parser.add_argument("--version", action="version", version=f"tormagd {__version__}")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    torch.set_num_threads(1)  # the loop has one core; a second thread would only wait for it
    try:
        config = load_config(options.config)
        core = build_core(config)
        open_backend = opener(config.device)
    except ConfigError as error:
        print(f"tormagd: {error}", file=sys.stderr)
        return REFUSED
    if options.check:
        _print_resolved(config, core)
        return 0
    try:
        uvloop.run(_run(config, core, open_backend))
    except OSError as error:
        print(f"tormagd: {error}", file=sys.stderr)
        return 1
    return 0


async def _run(config: Config, core: Core, open_backend: object) -> None:
    refused = prepare(config.realtime)
    await Daemon(config, core, open_backend, refused).run()  # type: ignore[arg-type]


def _print_resolved(config: Config, core: Core) -> None:
    resolved = {
        "config": msgspec.to_builtins(config),
        "scene": msgspec.to_builtins(core.scene),
        "derived": {
            "least_N": core.planner.portrait.least_N,
            "most_N": core.planner.portrait.most_N,
            "phase_margin_deg": core.margins.phase_margin_deg,
            "gain_margin_dB": core.margins.gain_margin_dB,
            "solver": core.solver._asdict(),
        },
    }
    print(msgspec.json.format(msgspec.json.encode(resolved), indent=2).decode())


if __name__ == "__main__":
    sys.exit(main())
