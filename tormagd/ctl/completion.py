"""`tormagctl completion`: what a shell needs to complete commands, options and files."""

from argparse import ArgumentParser
from pathlib import Path

import shtab

from tormagd.ctl.outcome import Outcome


def completion(parser: ArgumentParser, shell: str) -> Outcome:
    text = script(parser, shell)
    return Outcome({"shell": shell, "script": text}, text)


def script(parser: ArgumentParser, shell: str) -> str:
    """Return the script by which `shell`, bash or zsh, completes a program."""
    _complete_paths(parser)
    return str(shtab.complete(parser, shell=shell))


def _complete_paths(parser: ArgumentParser) -> None:
    """Mark arguments that are files, so that shtab completes their paths."""
    for action in parser._actions:
        if action.type is Path or action.metavar == "FILE":
            action.complete = shtab.FILE  # type: ignore[attr-defined]  # shtab looks for it here
        for inner in action.choices.values() if isinstance(action.choices, dict) else ():
            _complete_paths(inner)
