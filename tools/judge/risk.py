"""The risk page: a row for each fault, limit, cause without a code, and check of the conformance kit.

Which files of tests name a code or a check comes from a scan of the test tree, which runs nothing.
"""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec

from firmware_protocol.conformance.check import Hazard
from firmware_protocol.conformance.examination import CHECKS
from judge.injections import MATRIX
from tormagd.control.safety.codes import FAULTS, LIMITS, Explanation, Fault, Limit
from tormagd.control.safety.hazards import CAUSES, HARMS
from tormagd.ground.toml_file import convert

BEHAVIOUR = (
    *(f"{room}/**/test_*.py" for room in ("closed_loop", "control", "daemon", "end_to_end", "firmware_protocol")),
    *("hardware/test_*.py", "simulation/test_*.py", "tools/test_endurance.py", "tools/test_faults.py"),
)
"Folders whose tests drive something: elsewhere a code is an example."
ENUMERATIONS = {"Fault": "fault.", "Limit": "limit.", "DeviceFault": "fault.DEVICE_"}
Named = Mapping[str, set[str]]
"The files that name a member, a text or a capital word, or have a test, as FILE::FUNCTION."


def named_tests(folder: Path) -> Named:
    named: defaultdict[str, set[str]] = defaultdict(set)
    for path in sorted({path for place in BEHAVIOUR for path in folder.glob(place)}):
        file = path.relative_to(folder).as_posix()
        for name in _said(ast.parse(path.read_text(encoding="utf-8")), file):
            named[name].add(file)
    return named


def _said(module: ast.Module, file: str) -> set[str]:
    """Return members of ENUMERATIONS, texts, capital words in them, and tests, as FILE::FUNCTION, of a module."""
    docstrings = {each.value for each in ast.walk(module) if isinstance(each, ast.Expr)}
    said: set[str] = set()
    for each in ast.walk(module):
        match each:
            case ast.FunctionDef(name):
                said.add(f"{file}::{name}")
            case ast.Attribute(ast.Name(owner), member) if owner in ENUMERATIONS:
                said.add(ENUMERATIONS[owner] + member)
            case ast.Constant(str(text)) if each not in docstrings:
                said.update({text, *re.findall(r"\b[A-Z][A-Z_]+\b", text)})
    return said


VERDICTS = ("named", "safe", "in_time", "recovered")
KIT = "firmware_protocol/test_conformance.py"
WORDED = "tools/test_faults.py"
"Tests that call codes by words, as the matrix does."
Text = Annotated[str, msgspec.Meta(max_length=60)]


class Judged(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A person's judgement of a row, by a scale of their own; empty: nothing yet."""

    severity: Text = ""
    probability: Text = ""


class Row(NamedTuple):
    """One row. What is empty of hazard, control, code, tests and evidence is missing."""

    name: str
    hazard: Hazard | None
    cause: str
    control: str
    code: str
    tests: str
    evidence: str
    judged: Judged = Judged()

    @property
    def missing(self) -> tuple[str, ...]:
        return tuple(name for name in ("hazard", "control", "code", "tests", "evidence") if not getattr(self, name))


def rows(named: Named, cells: Sequence[Mapping[str, Any]], judged: Mapping[str, Judged]) -> list[Row]:
    told = _told(cells)
    made = [*_of_codes("fault", Fault, FAULTS, named, told), *_of_codes("limit", Limit, LIMITS, named, told)]
    made += [*_of_causes(named, told), *_of_kit(named)]
    if unknown := judged.keys() - {row.name for row in made}:
        raise ValueError(f"{min(unknown)}: no row of the risk page has this name; take it out, or rename it")
    return [row._replace(judged=judged.get(row.name, row.judged)) for row in made]


def judgement(path: Path) -> dict[str, Judged]:
    tables = convert(path, dict[str, dict[str, Judged]])
    return {f"{kind}.{name}": judged for kind, table in tables.items() for name, judged in table.items()}


def _told(cells: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """Return how many held cells show each present row of the matrix, and each code that they were to show."""
    told: Counter[str] = Counter()
    known = {injection.name for injection in MATRIX}
    for cell in cells:
        if cell["fault"] in known and all(cell[verdict] for verdict in VERDICTS):
            wanted = {name.replace("device:", "DEVICE_") for name in cell["must_be_named"]}
            faults = {*cell["host_faults"], *(f"DEVICE_{name}" for name in cell["device_faults"])}
            told.update(f"fault.{name}" for name in faults & wanted)
            told.update(f"limit.{name}" for name in wanted.intersection(cell["limits"]))
            told[cell["fault"]] += 1
    return told


def _of_codes(
    kind: str, codes: Iterable[str], table: Mapping[Any, Explanation], named: Named, told: Counter[str]
) -> Iterator[Row]:
    for code in (code for code in codes if code not in _harmless(table)):
        name, row = f"{kind}.{code}", table.get(code)
        files = set(named.get(name, ()))
        if code not in FAULTS or code not in LIMITS:  # otherwise a word may mean either
            files |= {WORDED} & named.get(code, set())
        tests, evidence = ", ".join(sorted(files)), _in_cells(told[name])
        if row is None:
            yield Row(name, None, "", "", "", tests, evidence)
        else:
            hazard = Hazard[row.hazard] if row.hazard else None
            shows = "" if row.shows == "at once" else f", {row.shows}"
            control = f"{row.reaction} within {row.safe_ms:,.0f} ms{shows}"
            yield Row(name, hazard, row.cause, control, code, tests, evidence)


def _harmless(table: Mapping[Any, Explanation]) -> list[str]:
    return [code for code, row in table.items() if row.hazard == "NONE"]


def _of_causes(named: Named, told: Counter[str]) -> Iterator[Row]:
    for each in CAUSES:
        tests = ", ".join(sorted(named.get(each.test or "no test", ())))
        yield Row(f"cause.{each.name}", each.hazard, each.cause, each.control, "-", tests, _in_cells(told[each.cell]))


def _of_kit(named: Named) -> Iterator[Row]:
    """Yield the rows of the kit's checks; their tests plant the error that they must find, which is the evidence."""
    for check in CHECKS:
        tests = KIT if KIT in named.get(check.name, ()) else ""
        evidence = "planted error found" if tests else ""
        yield Row(
            f"kit.{check.name}",
            check.hazard,
            f"rule not kept: {check.page}",
            check.expected,
            check.name,
            tests,
            evidence,
        )


def _in_cells(count: int) -> str:
    return "" if count == 0 else "1 cell" if count == 1 else f"{count} cells"


COLUMNS = ("cause", "control", "code", "tests", "evidence")
_HEAD = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Risk</title>
<style>
:root { color-scheme: light dark; font: 15px/1.4 system-ui, sans-serif; }
body { margin: 2rem auto; max-width: 90rem; padding: 0 1rem; }
table { border-collapse: collapse; width: 100%; margin-bottom: 2rem; }
th, td { border: 1px solid #8888; padding: .3rem .5rem; text-align: left; vertical-align: top; }
td:first-child { min-width: 15rem; }
td:nth-child(3) { white-space: nowrap; font-family: monospace; }
tr.red td { background: #d3222240; }
tr.red td.gap { background: #d32222; color: #fff; font-weight: bold; }
</style>
</head>
<body>
<p><a href="safety.html">Safety</a></p>
<h1>Risk</h1>
<p>Which hazardous situation may arise from what, and what is done about it, in the terms of ISO 14971. It is written
for a person who analyses the risk of a device. <strong>It certifies nothing</strong>: all evidence is of simulated
devices.</p>
<p>Written by <code>python tools/safety_pages.py</code> from the tables of <code>tormagd/control/safety</code>, the
conformance kit, the test tree and the <a href="fault-matrix.html">fault matrix</a>. A row is red where a control, a
code, a test or evidence is missing. Severity and probability are a person's, from <code>docs/risk.toml</code>.</p>
"""


def page(rows: Sequence[Row]) -> str:
    """Return the page, which needs no other file."""
    harmless = ", ".join(_harmless(LIMITS))
    says = f"<p>{len(rows)} rows, {len(red_rows(rows))} of them red. Limits without a hazard: {harmless}.</p>\n"
    return _HEAD + says + "".join(_of_hazard(hazard, rows) for hazard in (*Hazard, None)) + "</body>\n</html>\n"


def red_rows(rows: Iterable[Row]) -> dict[str, tuple[str, ...]]:
    return {row.name: row.missing for row in rows if row.missing}


def _of_hazard(hazard: Hazard | None, rows: Sequence[Row]) -> str:
    lines = "".join(_line(row) for row in rows if row.hazard is hazard)
    if not lines:
        return ""
    title = f"{hazard.name}: {hazard.value}" if hazard else "No hazard stated"
    harm = f"<p>Harm: {escape(HARMS[hazard])}.</p>\n" if hazard else ""
    head = "".join(f"<th>{name}</th>" for name in (*COLUMNS, *Judged.__struct_fields__))
    return f"<h2>{escape(title)}</h2>\n{harm}<table>\n<tr>{head}</tr>\n{lines}</table>\n"


def _line(row: Row) -> str:
    cells = [(name, getattr(row, name)) for name in COLUMNS]
    cells += [("", row.judged.severity), ("", row.judged.probability)]
    told = "".join(
        f'<td class="gap">no {name}</td>' if name in row.missing else f"<td>{_shown(text)}</td>" for name, text in cells
    )
    return f'<tr id="{row.name}"{" class=red" * bool(row.missing)}>{told}</tr>\n'


def _shown(text: str) -> str:
    return re.sub("`(.+?)`", r"<code>\1</code>", escape(text))
