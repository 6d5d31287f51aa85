"""The command line of `tormagctl`: arguments in, one outcome and an exit code out.

A command's module is imported when it runs, so `tormagctl status` answers without loading plots or solvers.
"""

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec

from tormagd import __version__
from tormagd.config import Config, load_config, load_endpoints
from tormagd.ctl.commands import COMMANDS, FIRST_WORDS, GROUPS, SHARED, USUAL
from tormagd.ctl.outcome import (
    CommandError,
    Exit,
    Outcome,
    as_usage_error,
    exit_code,
    print_error,
    print_outcome,
    usage_error,
)
from tormagd.ground.command_line import Parser, UsageError, add
from tormagd.ground.files import raise_open_files
from tormagd.ground.terminal import write_in_any_encoding, write_line
from tormagd_client.endpoints import ENDPOINTS, ConfigError, Endpoints
from tormagd_client.errors import ClientError
from tormagd_client.printable import in_short

EXTRAS = {
    "mcap": "record",
    "zstandard": "record",
    "matplotlib": "plot",
    "rich": "top",
    "aiohttp": "dashboard",
    "foxglove": "foxglove",
    "prometheus_client": "metrics",
}
OPEN_FILES, OF_OPENING = 32, 10
"libzmq aborts with fewer."
SERVICE_CONFIG = Path("/etc/tormag/tormagd.toml")
EXIT_TEXT = """exit codes: 0 done, 1 refused or not done (doctor: a failure was found), 2 usage, 3 daemon not reachable,
4 device in FAULT. With --json stdout carries one object: {command, ok, result, error}."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, print its outcome or error, and return the exit code."""
    write_in_any_encoding()
    given = sys.argv[1:] if arguments is None else arguments
    try:
        options = parser().parse_args(given)
    except UsageError as error:
        refused = usage_error(error.message, error.hint)
        print_error(next((each for each in given if each in FIRST_WORDS), ""), refused, "--json" in given)
        return refused.exit_code
    try:
        outcome = _run(options)
    except ClientError as error:
        print_error(options.command, error, options.json)
        return exit_code(error)
    except KeyboardInterrupt:
        daemon = "it is told to disable" if options.command == "arm" else "the daemon goes on"
        write_line(f"tormagctl {options.command}: interrupted; {daemon}", sys.stderr)
        return 130
    return print_outcome(options.command, outcome, options.json)


def _run(options: argparse.Namespace) -> Outcome:
    """Call the command's function with its options and what it needs."""
    name = f"{options.command} {options.in_group}".rstrip()
    command = COMMANDS[name]
    file = options.config
    if file is None and options.command == "doctor" and os.path.exists(SERVICE_CONFIG):  # noqa: PTH110  # False of what may not be seen
        file = SERVICE_CONFIG
    known: dict[str, Any] = {
        "command": options.command,
        "config_file": file,
        "wait_s": options.wait,
        "as_json": options.json,
    }
    _raise_open_files(options.command)
    with contextlib.ExitStack() as stack:
        if command.has_daemon:
            with as_usage_error(
                ConfigError,
                hint="correct the file (tormagd --check --config FILE), or give --endpoint ADDRESS in its place",
            ):
                if "config" in command.needs:
                    known["config"] = load_config(file)
                endpoints = load_endpoints(file)
            known["endpoints"] = endpoints if options.endpoint is None else _at(options.endpoint, endpoints)
        else:
            known["parser"] = parser()
        if "client" in command.needs:
            from tormagd_client.blocking import Client

            known["client"] = stack.enter_context(Client(known["endpoints"], options.wait))
        given = {key: value for key, value in vars(options).items() if key not in ("command", "in_group", *USUAL)}
        return _called(name, given | {need: known[need] for need in command.needs})


def _raise_open_files(command: str) -> None:
    try:
        raise_open_files(OF_OPENING if command in ("stop", "disable") else OPEN_FILES)
    except OSError as error:
        raise CommandError(Exit.REFUSED, "open_files", str(error), f"ulimit -n {OPEN_FILES}") from error


def _called(command: str, arguments: dict[str, Any]) -> Outcome:
    """Import the command's function, and call it."""
    module, _, name = COMMANDS[command].function.partition(".")
    try:
        function: Callable[..., Outcome] = getattr(import_module(f"tormagd.ctl.{module}"), name)
        return function(**arguments)
    except ModuleNotFoundError as error:
        if (extra := EXTRAS.get(error.name or "")) is None:
            raise
        raise usage_error(
            f"{command} needs {error.name}, which is not installed", f"pip install 'tormagd[{extra}]'"
        ) from error
    except UnicodeEncodeError as error:  # of an argument, into a message or a file
        raise usage_error(f"{in_short(error.object)}: allowed is UTF-8 text", "give another text or name") from error


def _at(address: str, configured: Endpoints) -> Endpoints:
    """Return the endpoints of the daemon whose control endpoint is `address`, with the configured keys."""
    changed = {"control": address}
    if address.startswith("ipc://") and address.endswith("/control"):
        directory = address.removesuffix("control")
        changed |= {name: directory + name for name in ENDPOINTS}
    try:
        return Config(endpoints=msgspec.structs.replace(configured, **changed)).endpoints
    except ValueError as error:
        raise usage_error(
            f"--endpoint: {error}",
            "give an address such as ipc:///run/tormag/control; tormagctl guide another-machine says what others need",
        ) from error


def parser() -> argparse.ArgumentParser:
    # the common options may stand before or after the command; SUPPRESS keeps the second parser from undoing the first
    shared = Parser(add_help=False, argument_default=argparse.SUPPRESS)
    add(shared, SHARED)
    made = Parser(prog="tormagctl", description="Operate the tormagd haptic controller.", epilog=EXIT_TEXT)
    add(made, SHARED)
    of_commands = (each for command in COMMANDS.values() for each in command.options)
    made.options = tuple(name for names, _ in (*SHARED, *of_commands) for name in names)
    made.set_defaults(**USUAL)
    made.add_argument("--version", action="version", version=f"tormagctl {__version__}")
    made.set_defaults(in_group="")
    # otherwise argparse would lay out a usage to find it
    commands = {"": made.add_subparsers(dest="command", required=True, metavar="COMMAND", prog=made.prog)}
    for name, (text, _, _, options, _) in COMMANDS.items():
        group, _, last = name.rpartition(" ")
        if group not in commands:
            about = GROUPS[group]
            inner = commands[""].add_parser(group, help=about, description=about, parents=[shared], epilog=EXIT_TEXT)
            commands[group] = inner.add_subparsers(dest="in_group", required=True, metavar="ACTION", prog=inner.prog)
        add(commands[group].add_parser(last, help=text, description=text, parents=[shared], epilog=EXIT_TEXT), options)
    return made


if __name__ == "__main__":
    sys.exit(int(main()))
