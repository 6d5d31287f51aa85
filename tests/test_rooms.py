"""Imports go one way, between rooms and between files; a start of another process is an arrow of its own kind.

`pytest -s tests/test_rooms.py` prints rooms, floors and arrows.
"""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
BASE = {"client", "firmware_protocol", "ground"}
DECIDES = BASE | {"config", "element", "scenes", "hardware"}
MAY_IMPORT = {
    "client": set(),
    "firmware_protocol": set(),
    "ground": {"client", "firmware_protocol"},
    "config": BASE,
    "element": BASE,
    "scenes": BASE | {"config"},
    "hardware": BASE | {"config"},
    "control": DECIDES,
    "record": DECIDES | {"control"},
    "commission": DECIDES | {"control"},
    "daemon": DECIDES | {"control", "record"},
    "simulation": DECIDES | {"control", "record"},
    "view": BASE | {"control", "record", "commission"},
    "ctl": DECIDES | {"control", "record", "commission", "view"},
    "headroom": DECIDES | {"control", "daemon", "simulation"},
}
MAY_IMPORT["lab"] = set(MAY_IMPORT) - {"headroom"}
"""Nothing imports the laboratory."""
MAY_START = {
    "ctl": {"headroom", "simulation", "daemon"},
    "daemon": {"record"},
    "view": {"firmware_protocol"},
}
"""`python -m` of another room: rehearsal, headroom, a scene's check; the keeper; a command that is told."""
PACKAGES = {
    "tormagd_client": ROOT / "client/src/tormagd_client",
    "firmware_protocol": ROOT / "firmware_protocol",
    "tormagd": ROOT / "tormagd",
    "tormag_lab": ROOT / "lab/src/tormag_lab",
}
OURS = rf"(?:{'|'.join(PACKAGES)})(?:\.\w+)*"
TOOLS, RIGS = ROOT / "tools", ROOT / "tests" / "rigs"
TOOL_ROOMS = {"judge": set(), "demo": {"judge"}, "benchmarks": {"judge"}}
"""Of the tools; no room imports the scripts beside them, and no rig of the tests imports a tool."""


class Arrow(NamedTuple):
    """What a source has to do with the module or attribute `name`."""

    kind: str
    name: str


def sources() -> Iterator[tuple[str, Path]]:
    """Yield every module of the three distributions, and its file."""
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            yield ".".join((package, *parts)).removesuffix(".__init__"), path


RUN = {name.removesuffix(".__main__") for name, path in sources() if path.name != "__init__.py"}
"""What `python -m` takes."""
PROGRAMS = {"tormag-lab": "tormag_lab"}


def room(name: str) -> str:
    """Return the room of a module; what stands beside the rooms of `tormagd` is ground."""
    package, _, rest = name.partition(".")
    inside = rest.partition(".")[0]
    alone = {"tormagd_client": "client", "tormag_lab": "lab", "firmware_protocol": "firmware_protocol"}
    return alone.get(package) or (inside if inside in MAY_IMPORT else "ground")


def arrows(text: str) -> Iterator[Arrow]:
    """Yield what a source imports, wherever in it, and which modules it starts as processes."""
    nodes = list(ast.walk(ast.parse(text)))
    said = {id(each.value) for each in nodes if isinstance(each, ast.Expr)}
    begun = {id(part) for each in nodes if isinstance(each, ast.JoinedStr) for part in each.values}
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (Arrow("imports", alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "a relative import hides where it goes"
            yield from (Arrow("imports", f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            if id(node) in begun and (found := re.fullmatch(rf"({OURS})\.", node.value)):
                yield Arrow("imports", found[1])
            named = PROGRAMS.get(node.value, node.value)
            started = [named] if named in RUN else re.findall(rf"-m ({OURS})", named)
            yield from (Arrow("starts", name) for name in started)


def imported(path: Path) -> set[str]:
    """Return the first names of what a file takes from elsewhere."""
    return {each.name.split(".")[0] for each in arrows(path.read_text(encoding="utf-8"))}


def wrong(here: str, text: str) -> set[tuple[str, str]]:
    """Return what a source in this room may not do, each with the room it would reach."""
    allowed = {"imports": MAY_IMPORT[here] | {here}, "starts": MAY_START.get(here, set()) | {here}}
    return {
        (each.kind, room(each.name))
        for each in arrows(text)
        if each.name.partition(".")[0] in PACKAGES and room(each.name) not in allowed[each.kind]
    }


def test_a_room_imports_and_starts_only_what_it_may():
    found = {name: wrong(room(name), path.read_text(encoding="utf-8")) for name, path in sources()}
    assert {name: each for name, each in found.items() if each} == {}


@pytest.mark.parametrize(
    ("here", "planted", "reached"),
    [
        ("firmware_protocol", "import tormagd_client", ("imports", "client")),
        ("firmware_protocol", "def late():\n    from tormagd_client.messages import Status", ("imports", "client")),
        ("client", "from tormagd import __version__", ("imports", "ground")),
        ("ctl", 'def late():\n    import_module(f"tormag_lab.{name}")', ("imports", "lab")),
        ("ctl", 'subprocess.run([sys.executable, "-m", "tormag_lab", "bound"])', ("starts", "lab")),
        ("ctl", 'answer_of("tormag_lab.main", words, 1.0)', ("starts", "lab")),
        ("ctl", 'os.system("python3 -P -m tormag_lab.main bound")', ("starts", "lab")),
        ("daemon", 'subprocess.run(["tormag-lab", "twin"])', ("starts", "lab")),
        ("daemon", 'ChildProcess("tormagd.simulation")', ("starts", "simulation")),
    ],
)
def test_a_planted_arrow_is_seen(here, planted, reached):
    assert wrong(here, planted) == {reached}


def test_no_arrow_comes_back():
    rooms: dict[str, set[str]] = {name: set() for name in MAY_IMPORT}
    files: dict[str, set[str]] = {}
    kinds: dict[str, set[tuple[str, str]]] = {"imports": set(), "starts": set()}
    known = {name: path for name, path in sources() if path.name != "__init__.py"}
    for name, path in known.items():
        ours = [each for each in arrows(path.read_text(encoding="utf-8")) if each.name.partition(".")[0] in PACKAGES]
        there = {each.name if each.name in known else each.name.rpartition(".")[0] for each in ours}
        files[name] = (there & set(known)) - {name}
        for each in ours:
            if (other := room(each.name)) != room(name):
                rooms[room(name)].add(other)
                kinds[each.kind].add((room(name), other))
    list(TopologicalSorter(files).static_order())
    floor: dict[str, int] = {}
    for name in TopologicalSorter(rooms).static_order():
        floor[name] = 1 + max((floor[there] for here, there in kinds["imports"] if here == name), default=0)
    for level in range(1, max(floor.values()) + 1):
        print(f"floor {level}: {', '.join(sorted(name for name in floor if floor[name] == level))}")
    print(f"{len(rooms)} rooms, {max(floor.values())} floors, {len(kinds['imports'])} arrows")
    print("starts:", ", ".join(f"{here} -> {there}" for here, there in sorted(kinds["starts"])))


def test_what_draws_takes_matplotlib_from_one_place():
    for path in (*(path for _, path in sources()), *TOOLS.rglob("*.py")):
        assert path.name == "drawing.py" or not re.search(r"^ *(from|import) matplotlib", path.read_text("utf-8"), re.M)


def test_a_room_of_the_tools_imports_no_script_and_only_what_stands_left_of_it():
    ours = {path.stem for path in TOOLS.iterdir()}
    allowed = {TOOLS / here: rooms | {here} for here, rooms in TOOL_ROOMS.items()} | {RIGS: set()}
    for folder, rooms in allowed.items():
        for path in folder.rglob("*.py"):
            assert imported(path) & ours <= rooms, path


def test_tests_outside_their_own_room_take_nothing_from_the_tools():
    for path in (path for path in (ROOT / "tests").rglob("*.py") if "tools" not in path.relative_to(ROOT).parts):
        assert not imported(path) & TOOL_ROOMS.keys(), path


def test_the_table_names_every_room_of_the_tools():
    table = re.findall(r"^\| `tools/(\w+)/` \|", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(table) == sorted(TOOL_ROOMS) == sorted(path.parent.name for path in TOOLS.glob("*/__init__.py"))
