"""What a message tells a user to type is there: in a wheel, where there is no checkout and no make."""

import ast
import importlib
import importlib.util
import re
from pathlib import Path

import pytest

from tormagd.ctl.commands import COMMANDS

ROOT = Path(__file__).parents[2]
SOURCES = sorted(file for room in ("tormagd", "firmware_protocol", "client") for file in (ROOT / room).rglob("*.py"))
NAMED = re.compile(r"\b(tormagctl(?: --?[\w-]+)*|tormag-lab|python -m|python|make) ([a-z][\w./-]*)|\b(tools/\w+\.py)")
TARGETS = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
PROSE = ("of", "are")
"What may follow `tormagctl` where a sentence speaks of the program."
LAB = importlib.import_module("tormagd.lab.main") if importlib.util.find_spec("tormagd.lab") else None


def messages(source):
    """The strings of a module that are not documentation."""
    tree = ast.parse(source.read_text(encoding="utf-8"))
    told = {id(each.value) for each in ast.walk(tree) if isinstance(each, ast.Expr)}
    for each in ast.walk(tree):
        if isinstance(each, ast.Constant) and isinstance(each.value, str) and id(each) not in told:
            yield each.value


def is_there(program, word, tool):
    """Whether an installed wheel has it; words after `make` and `python` that are no targets and no files are prose."""
    if tool or program == "python":
        return LAB is None or not (tool or word.endswith(".py"))
    if program == "make":
        return word not in TARGETS
    if program == "python -m":
        return importlib.util.find_spec(word.rstrip(".")) is not None
    if program == "tormag-lab":
        return LAB is None or word in LAB.COMMANDS
    return word in COMMANDS or word in PROSE


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: str(source.relative_to(ROOT)))
def test_every_command_that_a_message_names_is_in_a_wheel(source):
    missing = [found[0] for text in messages(source) for found in NAMED.finditer(text) if not is_there(*found.groups())]
    assert missing == []
