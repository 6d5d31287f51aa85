"""Imports go one way: each room may import only what is listed here (and itself)."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NO_ROOM = {"firmware_protocol.value", "firmware_protocol.build"}
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
TOOLS = ROOT / "tools"
TOOL_ROOMS = {
    "machines": set(),
    "extremes": set(),
    "rendering": {"machines"},
    "fault_matrix": set(),
    "risk": {"fault_matrix"},
    "endurance": {"machines"},
    "benchmarks": {"machines", "rendering"},
}
"""Of the tools; no room imports the scripts beside them."""


def sources() -> Iterator[Path]:
    for package in ("tormagd", "firmware_protocol"):
        yield from sorted((ROOT / package).rglob("*.py"))


def room(parts: tuple[str, ...]) -> str | None:
    if parts[0] == "firmware_protocol":
        return "firmware_protocol"
    return parts[1] if parts[0] == "tormagd" and len(parts) > 1 and parts[1] in MAY_IMPORT else None


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module not in NO_ROOM:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_a_room_imports_only_what_stands_left_of_it():
    for path in sources():
        here = room(path.relative_to(ROOT).with_suffix("").parts)
        if here is None:
            assert path.name == "__init__.py", f"{path} stands in no room"
            continue
        rooms = {room(tuple(name.split("."))) for name in imported(path)} - {None}
        assert rooms <= MAY_IMPORT[here] | {here}, path


def test_what_draws_takes_matplotlib_from_one_place():
    for path in (*sources(), *TOOLS.rglob("*.py")):
        assert path.name == "drawing.py" or not re.search(r"^ *(from|import) matplotlib", path.read_text("utf-8"), re.M)


@pytest.mark.parametrize("here", TOOL_ROOMS)
def test_a_room_of_the_tools_imports_no_script_and_only_what_stands_left_of_it(here):
    ours = {path.stem for path in TOOLS.iterdir()}
    for path in (TOOLS / here).glob("*.py"):
        assert {name.split(".")[0] for name in imported(path)} & ours <= TOOL_ROOMS[here] | {here}, path


def test_the_table_names_every_room_of_the_tools():
    table = re.findall(r"^\| `tools/(\w+)/` \|", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(table) == sorted(TOOL_ROOMS) == sorted(path.parent.name for path in TOOLS.glob("*/__init__.py"))
