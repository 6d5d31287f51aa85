"""`tormagctl completion`: what a shell needs to complete commands, options, names and files."""

from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterable, Iterator
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
    named = {name: (dest, _names(name, each)) for name, (dest, each) in words.items()}
    for command, each in (("", parser), *subparsers(parser)):
        dest, known = named.get(command.partition(" ")[0], ("", None))
        for action in each._actions:
            if action.dest == dest:
                action.complete = known  # type: ignore[attr-defined]  # shtab looks for it here
            elif action.type is Path or action.metavar == "FILE":
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    return str(shtab.complete(parser, shell=shell))


def subparsers(parser: ArgumentParser) -> Iterator[tuple[str, ArgumentParser]]:
    """Yield each command with its name, and those of a group behind it."""
    for action in parser._actions:
        if isinstance(action, _SubParsersAction):
            for name, command in action.choices.items():
                yield name, command
                yield from ((f"{name} {inner}", each) for inner, each in subparsers(command))


def _names(command: str, words: Iterable[str]) -> object:
    """Return functions of each shell that complete these words, or a file."""
    name, known = f"_tormagctl_{command}", " ".join(words)
    bash = f'{name}() {{ compgen -W "{known}" -- "$1"; compgen -f -- "$1"; }}'
    return {"bash": name, "zsh": name, "preamble": {"bash": bash, "zsh": f"{name}() {{ compadd -- {known}; _files; }}"}}
