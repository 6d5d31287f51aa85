"""TOML that anybody may have written: refused by its shape before it is parsed, by its numbers after, and by what its
tables may say: with the key's path, the value, what is allowed and the line."""

import math
import re
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, get_args

import msgspec

from tormagd.bounded_file import read_bounded
from tormagd.named_file import did_you_mean
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import in_short

MOST_BYTES = 65_536
"Ten times the longest configuration with all its comments."
LONGEST_LINE = 8_192
"Of a key with more parts than that the parser takes the square: a minute."
MOST_GUESSES = 16
"Lines that may give a key, of those that have its name in them: a file may be full of them."
MOST_LINES = 8
"Of one value, to be told where it stands."

T = TypeVar("T")
_OURS = re.compile(r"([a-z_A-Z.]+)(?: =|:) ")
"The key, or the table, that a refusal of ours begins with."
_PLACE = re.compile(r"`\$([^`]*)`")
"The place that one of msgspec's ends with."
_UNKNOWN = re.compile(r"unknown field `(\w+)`")
GONE = {"neutral_margin_N": "; delete it: `enable` goes to any setpoint along a ramp now"}
"Keys of earlier versions, and what to do about them."
_NOTHING = object()
"No value of a table: TOML's and JSON's may be None."


class TomlError(ValueError):
    """A text that is refused: not TOML (with its line), nested too deeply, or with a number that nothing can be."""


def read_toml(path: Path) -> dict[str, Any]:
    """The tables in a file. Raises as `toml_text` and `toml_tables` do."""
    return toml_tables(toml_text(path))


def toml_text(path: Path) -> str:
    """What is in a file. Raises OSError, whose `strerror` says why it is not read, and TomlError."""
    try:
        return read_bounded(path, MOST_BYTES).decode("utf-8-sig")  # editors on Windows put a mark before the first line
    except UnicodeDecodeError as error:
        raise TomlError(f"not UTF-8 text (byte {error.start})") from error


def toml_tables(text: str) -> dict[str, Any]:
    """The tables in `text`, all numbers finite and of 64 bits. Raises TomlError."""
    import tomllib  # not above: who reads no file, as most commands of tormagctl, need not wait for it

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
    """The file's tables as a `kind`. Raises ConfigError naming file, key, value, what is allowed, and the line."""
    return convert_as(path, lambda _tables: kind)


def convert_as(path: Path, kind_of: Callable[[dict[str, Any]], type[T]]) -> T:
    """The file's tables as the kind that they say they are. Raises as `convert` does."""
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
    """A refusal of what a file, which has been read, says: with its name and the line, where it names a key there."""
    where = "" if path is None else _line(toml_text(path), message)
    return f"{path}: {message}{where}" if where else message


def checked(tables: dict[str, Any], kind: type[T], where: str = "$") -> T:
    """The tables as a `kind`, whose root is at `where`. Raises ConfigError naming key, value and what is allowed."""
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        text = str(error)
        told = _value_at(tables, text) + _known_key(kind, text)
        text = text.replace("`object`", "a `[table]`")
        refused = text if "`$" in text or where == "$" else f"{text} - at `$`"
        raise ConfigError(refused.replace("`$", f"`{where}") + told) from error


def table_in(kind: Any) -> type[msgspec.Struct] | None:
    """The table that a field of this type holds, optional or not; None where it is a plain value."""
    structs = (each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, msgspec.Struct))
    return next(structs, None)


def _known_key(kind: Any, message: str) -> str:
    """The known key that is nearest to an unknown one of msgspec's message."""
    if (unknown := _UNKNOWN.search(message)) is None or unknown[1] in GONE:
        return GONE[unknown[1]] if unknown else ""
    table = table_in(kind)
    for name in _key_in(message)[:-1]:
        fields = {field.name: field.type for field in msgspec.structs.fields(table)} if table else {}
        table = table_in(fields.get(name))
    return did_you_mean(unknown[1], [field.name for field in msgspec.structs.fields(table)]) if table else ""


def _line(text: str, message: str) -> str:
    """` (line N)` of the key that the message is about, or of the table it is missing in; nothing without either."""
    key = _key_in(message)
    lines = (line_of(text, key[:size]) for size in range(len(key), 0, -1))
    return next((f" (line {line})" for line in lines if line is not None), "")


def _key_in(message: str) -> list[str]:
    """The key that a refusal names: ours begin with it, msgspec's end with its place, and may name an unknown one."""
    if ours := _OURS.match(message):
        return ours[1].split(".")
    place, unknown = _PLACE.search(message), _UNKNOWN.search(message)
    key = [name for name in place[1].split("[")[0].split(".") if name] if place else []
    return [*key, unknown[1]] if unknown else key


def _value_at(tables: dict[str, Any], message: str) -> str:
    """` (it is VALUE)` for the `$.a.b` path msgspec puts at the end of its message; msgspec leaves the value out.

    An element of an array, `$.a[...]`, is not told from its neighbours, so the value is the array.
    """
    if "`$." not in message:
        return ""
    value = _at(tables, message.rsplit("`$.", 1)[1].rstrip("`").split("[")[0].split("."))
    return "" if value is _NOTHING or isinstance(value, dict) else f" (it is {in_short(value)})"


def _at(table: Any, key: Sequence[str]) -> Any:
    """What `key`, a path through tables, leads to; _NOTHING where it leads nowhere."""
    for name in key:
        table = table.get(name, _NOTHING) if isinstance(table, dict) else _NOTHING
    return table


def line_of(text: str, key: Sequence[str]) -> int | None:
    """The line of `text`, which is TOML, that gives `key`, a path through its tables; None where none of them does.

    The parser keeps no lines. So it is asked after each that has the key's name in it: the first to make the key known
    gives it. None, too, where that name stands in many lines before.
    """
    lines = text.splitlines()
    guesses = (number for number, line in enumerate(lines, start=1) if key and key[-1] in line)
    return next((number for number in islice(guesses, MOST_GUESSES) if _is_known(lines, number, key)), None)


def _is_known(lines: Sequence[str], number: int, key: Sequence[str]) -> bool:
    import tomllib

    for end in range(number, min(number + MOST_LINES, len(lines)) + 1):  # a value may go on in the lines below
        try:
            return _at(tomllib.loads("\n".join(lines[:end])), key) is not _NOTHING
        except ValueError:
            continue
    return False


def _require_numbers(value: Any, key: str) -> None:
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
