"""The documentation is true: generated pages are up to date, and what is shown can be typed."""

import ast
import importlib
import importlib.util
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image
from reference_pages import commands_page, configuration_page, keys, tables, ticks_page

from firmware_protocol.conformance import __main__ as conformance
from tormag_lab.pages import KEY, figures_of, stamp
from tormagd.config import Config, checked
from tormagd.ctl import main as ctl
from tormagd.ctl.commands import FIRST_WORDS
from tormagd.ctl.completion import subparsers
from tormagd.ctl.scene import measured_as
from tormagd.daemon import main as daemon
from tormagd.ground.command_line import UsageError
from tormagd.ground.toml_file import toml_tables
from tormagd.record.stream import COLUMNS
from tormagd.scenes.scene import load_scene, shipped_scenes
from tormagd.simulation import __main__ as simulation

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "RELEASING.md"]
PAGES += sorted(page for folder in ("docs", "systemd", "firmware_protocol") for page in (ROOT / folder).rglob("*.md"))
PARSERS = {
    "tormagd": daemon.parser,
    "tormagctl": ctl.parser,
    "python -m tormagd.simulation": simulation.parser,
    "python -m firmware_protocol.conformance": conformance.parser,
}
TARGETS = {*re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)}
COMMAND = re.compile(
    r"(?:sudo (?:-u \w+ )?)?((?:tormagctl|tormagd|tormag-lab|make|python (?:-m |tools/)[\w./]+)(?: [ -~]*)?)"
)
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^(?: {4}| {8})(\S.*)$", re.MULTILINE)
IMPORTED = re.compile(r"^from (\w+)(?:\.| import )(\w+)", re.MULTILINE)
LAB = importlib.import_module("tormag_lab.main") if importlib.util.find_spec("tormag_lab") else None
DECISION = ["Question", "Decision", "Why", "Given up"]


def name_of(page):
    return str(page.relative_to(ROOT))


def blocks(text):
    for _, language, body in FENCE.findall(text):
        if language in ("", "sh", "bash"):
            yield from body.splitlines()
    yield from INDENTED.findall(FENCE.sub("", text))


def spans(text):
    return re.findall(r"`([^`\n]+)`", FENCE.sub("", text))


def commands(lines):
    for line in lines:
        for part in re.split(r" && | \| |; ", line.split(" #")[0].split(" < ")[0].strip().removesuffix(" &")):
            found = COMMAND.fullmatch(part)
            if found and "..." not in part:
                yield shlex.split(found[1])


def require_there(words):
    if words[0] == "make":
        assert {word for word in words[1:] if "=" not in word} <= TARGETS, words
    elif words[0] == "tormag-lab":
        assert LAB is None or len(words) == 1 or words[1] in ("NAME", *LAB.COMMANDS), words
    elif words[1] == "-m":
        assert importlib.util.find_spec(words[2]), words
    else:
        tool = ROOT / words[1]
        source = tool.read_text(encoding="utf-8")
        parts = [*tool.parent.glob(f"*/{words[2].replace('-', '_')}.py")] if words[2:] else []
        # several tools share options in a module that they import
        parts += [tool.parent / room / f"{name}.py" for room, name in IMPORTED.findall(source)]
        source += "".join(file.read_text(encoding="utf-8") for file in parts if file.exists())
        assert all(f'"{word}"' in source for word in words[2:] if word.startswith("--")), words


def parsed(lines):
    """Return each command that has a parser here; the others must exist."""
    for words in commands(lines):
        for begin, make in PARSERS.items():
            size = len(begin.split())
            if words[:size] == begin.split():
                yield words, make(), words[size:]
                break
        else:
            require_there(words)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_in_a_block_is_understood(page, capsys):
    for words, parser, arguments in parsed(blocks(page.read_text(encoding="utf-8"))):
        try:
            parser.parse_args(arguments)
        except (SystemExit, UsageError) as error:
            pytest.fail(f"{' '.join(words)}: {error} {capsys.readouterr().err}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_in_a_line_has_the_options_that_are_named(page):
    for words, parser, arguments in parsed(spans(page.read_text(encoding="utf-8"))):
        named = {word for word in arguments if word.startswith("--")}
        assert named <= set().union(*(it._option_string_actions for _, it in (("", parser), *subparsers(parser)))), (
            words
        )
        if words[0] == "tormagctl" and arguments and not arguments[0].startswith("--"):
            assert arguments[0] in dict(subparsers(parser)), words


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs/guides").glob("*.md"))], ids=name_of)
def test_every_table_of_a_configuration_that_is_shown_is_taken(page):
    for _, language, body in FENCE.findall(page.read_text(encoding="utf-8")):
        if language == "toml":
            checked(toml_tables(body), Config)


def test_the_pages_of_reference_are_those_of_the_types():
    assert (ROOT / "docs/reference/configuration.md").read_text(encoding="utf-8") == configuration_page()
    assert (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8") == commands_page()
    assert (ROOT / "docs/reference/ticks.md").read_text(encoding="utf-8") == ticks_page()
    told = (ROOT / "docs/messages.md").read_text(encoding="utf-8").partition("## Control ticks\n")[2]
    assert set(re.findall(r"^- `(\w+)`:", told, re.MULTILINE)) - {*COLUMNS} == set()


def test_every_key_of_the_configuration_says_what_it_is_for():
    silent = [f"{table} {name}" for table, kind in tables(Config, "") for name, _, _, why in keys(kind) if not why]
    assert silent == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs/decisions").glob("0*.md")), ids=name_of)
def test_every_decision_has_the_same_four_parts(page):
    assert re.findall(r"^## (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE) == DECISION


SOURCES = sorted(
    file for room in ("tormagd", "firmware_protocol", "client/src") for file in (ROOT / room).rglob("*.py")
)
NAMED = re.compile(r"\b(tormagctl(?: --?[\w-]+)*|tormag-lab|python -m|python|make) ([a-z][\w./-]*)|\b(tools/\w+\.py)")
PROSE = ("of", "are")
"What may follow `tormagctl` in a sentence about the program."


def messages(source):
    tree = ast.parse(source.read_text(encoding="utf-8"))
    told = {id(each.value) for each in ast.walk(tree) if isinstance(each, ast.Expr)}
    for each in ast.walk(tree):
        if isinstance(each, ast.Constant) and isinstance(each.value, str) and id(each) not in told:
            yield each.value


def is_there(program, word, tool):
    """Whether an installed wheel has it."""
    if tool or program == "python":
        return LAB is None or not (tool or word.endswith(".py"))
    if program == "make":
        return word not in TARGETS
    if program == "python -m":
        return importlib.util.find_spec(word.rstrip(".")) is not None
    if program == "tormag-lab":
        return LAB is None or word in LAB.COMMANDS
    return word in FIRST_WORDS or word in PROSE


def test_every_command_that_a_message_names_is_in_a_wheel():
    missing = [
        (name_of(source), found[0])
        for source in SOURCES
        for text in messages(source)
        for found in NAMED.finditer(text)
        if not is_there(*found.groups())
    ]
    assert missing == []


def test_no_message_sends_an_operator_to_a_file_of_the_checkout():
    file = re.compile(r"\b(?:docs|systemd|examples)/[\w./-]+\.(?:md|rules|toml)\b|\bsystemd/udev\b")
    assert [(name_of(source), text) for source in SOURCES for text in messages(source) if file.search(text)] == []


DOCS = ROOT / "docs"
GENERATED = ("learned_inverse.md", "reproduction.md")
SHOWN = re.compile(r"\]\(([\w/]+\.png)\)")


def drawn():
    yield "images/scenes.png", [measured_as(name, load_scene(name)) for name in shipped_scenes()]
    summary = (ROOT / "README.md").read_text(encoding="utf-8").partition("\nforce asked")[2].partition("```")[0]
    yield "images/pulse.png", [line for line in summary.splitlines() if line.startswith("  ")]
    for name in GENERATED:
        page = (DOCS / name).read_text(encoding="utf-8")
        for picture in SHOWN.findall(page):
            yield picture, figures_of(page)


@pytest.mark.parametrize(("picture", "figures"), [pytest.param(*each, id=each[0]) for each in drawn()])
def test_a_picture_is_no_older_than_its_figures(picture, figures):
    with Image.open(DOCS / picture) as opened:
        assert opened.info[KEY] == stamp(figures)[KEY], "what writes the figures draws it anew"


def test_other_figures_have_another_stamp_and_other_words_the_same():
    page = "# A\n\n| mN |\n| --- |\n| 3 |\n"
    first, longer, other = (stamp(figures_of(each)) for each in (page, page + "\nWords.\n", page.replace("3", "4")))
    assert first == longer != other
