"""Text of a file, a device or another process, made fit to be shown to a person."""

import json
from collections.abc import Callable
from typing import Any

LONGEST_SHOWN = 80


def printable(text: str) -> str:
    r"""Return `text` on one line, with each unprintable character as JSON escapes it: `\n`, `\u001b`."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else json.dumps(each)[1:-1] for each in text)


def each_text(value: Any, change: Callable[[str], str]) -> Any:
    """Change every text in plain data."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {each_text(key, change): each_text(inner, change) for key, inner in value.items()}
    return [each_text(inner, change) for inner in value] if isinstance(value, list | tuple) else value


def in_short(value: object) -> str:
    """Return a value as a refusal shows it: its repr, cut to LONGEST_SHOWN characters."""
    shown = repr(value)
    return shown if len(shown) <= LONGEST_SHOWN else f"{shown[: LONGEST_SHOWN - 3]}..."


def require(condition: bool, key: str, value: object, allowed: str) -> None:
    """Raise ValueError naming the key, its value and what is allowed, unless `condition` holds."""
    if not condition:
        raise ValueError(f"{key} = {in_short(value)}: allowed is {allowed}")
