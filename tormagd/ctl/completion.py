"""`tormagctl completion`: what a shell needs to complete commands, options, names and files."""

from argparse import ArgumentParser
from collections.abc import Iterable
from pathlib import Path

import shtab

from tormagd.ctl.guide import guide
from tormagd.ctl.outcome import Outcome
from tormagd.ctl.waveform import SHAPES
from tormagd.scenes.scene import shipped_scenes


def completion(parser: ArgumentParser, shell: str) -> Outcome:
    text = script(parser, shell)
    return Outcome({"shell": shell, "script": text}, text)


def script(parser: ArgumentParser, shell: str) -> str:
    """Return the script by which `shell`, bash or zsh, completes a program."""
    words = {
        "send": ("what", SHAPES),
        "scene": ("name", shipped_scenes()),
        "guide": ("name", guide(None).result["guides"]),
    }
    _complete(parser, {name: (dest, _names(name, each)) for name, (dest, each) in words.items()})
    return str(shtab.complete(parser, shell=shell))


def _complete(parser: ArgumentParser, names: dict[str, tuple[str, object]]) -> None:
    """Mark arguments that are files, or names of a command, so that shtab completes them."""
    dest, words = names.get(parser.prog.rpartition(" ")[2], ("", None))
    for action in parser._actions:
        if action.dest == dest:
            action.complete = words  # type: ignore[attr-defined]  # shtab looks for it here
        elif action.type is Path or action.metavar == "FILE":
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        for inner in action.choices.values() if isinstance(action.choices, dict) else ():
            _complete(inner, names)


def _names(command: str, words: Iterable[str]) -> object:
    """Return functions of each shell that complete these words, or a file."""
    name, known = f"_tormagctl_{command}", " ".join(words)
    bash = f'{name}() {{ compgen -W "{known}" -- "$1"; compgen -f -- "$1"; }}'
    return {"bash": name, "zsh": name, "preamble": {"bash": bash, "zsh": f"{name}() {{ compadd -- {known}; _files; }}"}}
