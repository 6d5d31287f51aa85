"""A command line that refuses in one sentence with the next step, and suggests what may have been meant."""

import argparse
import math
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeAlias

from tormagd.ground.files import did_you_mean
from tormagd.ground.terminal import write_answer
from tormagd_client.printable import in_short, printable

LONGEST = 300
"Characters of a refusal that quotes what was given."
MAX_NAME_BYTES = 255
UNKNOWN_OPTION = "unrecognized arguments: "
Option: TypeAlias = tuple[tuple[str, ...], dict[str, Any]]


def option(*names: str, **settings: Any) -> Option:
    return names, settings


def add(parser: argparse._ActionsContainer, options: Iterable[Option]) -> None:
    for names, settings in options:
        parser.add_argument(*names, **settings)


class UsageError(Exception):
    """The command line cannot be used: `message` says why, `hint` what to do next."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message, hint)
        self.message, self.hint = message, hint


class Parser(argparse.ArgumentParser):
    """A parser that raises UsageError instead of ending the process."""

    options: tuple[str, ...] = ()

    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self.register("type", Path, path)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError with this message, cut to LONGEST characters."""
        if message.startswith(UNKNOWN_OPTION):
            known = self.options or tuple(self._option_string_actions)
            message += did_you_mean(message.removeprefix(UNKNOWN_OPTION).split()[0], known)
        raise UsageError(printable(message.removeprefix("argument ")[:LONGEST]), f"{self.prog} --help")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            near = did_you_mean(value, action.choices) or f": allowed are {', '.join(action.choices)}"
            raise argparse.ArgumentError(action, f"{in_short(value)}{near}")

    def _print_message(self, message: str, file: Any = None) -> None:
        if not write_answer(message.rstrip(), self.prog):
            sys.exit(1)


def path(text: str) -> Path:
    """Parse a path that a file system may have."""
    if not text or any(len(os.fsencode(part)) > MAX_NAME_BYTES for part in text.split("/")):
        raise argparse.ArgumentTypeError(f"{in_short(text)}: allowed are names of 1..{MAX_NAME_BYTES} bytes")
    return Path(text)


def number(text: str) -> float:
    """Parse a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a finite number")
    return value


class Within(NamedTuple):
    """Parses a number from `least` to `most`."""

    least: float
    most: float
    unit: str = ""
    is_whole: bool = False

    def __call__(self, text: str) -> float:
        value, kind = number(text), "a whole number " if self.is_whole else ""
        if not self.least <= value <= self.most or (self.is_whole and not value.is_integer()):
            raise argparse.ArgumentTypeError(f"{text}: allowed is {kind}{self.least:.10g}..{self.most:.10g}{self.unit}")
        return int(value) if self.is_whole else value
