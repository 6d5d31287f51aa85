"""`tormagctl completion`: what a shell needs to complete commands, options and files."""

from argparse import Action, ArgumentParser
from pathlib import Path

import shtab


def completion(parser: ArgumentParser, shell: str) -> str:
    """The script that completes `parser`'s program in `shell`, `bash` or `zsh`: what is a path, by the files there."""
    _complete_paths(parser)
    script: str = shtab.complete(parser, shell=shell)
    return script


def _complete_paths(parser: ArgumentParser) -> None:
    for action in parser._actions:
        if action.type is Path or action.metavar == "FILE":
            action.complete = shtab.FILE  # type: ignore[attr-defined]  # shtab looks for it here
        for inner in _commands(action):
            _complete_paths(inner)


def _commands(action: Action) -> list[ArgumentParser]:
    return list(action.choices.values()) if isinstance(action.choices, dict) else []
