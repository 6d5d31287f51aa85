"""Reads TOML that anybody may have written.

A text is refused by its shape before it is parsed, then by its numbers, then by what its tables may hold. A refusal
names the key's path, the value, what is allowed and the line.
"""

import math
import re
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, get_args

import msgspec

from tormagd.ground.files import did_you_mean, read_bounded
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import in_short

MAX_BYTES = 65_536
"Ten times the longest configuration with all its comments."
LONGEST_LINE = 8_192
"Characters in a line: the parser's time grows as the square of a key's parts."
MAX_GUESSES = 16
"Lines with a key's name that are tried: a hostile file may be full of them."
MAX_LINES = 8

T = TypeVar("T")
_OURS = re.compile(r"([a-z_A-Z0-9.]+)(?: =|:) ")
"The key or table at the head of our own refusals."
_PLACE = re.compile(r"`\$([^`]*)`")
"The place at the end of msgspec's refusals."
_UNKNOWN = re.compile(r"unknown field `(\w+)`")
_NOTHING = object()
"A table's value may be None."


class TomlError(ValueError):
    """A text that is refused as TOML."""


def toml_text(path: Path) -> str:
    """Read a UTF-8 text file of at most MAX_BYTES."""
    try:
        return read_bounded(path, MAX_BYTES).decode("utf-8-sig")  # editors on Windows put a byte order mark first
    except UnicodeDecodeError as error:
        raise TomlError(f"not UTF-8 text (byte {error.start})") from error


def toml_tables(text: str) -> dict[str, Any]:
    """Parse `text` as TOML."""
    import tomllib  # not above: most commands of tormagctl read no file

    for number, line in enumerate(text.splitlines(), start=1):
        if len(line) > LONGEST_LINE:
            raise TomlError(f"line {number} has {len(line)} characters: allowed are {LONGEST_LINE}")
    try:
        tables = tomllib.loads(text)
        _require_numbers(tables, "")
    except RecursionError as error:
        raise TomlError(
            "arrays, tables or parts of a key stand too deep in each other: allowed are hundreds"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"not TOML: {error}") from error
    except TomlError:
        raise
    except ValueError as error:  # Python reads no integer of more than 4300 digits
        raise TomlError("not TOML: an integer has more digits than any that is allowed here") from error
    return tables


def convert(path: Path, kind: type[T]) -> T:
    return convert_as(path, lambda _tables: kind)


def convert_as(path: Path, kind_of: Callable[[dict[str, Any]], type[T]]) -> T:
    """Read a TOML file as the kind that `kind_of` chooses by its tables."""
    try:
        text = toml_text(path)
        try:
            tables = toml_tables(text)
            return checked(tables, kind_of(tables))
        except (TomlError, ConfigError) as error:
            raise ConfigError(f"{error}{_line(text, str(error))}") from error
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (TomlError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}") from error


def placed(path: Path | None, message: str) -> str:
    """Return a refusal of the file at `path` as `PATH: message (line N)`."""
    where = "" if path is None else _line(toml_text(path), message)
    return f"{path}: {message}{where}" if where else message


def checked(tables: dict[str, Any], kind: type[T], where: str = "$") -> T:
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        text = str(error)
        told = _value_at(tables, text) + _known_key(kind, text)
        text = text.replace("`object`", "a `[table]`")
        refused = text if "`$" in text or where == "$" else f"{text} - at `$`"
        raise ConfigError(refused.replace("`$", f"`{where}") + told) from error


def table_in(kind: Any) -> type[msgspec.Struct] | None:
    structs = (each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, msgspec.Struct))
    return next(structs, None)


def _known_key(kind: Any, message: str) -> str:
    """Return `; did you mean ...?` for an unknown key."""
    if (unknown := _UNKNOWN.search(message)) is None:
        return ""
    table = table_in(kind)
    for name in _key_in(message)[:-1]:
        fields = {field.name: field.type for field in msgspec.structs.fields(table)} if table else {}
        table = table_in(fields.get(name))
    return did_you_mean(unknown[1], [field.name for field in msgspec.structs.fields(table)]) if table else ""


def _line(text: str, message: str) -> str:
    """Return ` (line N)` of the key in a refusal, or of the nearest table above it."""
    key = _key_in(message)
    lines = (line_of(text, key[:size]) for size in range(len(key), 0, -1))
    return next((f" (line {line})" for line in lines if line is not None), "")


def _key_in(message: str) -> list[str]:
    """Return the key that a refusal names, as its parts."""
    if ours := _OURS.match(message):
        return ours[1].split(".")
    place, unknown = _PLACE.search(message), _UNKNOWN.search(message)
    key = [name for name in place[1].split("[")[0].split(".") if name] if place else []
    return [*key, unknown[1]] if unknown else key


def _value_at(tables: dict[str, Any], message: str) -> str:
    """Return ` (it is VALUE)` for the path in a refusal of msgspec, which leaves the value out."""
    if "`$." not in message:
        return ""
    value = _at(tables, message.rsplit("`$.", 1)[1].rstrip("`").split("[")[0].split("."))
    return "" if value is _NOTHING or isinstance(value, dict) else f" (it is {in_short(value)})"


def _at(table: Any, key: Sequence[str]) -> Any:
    """Return what the path `key` leads to in nested tables, or _NOTHING."""
    for name in key:
        table = table.get(name, _NOTHING) if isinstance(table, dict) else _NOTHING
    return table


def line_of(text: str, key: Sequence[str]) -> int | None:
    """Return the number of the line, from 1, that gives `key`."""
    lines = text.splitlines()
    guesses = (number for number, line in enumerate(lines, start=1) if key and key[-1] in line)
    return next((number for number in islice(guesses, MAX_GUESSES) if _is_known(lines, number, key)), None)


def _is_known(lines: Sequence[str], number: int, key: Sequence[str]) -> bool:
    """Whether `key` is known after line `number`, or at most MAX_LINES later."""
    import tomllib

    for end in range(number, min(number + MAX_LINES, len(lines)) + 1):  # a value may go on in the lines below
        try:
            return _at(tomllib.loads("\n".join(lines[:end])), key) is not _NOTHING
        except ValueError:
            continue
    return False


def _require_numbers(value: Any, key: str) -> None:
    """Raise TomlError for a number that is not finite or not of 64 bits."""
    if isinstance(value, float) and not math.isfinite(value):
        raise TomlError(f"{key} = {value}: allowed is a finite number")
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise TomlError(f"{key}: an integer of {value.bit_length()} bits: allowed are 64")
    if isinstance(value, dict):
        for name, inner in value.items():
            _require_numbers(inner, f"{key}.{name}" if key else name)
    if isinstance(value, list):
        for index, inner in enumerate(value):
            _require_numbers(inner, f"{key}[{index}]")
