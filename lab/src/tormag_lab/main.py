"""`tormag-lab NAME`: the laboratory's commands, each in a module that is loaded when it is asked for.

A command's module has `add_options(parser)` and `run(options)`, which returns a `Found`. `--json` prints its figures as
one JSON object; otherwise they are printed for a person. A number outside its option's range is refused with what is
allowed, and exit code 2.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from typing import Any, NamedTuple

from tormag_lab.errors import LabError, not_installed
from tormag_lab.told import lines
from tormagd import __version__
from tormagd.element.physics.errors import DomainError
from tormagd.ground.command_line import Within
from tormagd.ground.files import did_you_mean
from tormagd.ground.table import TableError
from tormagd.ground.terminal import write_answer, write_in_any_encoding, write_line
from tormagd.simulation.parameters import PlantError
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import in_short, printable

NOT_TOLD, USAGE = 1, 2
REFUSALS = (LabError, ConfigError, TableError, DomainError, PlantError)


class Found(NamedTuple):
    """A command's result: plain data, the exit code, and lines for a person where a plain table will not do."""

    figures: Any
    lines: Iterable[str] | None = None
    exit_code: int = 0


COMMANDS = {
    "reproduce-thesis": ("thesis.reproduction", "the thesis's tables and figures beside ours"),
    "optimise-design": ("design.optimisation", "the brake's geometry for a task"),
    "bound": ("ideal_carriage", "what a device's ideal carriages miss of a force"),
    "bench-sweep": ("training.bench_sweep", "training data from the simulated device on a bench"),
    "calibrate": ("training.calibration", "a model file from the sweeps of `tormagctl calibrate --insert`"),
    "import-data": ("training.import_data", "training data from measured CSV files of any columns, units and signs"),
    "train-model": ("training.train_model", "a model file from training data"),
    "tactile-model": ("tactile.shipped", "a model file of a simulated pad"),
    "twin": ("twin.command", "a plant file of one device from its recordings"),
    "identify-motor": ("motor.command", "a motor and its screw from a log"),
    "tune-position": ("tune_position", "the gains of the position loop for a motor"),
    "fleet": ("fleet", "what the recordings of many consoles say of each"),
}


SEED = Within(0, 2**31, is_whole=True).__call__
WORKERS = Within(1, 1024, is_whole=True).__call__
GAP_SPEED = Within(1e-6, 1e4, " mm/s").__call__


def main(arguments: Sequence[str] | None = None) -> int:
    write_in_any_encoding()
    given = list(sys.argv[1:] if arguments is None else arguments)
    name = given[0] if given else "--help"
    if name in COMMANDS:
        return run(name, given[1:])
    commands = [f"  {each:20}{summary}" for each, (_, summary) in COMMANDS.items()]
    usage = ["usage: tormag-lab NAME [--help] ...", "       tormag-lab --version", "", *commands]
    told = {"--version": [f"tormag-lab {__version__}"], "-h": usage, "--help": usage}
    if name in told:
        return 0 if write_answer("\n".join(told[name]), "tormag-lab") else NOT_TOLD
    refused = f"tormag-lab: no command {in_short(name)}{did_you_mean(name, COMMANDS) or '; there are:'}"
    write_line("\n".join([refused, *commands]), sys.stderr)
    return USAGE


def run(name: str, arguments: Sequence[str]) -> int:
    """Run a command of COMMANDS, print what it found on stdout and return its exit code."""
    try:
        module = import_module(f"tormag_lab.{COMMANDS[name][0]}")
        parser = argparse.ArgumentParser(
            prog=f"tormag-lab {name}", description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        parser.add_argument("--json", action="store_true", help="print one JSON object")
        module.add_options(parser)
        options = parser.parse_args(arguments)
        command: Callable[[argparse.Namespace], Found] = module.run
        found = command(options)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("tormag"):
            raise
        return _refuse(name, not_installed(error.name.partition(".")[0]))
    except OSError as error:
        return _refuse(name, f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except ValueError as error:
        if not isinstance(error, REFUSALS):
            raise
        return _refuse(name, str(error))
    told = lines(found.figures) if found.lines is None else found.lines
    is_told = write_answer(json.dumps(found.figures) if options.json else "\n".join(told), f"tormag-lab {name}")
    return found.exit_code if is_told else found.exit_code or NOT_TOLD


def _refuse(name: str, reason: str) -> int:
    write_line(printable(f"tormag-lab {name}: {reason}"), sys.stderr)
    return USAGE
