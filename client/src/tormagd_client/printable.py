"""Text of a file, a device or another process, as it may be shown to a person."""

import json

LONGEST_SHOWN = 80
"Characters of a value that a refusal shows: an answer with it has to stay readable itself."


def printable(text: str) -> str:
    """`text` on one line, with each character that is not printable as JSON escapes it: `\\n`, `\\u001b`."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else json.dumps(each)[1:-1] for each in text)


def in_short(value: object) -> str:
    """A value as a refusal shows it."""
    shown = repr(value)
    return shown if len(shown) <= LONGEST_SHOWN else f"{shown[: LONGEST_SHOWN - 3]}..."


def require(condition: bool, key: str, value: object, allowed: str) -> None:
    """Raises ValueError naming the key, its value and what is allowed, unless the condition holds."""
    if not condition:
        raise ValueError(f"{key} = {in_short(value)}: allowed is {allowed}")
