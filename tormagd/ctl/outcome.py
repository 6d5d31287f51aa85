"""How a command ends: exit codes, the errors behind them, and what is printed."""

import errno
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from functools import partialmethod
from typing import Any, TextIO

import msgspec

from tormagd.ground.terminal import write_answer, write_line
from tormagd_client.errors import ClientError, InFaultError, SettingError, UnreachableError
from tormagd_client.printable import each_text, printable

NARROWEST = 20
LABEL = re.compile(r"\S{0,24} +")
NEW_FILE = "allowed is a new file in a folder that exists"
WRITABLE = "give another file's name, in a directory you may write to"
ROOM = "make room on its disk"
REMEDIES = {
    errno.ENOSPC: ROOM,
    errno.EDQUOT: ROOM,
    errno.EFBIG: "take another disk, or allow larger files: ulimit -f",
    errno.EIO: "check its disk",
}


class Exit(IntEnum):
    DONE = 0
    REFUSED = 1
    USAGE = 2
    UNREACHABLE = 3
    FAULT = 4


class CommandError(ClientError):
    """A command that failed for a reason that `tormagctl` itself found."""

    def __init__(self, exit_code: Exit, code: str, message: str, hint: str) -> None:
        super().__init__(code, message, hint)
        self.exit_code = exit_code


def exit_code(error: ClientError) -> Exit:
    """Return the exit code for an error, REFUSED for an unknown kind."""
    if isinstance(error, CommandError):
        return error.exit_code
    codes = {InFaultError: Exit.FAULT, UnreachableError: Exit.UNREACHABLE, SettingError: Exit.USAGE}
    return codes.get(type(error), Exit.REFUSED)


def usage_error(message: str, hint: str) -> CommandError:
    """Return a CommandError for an argument, or a file it names, that cannot be used."""
    return CommandError(Exit.USAGE, "usage", message, hint)


@contextmanager
def as_usage_error(*kinds: type[Exception], hint: str) -> Iterator[None]:
    """Turn exceptions of these kinds into a CommandError (USAGE) with `hint`."""
    try:
        yield
    except kinds as error:
        raise refused(error, hint) from error


def refused(error: Exception, hint: str) -> CommandError:
    """Return the CommandError for an exception: REFUSED where the disk is the cause, else USAGE with `hint`."""
    said = str(error)
    if isinstance(error, OSError) and error.strerror:
        said = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    # what an error of another kind was made of counts too
    for each in (error, error.__cause__):
        if isinstance(each, OSError) and each.errno in REMEDIES:
            return CommandError(Exit.REFUSED, "not_written", said, REMEDIES[each.errno])
    return usage_error(said, hint)


class Outcome(msgspec.Struct, frozen=True):
    """What a command gave: its result (the stable keys of `--json`), the same as text, and the exit code."""

    result: dict[str, Any]
    text: str
    exit_code: Exit = Exit.DONE


def print_outcome(command: str, outcome: Outcome, as_json: bool) -> Exit:
    """Print the outcome as text or as one JSON object; return the exit code."""
    is_done = outcome.exit_code is Exit.DONE
    text = _object(command, is_done, outcome.result, None) if as_json else outcome.text
    is_written = write_answer(text, f"tormagctl {command}")
    return outcome.exit_code if is_written or not is_done else Exit.REFUSED


def print_error(command: str, error: ClientError, as_json: bool) -> None:
    """Print error and remedy to stderr, and with `as_json` an object to stdout as well."""
    colour = Colour(sys.stderr)
    said, hint = colour.red(printable(error.message)), printable(error.hint)
    write_line(f"{f'tormagctl {command}'.rstrip()}: {said}\n  next: {hint}", sys.stderr)
    if as_json:
        told = {"code": error.code, "message": error.message, "hint": error.hint}
        write_answer(_object(command, False, None, told), f"tormagctl {command}".rstrip())


def _object(command: str, ok: bool, result: dict[str, Any] | None, error: dict[str, str] | None) -> str:
    told = msgspec.to_builtins({"command": command, "ok": ok, "result": result, "error": error})
    return msgspec.json.encode(each_text(told, lambda name: name.encode(errors="backslashreplace").decode())).decode()


def folded(text: str) -> str:
    """Wrap `text` to the terminal's width, if stdout is one."""
    return "\n".join(wrapped(text, shutil.get_terminal_size().columns)) if is_terminal(sys.stdout) else text


def wrapped(text: str, width: int) -> list[str]:
    """Return lines of at most `width`, with a line's rest indented under its words."""
    width = max(width, NARROWEST)
    lines: list[str] = []
    for line in text.splitlines():
        label = LABEL.match(line)
        under = " " * min(0 if label is None else label.end(), width // 3)
        lines += textwrap.wrap(line, width, subsequent_indent=under) if len(line) > width else [line]
    return lines


def is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


class Colour:
    """ANSI colours for one stream; plain text if it is no terminal, TERM is dumb, or NO_COLOR is set."""

    def __init__(self, stream: TextIO | None) -> None:
        self._is_on = is_terminal(stream) and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"

    def _paint(self, code: str, text: str) -> str:
        return f"\x1b[{code}m{text}\x1b[0m" if self._is_on else text

    red = partialmethod(_paint, "31")
    green = partialmethod(_paint, "32")
    yellow = partialmethod(_paint, "33")
    bold = partialmethod(_paint, "1")


def answer_of(module: str, arguments: Iterable[str], longest_s: float) -> str:
    """Run `python -m MODULE`, and return what it prints to stdout."""
    command = [sys.executable, "-P", "-m", module, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=longest_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"not done after {longest_s:g} s") from error
    if done.returncode:
        raise ChildProcessError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    return done.stdout
