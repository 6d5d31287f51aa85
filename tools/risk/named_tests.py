"""Which tests name a code or a check: a scan of the test tree, which runs nothing.

A test names what is in its function, in its decorators, and in whatever else of its module these use.
"""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path

BEHAVIOUR = (
    *(f"{room}/**/test_*.py" for room in ("closed_loop", "control", "daemon", "end_to_end", "firmware_protocol")),
    *("hardware/test_*.py", "simulation/test_*.py", "tools/test_endurance.py", "tools/test_faults.py"),
)
"Folders whose tests drive something: elsewhere a code is an example."
ENUMERATIONS = {"Fault": "fault.", "Limit": "limit.", "DeviceFault": "fault.DEVICE_"}
Named = Mapping[str, Counter[str]]
"How many tests of each file name a member, a text or a capital word; and a test itself, as FILE::FUNCTION."


def named_tests(folder: Path) -> Named:
    named: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for path in sorted({path for place in BEHAVIOUR for path in folder.glob(place)}):
        file, said = path.relative_to(folder).as_posix(), _said_by_part(ast.parse(path.read_text(encoding="utf-8")))
        for test in (name for name in said if name.startswith(("test_", "Test"))):
            names: set[str] = set()
            added = {test}
            while added:
                now = names.union(*(said[part] for part in added), added)
                names, added = now, (now - names - added) & said.keys()
            for name in names | {f"{file}::{test}"}:
                named[name][file] += 1
    return named


def _said_by_part(module: ast.Module) -> dict[str, set[str]]:
    """Return what each part of a module names, by the names that the part defines."""
    said: defaultdict[str, set[str]] = defaultdict(set)
    for part in module.body:
        stored = (each.id for each in ast.walk(part) if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store))
        for name in (part.name,) if isinstance(part, ast.FunctionDef | ast.ClassDef) else stored:
            said[name] |= _said(part)
    return said


def _said(part: ast.stmt) -> set[str]:
    """Return the names, fixtures, members of ENUMERATIONS and texts of a part, and the texts' capital words."""
    docstrings = {each.value for each in ast.walk(part) if isinstance(each, ast.Expr)}
    said: set[str] = set()
    for each in ast.walk(part):
        match each:
            case ast.Name(name) | ast.arg(name):
                said.add(name)
            case ast.Attribute(ast.Name(owner), member) if owner in ENUMERATIONS:
                said.add(ENUMERATIONS[owner] + member)
            case ast.Constant(str(text)) if each not in docstrings:
                said.update({text, *re.findall(r"\b[A-Z][A-Z_]+\b", text)})
    return said
