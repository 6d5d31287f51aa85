"""The risk page in HTML: a table for each hazardous situation, red where something is missing."""

import re
from collections.abc import Iterable, Sequence
from html import escape

from firmware_protocol.conformance.check import Hazard
from risk.rows import Judged, Row
from tormagd.control.safety.hazards import HARMLESS, HARMS

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
<p>Which hazardous situation may come of what, and what is done about it, in the terms of ISO 14971. It is written for
a person who analyses the risk of a device. <strong>It certifies nothing</strong>: all evidence is of simulated
devices.</p>
<p>Written by <code>python tools/safety_pages.py</code> from the tables of <code>tormagd/control/safety</code>, the
conformance kit, the test tree and the <a href="fault-matrix.html">fault matrix</a>. A row is red where a control, a
code, a test or evidence is missing. Severity and probability are a person's, of <code>docs/risk.toml</code>.</p>
"""


def page(rows: Sequence[Row]) -> str:
    """Return the page, which needs no other file."""
    harmless = ", ".join(HARMLESS.split())
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
