"""Writes docs/reference: the configuration from the types in `tormagd/config.py`, the commands from their parsers.

Run `python tools/reference_pages.py` after a change of either; a test compares.
"""

import argparse
import ast
import inspect
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from firmware_protocol.conformance import __main__ as conformance
from tormagd import config
from tormagd.ctl import main as ctl
from tormagd.ctl.completion import subparsers
from tormagd.daemon import main as daemon
from tormagd.hardware import can_backend, serial_backend
from tormagd.record import stream
from tormagd.simulation import __main__ as simulation

FOLDER = Path(__file__).parents[1] / "docs" / "reference"
BACKENDS = {
    "`[device.options]`, `serial`": serial_backend.DRIVER.options,
    "`[device.options]`, `can`": can_backend.DRIVER.options,
}
_CONFIGURATION_HEAD = """# Configuration: every key

`python tools/reference_pages.py` writes this page from the types. See [configure](../guides/configure.md);
`tormagd --check --config FILE` prints what is in force. Brackets hold the default and what is allowed.
"""
_COMMANDS_HEAD = """# Commands: every option

`python tools/reference_pages.py` writes this page from the argument parsers.
"""
BOUNDS = {"ge": "{}", "gt": "over {}", "le": "to {}", "lt": "under {}"}


def main() -> int:
    for name, page in (
        *(("configuration.md", configuration_page()), ("commands.md", commands_page())),
        ("ticks.md", ticks_page()),
    ):
        (FOLDER / name).write_text(page, encoding="utf-8")
    return 0


def configuration_page() -> str:
    parts = [_CONFIGURATION_HEAD]
    for heading, kind in (*tables(config.Config, ""), *BACKENDS.items()):
        says = " ".join(inspect.cleandoc(kind.__doc__ or "").split())
        parts.append(f"## {heading or 'At the top'}\n\n{says}\n")
        parts.append("".join(f"- {name} ({default}; {allowed}): {why}\n" for name, default, allowed, why in keys(kind)))
    return "\n".join(parts)


def tables(kind: type[msgspec.Struct], path: str) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    """Yield the tables of a configuration with their names in the file, each before those in it."""
    yield f"`[{path}]`" if path else "", kind
    for field in msgspec.structs.fields(kind):
        inner = config.table_in(field.type)
        if inner is not None:
            yield from tables(inner, f"{path}.{field.name}".removeprefix("."))


def keys(kind: type[msgspec.Struct]) -> list[tuple[str, str, str, str]]:
    says = _field_docs(kind)
    hints = get_type_hints(kind, include_extras=True)
    return [
        (f"`{field.name}`", _default(field), _allowed(hints[field.name]), says.get(field.name, ""))
        for field in msgspec.structs.fields(kind)
        if config.table_in(field.type) is None
    ]


def commands_page() -> str:
    parts = [_COMMANDS_HEAD]
    for parser in (daemon.parser(), ctl.parser(), simulation.parser(), conformance.parser()):
        parts.append(f"## {parser.prog}\n\n{parser.description}\n")
        shared = _options(parser)
        parts.append("\n".join(shared) + "\n")
        for name, command in subparsers(parser):
            own = [row for row in _options(command) if row not in shared]
            parts.append(f"### {parser.prog} {name}\n\n{command.description}\n")
            if own:
                parts.append("\n".join(own) + "\n")
    return "\n".join(parts)


def ticks_page() -> str:
    return """# Control ticks: every column

`python tools/reference_pages.py` writes this page from the core's records. Their meaning is in
[messages](../messages.md#control-ticks).

""" + "".join(
        f"- {name}: {', '.join(f'`{each}`' for each in columns)}\n"
        for name, columns in (
            *(("plan", stream.OF_PLAN), ("concluded", stream.CONCLUDED), ("duty", stream.OF_DUTY)),
            *(("measurement", stream.OF_MEASUREMENT), ("link", stream.OF_LINK)),
        )
    )


def _options(parser: argparse.ArgumentParser) -> list[str]:
    return [
        f"- `{_called(action, parser._get_formatter())}`{_says(action)}"
        for action in parser._actions
        if not isinstance(action, argparse._SubParsersAction | argparse._HelpAction)
    ]


def _called(action: argparse.Action, formatter: argparse.HelpFormatter) -> str:
    """Return an argument as every Python version shows it, unlike the formatter's own line."""
    if not action.option_strings:
        return formatter._format_args(action, formatter._get_default_metavar_for_positional(action))
    if action.nargs == 0:
        return ", ".join(action.option_strings)
    taken = formatter._format_args(action, formatter._get_default_metavar_for_optional(action))
    return ", ".join(f"{name} {taken}" for name in action.option_strings)


def _says(action: argparse.Action) -> str:
    says = (action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%")
    return says and f": {says}"


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return "required"
    value = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
    # TOML writes as JSON does, except for a table
    return "`{}`" if isinstance(value, dict) else f"`{msgspec.json.encode(value).decode()}`"


def _allowed(hint: Any) -> str:
    inner, *metas = get_args(hint) if hasattr(hint, "__metadata__") else (hint,)
    elements = [each for each in get_args(inner) if each is not ...]
    if get_origin(inner) is Literal:
        return ", ".join(map(str, elements))
    if getattr(inner, "__origin__", None) is tuple:
        return f"list of: {_allowed(elements[0])}"
    bounds = [
        text.format(f"{getattr(meta, name):,}")
        for meta in metas
        for name, text in BOUNDS.items()
        if getattr(meta, name) is not None
    ]
    words = {int: "whole", float: "", str: "text", bool: "true or false"}
    return " ".join((words.get(inner, "table"), *bounds)).strip()


def _field_docs(kind: type[msgspec.Struct]) -> dict[str, str]:
    (body,) = (node.body for node in ast.parse(inspect.getsource(kind)).body if isinstance(node, ast.ClassDef))
    return {
        field.target.id: " ".join(says.value.value.split())
        for field, says in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(says, ast.Expr)
        and isinstance(says.value, ast.Constant)
        and isinstance(says.value.value, str)
    }


if __name__ == "__main__":
    sys.exit(main())
