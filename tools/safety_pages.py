"""Writes docs/states.md, docs/fault-matrix.md and docs/risk.html.

They come from the tables of `tormagd/control/safety`, docs/evidence/faults.json, the conformance kit and the test
tree. Run `python tools/safety_pages.py` after a change; tests compare. It names the risk page's red rows.
"""

import json
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from judge.risk import Row, judgement, named_tests, page, red_rows, rows

from tormag_lab.pages import table
from tormagd.control.safety.codes import FAULTS, LIMITS, Explanation, Fault, Limit
from tormagd.control.safety.operating_state import ROWS, Event, OperatingState, Transition
from tormagd.hardware.measurement import DeviceRequest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
STATES, MATRIX, RISK = DOCS / "states.md", DOCS / "fault-matrix.md", DOCS / "risk.html"
EVIDENCE = DOCS / "evidence" / "faults.json"

HELD = {"named": "named", "safe": "ended safe", "in_time": "reacted in their stated time", "recovered": "recovered"}
"What a cell is called that is what it should be."

_STATES_HEAD = """# Operating states, faults and limits

`python tools/safety_pages.py` writes this page from the daemon's own tables. See also [safety](safety.md) and the
[fault matrix](fault-matrix.md).

"""
_MATRIX_HEAD = """# Fault matrix

The effect of each fault, in virtual time on simulated devices. Written by `python tools/safety_pages.py` from
[evidence/faults.json](evidence/faults.json), a run of `tools/judge.py faults --json`.

Faults are injected while 1.8 ± 0.1 N are rendered at a turning handle, those of homing and of the start from the
beginning. A row is for both buses if they agree. *Safe after* is when the gap was open or at rest, or the limit was
told. The headings have the commands that the daemon names once the cause has gone. After them the force is followed
again.

"""


def main() -> int:
    record = json.loads(EVIDENCE.read_text(encoding="utf-8"))
    try:
        risks = risk_rows(record)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    STATES.write_text(states_page(), encoding="utf-8")
    MATRIX.write_text(matrix_page(record), encoding="utf-8")
    RISK.write_text(page(risks), encoding="utf-8")
    for name, missing in red_rows(risks).items():
        print(f"red: {name}: no {', no '.join(missing)}")
    return 0


def risk_rows(record: dict[str, Any]) -> list[Row]:
    return rows(named_tests(ROOT / "tests"), record["figures"]["cells"], judgement(DOCS / "risk.toml"))


def states_page() -> str:
    return "".join((_STATES_HEAD, _transitions(), _guards(), _faults(), _limits())).rstrip() + "\n"


def matrix_page(record: dict[str, Any]) -> str:
    cells = record["figures"]["cells"]
    kept = ", ".join(f"{sum(cell[name] for cell in cells)} {word}" for name, word in HELD.items())
    says = f"{len(cells)} cells on `{record['figures']['plant']}`, version {record['version']}: {kept}.\n\n"
    lines: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for cell in cells:
        lines.setdefault((cell["fault"], *_outcome(cell)), []).append(cell)
    buses = Counter(fault for fault, *_ in lines)
    made: dict[str, list[tuple[str, ...]]] = {}
    for (fault, named, reaction, leads_out), alike in lines.items():
        name = fault if buses[fault] == 1 else f"{fault} ({alike[0]['bus']})"
        safe_s = [cell["seconds"] for cell in alike if cell["seconds"] is not None]
        made.setdefault(leads_out, [("fault", "named as", "reaction, safe after")]).append(
            (name, named, f"{reaction}, {max(safe_s):.3f} s" if safe_s else reaction)
        )
    return _MATRIX_HEAD + says + "\n".join(f"## Way out: {by}\n\n{table(of[0], of[1:])}" for by, of in made.items())


def _outcome(cell: dict[str, Any]) -> tuple[str, ...]:
    told = [*cell["host_faults"], *(f"device:{name}" for name in cell["device_faults"]), *cell["limits"]]
    # the daemon tells what the device has latched, too, unless it is dead
    told = [name for name in told if name.replace("device:", "DEVICE_") not in told or not name.startswith("device:")]
    failed = [f"not {word}" for name, word in HELD.items() if not cell[name]]
    reaction = cell["expected"] + (f" (**{', '.join(failed)}**)" if failed else "")
    return ", ".join(dict.fromkeys(told)) or "-", reaction, ", ".join(cell["recovery"]) or "no command"


def _transitions() -> str:
    known = {(row.event, row.source): row for row in ROWS}
    rows = []
    for event in Event:
        row = next(row for row in ROWS if row.event is event and isinstance(row, Transition))
        guards = ", ".join(dict.fromkeys(f"`{guard.code}`" for guard in row.guards)) or "-"
        leads_of = [known[event, state] for state in OperatingState]
        leads = [str(each.target) if isinstance(each, Transition) else f"`{each.code}`" for each in leads_of]
        asked = "-" if row.request is DeviceRequest.NONE else str(row.request)
        rows.append((f"*{event}*" if event is Event.FAULT else f"`{event}`", *leads, guards, asked))
    return (
        "## Events\n\nThe table gives the next state or the refusal. Without a device every command is refused with "
        "`not_connected`, except `stop`, and `use-scene` while DISABLED.\n\n"
        + table(("event", *OperatingState, "guards, in order", "request"), rows)
        + "\n"
    )


def _guards() -> str:
    guards = [guard for row in ROWS if isinstance(row, Transition) for guard in row.guards]
    rows = [(f"`{guard.code}`", guard.wants, guard.remedy) for guard in dict.fromkeys(guards)]
    return (
        "## Guards\n\nThe first guard that does not hold refuses the command.\n\n"
        + table(("refused as", "condition", "remedy"), rows)
        + "\n"
    )


def _faults() -> str:
    stay = ", ".join(f"`{fault}`" for fault in Fault if "home" not in FAULTS[fault].clears)
    return (
        "## Faults\n\nA fault stays latched until `clear-fault`. Then the device has to home, except after "
        f"{stay}. Several faults are listed in this order, causes first. *By* is the time from the first sign of the "
        "fault; control at 500 Hz adds up to 4 ms.\n\n"
        + _codes("fault", {fault: FAULTS[fault] for fault in Fault})
        + "\n"
    )


def _limits() -> str:
    return "## Limits\n\nLimits come and go by themselves.\n\n" + _codes(
        "limit", {limit: LIMITS[limit] for limit in Limit}
    )


def _codes(kind: str, codes: Mapping[Any, Explanation]) -> str:
    rows = [(f"`{code}`", row.cause, row.reaction, f"{row.safe_ms:,.0f}", row.remedy) for code, row in codes.items()]
    return table((kind, "means", "reaction", "by, ms", "remedy"), rows)


if __name__ == "__main__":
    sys.exit(main())
