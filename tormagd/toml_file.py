"""TOML that anybody may have written: refused by its shape before it is parsed, and by its numbers after."""

import math
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from tormagd.bounded_file import read_bounded

MOST_BYTES = 65_536
"Ten times the longest configuration with all its comments."
MOST_DEPTH = 16
"Parts of a key, and arrays and tables in each other: the parser takes their square, or all of the stack."
MOST_GUESSES = 16
"Lines that may give a key, of those that have its name in them: a file may be full of them."
MOST_LINES = 8
"Of one value, to be told where it stands."

# a string that does not end goes on to the end of the line or the text: the parser stops there, too
_TOKEN = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"""|\Z)'
    r"|'''(?:[^']|'(?!''))*+(?:'''|\Z)"
    r'|"(?:[^"\\\n]|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|#[^\n]*+|[\[\]{}.,=\n]",
    re.DOTALL,
)


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

    _require_shallow(text)
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"not TOML: {error}") from error
    except ValueError as error:  # Python reads no integer of more than 4300 digits
        raise TomlError("not TOML: an integer has more digits than any that is allowed here") from error
    _require_numbers(tables, "")
    return tables


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
            table: Any = tomllib.loads("\n".join(lines[:end]))
        except ValueError:
            continue
        for name in key:
            if not isinstance(table, dict) or name not in table:
                return False
            table = table[name]
        return True
    return False


def _require_shallow(text: str) -> None:
    depth = parts = 0
    line = 1
    for token in _TOKEN.finditer(text):
        mark = token[0]
        if mark in "[{":
            depth, parts = depth + 1, 0
        elif mark in "]}":
            depth -= 1
        elif mark == ".":
            parts += 1
        elif mark in ",=\n":
            parts = 0
        line += mark.count("\n")
        if depth > MOST_DEPTH or parts >= MOST_DEPTH:
            what = "arrays or tables in each other" if depth > MOST_DEPTH else "parts of a key"
            raise TomlError(f"more than {MOST_DEPTH} {what} (line {line}): allowed are {MOST_DEPTH}")


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
