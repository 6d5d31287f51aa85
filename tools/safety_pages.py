"""Writes docs/states.md from the tables of `tormagd/safety`, and docs/fault-matrix.md from docs/evidence/faults.json.

Two tests hold the pages to what they are made from. `python tools/safety_pages.py` after a change of either.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fault_matrix.cases import LEFT_OUT

from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.safety.operating_state import ROWS, DeviceRequest, Event, Guard, OperatingState, Refusal, Transition

DOCS = Path(__file__).parents[1] / "docs"
STATES, MATRIX = DOCS / "states.md", DOCS / "fault-matrix.md"
EVIDENCE = DOCS / "evidence" / "faults.json"

FAILED = {"named": "unnamed", "safe": "unsafe", "in_time": "late", "recovered": "not recovered"}
"What a cell is called that is not what it should be."

_STATES_HEAD = """# Operating states, faults and limits

Written by `python tools/safety_pages.py` from the tables that the daemon itself runs on, `operating_state.py` and
`codes.py` in `tormagd/safety`. What happens beyond this process is told in [safety](safety.md), and in the
[fault matrix](fault-matrix.md) what each fault comes to on a serial line and on a CAN bus.

"""
_MATRIX_HEAD = """# Fault matrix

Written by `python tools/safety_pages.py` from [evidence/faults.json](evidence/faults.json), a run of `tools/faults.py`
(`python tools/evidence.py faults`). All of it is virtual time and simulated devices.

*Stated* is by when the reaction has to be on its way: the device begins to open or lets go, the limit is told, the
command is refused. It is what [the table of codes](states.md#faults) says of the code that is to be named, or the
injection's own time, and `-` where nothing has to be named. *Reacted* is what was measured, *open* when the gap was.

*Recovery* is [what the daemon names](messages.md#status) as the way to ENABLED (`next_commands`), tried twice. *Before*
is what it came to while the cause lasted: a command is refused, a fault shows again, or a limit is told all the while;
`-` where the cause had gone by itself, or the daemon was dead. Then the cause is ended, and the commands of the last
column are given: afterwards the force is followed again within 0.15 N, and nothing of the fault is told any more.

"""


def main() -> int:
    """Writes both pages."""
    STATES.write_text(states_page(), encoding="utf-8")
    MATRIX.write_text(matrix_page(json.loads(EVIDENCE.read_text(encoding="utf-8"))), encoding="utf-8")
    return 0


def states_page() -> str:
    """The page of the tables."""
    return "".join((_STATES_HEAD, _diagram(), _transitions(), _guards(), _faults(), _limits())).rstrip() + "\n"


def matrix_page(record: dict[str, Any]) -> str:
    """The page of a run of the matrix."""
    cells = record["figures"]["cells"]
    faults = dict.fromkeys(cell["fault"] for cell in cells)
    kept = [sum(cell[name] for cell in cells) for name in ("named", "safe", "in_time", "recovered")]
    says = (
        f"{len(faults)} faults, {len(cells)} cells on `{record['figures']['plant']}`, version {record['version']}: "
        f"{kept[0]} named, {kept[1]} ended safe, {kept[2]} reacted in their stated time, {kept[3]} recovered as "
        "documented.\n\n"
    )
    head = ("fault", "bus", "named as", "reaction", "excitation", "stated", "reacted", "open", "before", "recovery")
    never = "\n## What is no row, and why\n\n" + _table(("fault", "why"), [*LEFT_OUT.items()])
    return _MATRIX_HEAD + says + _table(head, [_cell(cell) for cell in cells]) + never


def _cell(cell: dict[str, Any]) -> tuple[str, ...]:
    told = [*cell["host_faults"], *(f"device:{name}" for name in cell["device_faults"]), *cell["limits"]]
    failed = [word for name, word in FAILED.items() if not cell[name]]
    reaction = cell["expected"] + (f" (**{', '.join(failed)}**)" if failed else "")
    named = ", ".join(dict.fromkeys(told)) or "-"
    times = [_ms(cell[name]) for name in ("stated_ms", "reacted_ms", "open_ms")]
    recovery = ", ".join(cell["recovery"]) or "by itself"
    return cell["fault"], cell["bus"], named, reaction, cell["excitation"], *times, cell["tried"] or "-", recovery


def _ms(time_ms: float | None) -> str:
    return "-" if time_ms is None else f"{time_ms:,.0f} ms"


def _diagram() -> str:
    edges: dict[tuple[OperatingState, OperatingState], list[str]] = {}
    for row in ROWS:
        if isinstance(row, Transition):
            edges.setdefault((row.source, row.target), []).append(str(row.event))
    lines = [f"    {source} --> {target}: {', '.join(events)}" for (source, target), events in edges.items()]
    return "\n".join(("```mermaid", "stateDiagram-v2", f"    [*] --> {OperatingState.DISABLED}", *lines, "```", "", ""))


def _transitions() -> str:
    rows = [_transition(row) if isinstance(row, Transition) else _refusal(row) for row in ROWS]
    return (
        "## Events\n\nEvery event in every state. Without a device a command is refused with `not_connected`, whatever "
        "else is in its way, except `stop`.\n\n"
        + _table(("event", "in", "leads to", "logged as", "guards, in their order", "the device is asked"), rows)
        + "\n"
    )


def _transition(row: Transition) -> tuple[str, ...]:
    asked = "-" if row.request is DeviceRequest.NONE else str(row.request)
    if row.request is DeviceRequest.CLEAR:
        asked += ", where it has latched"
    guards = ", ".join(f"`{guard.code}`" for guard in row.guards) or "-"
    return _event(row.event), row.source, row.target, row.reason, guards, asked


def _refusal(row: Refusal) -> tuple[str, ...]:
    return _event(row.event), row.source, f"refused: `{row.code}`", f"do: {row.remedy}", "-", "-"


def _event(event: Event) -> str:
    return f"*{event}*" if event is Event.FAULT else f"`{event}`"


def _guards() -> str:
    known: dict[tuple[str, str], Guard] = {}
    for row in ROWS:
        if isinstance(row, Transition):
            for guard in row.guards:
                known.setdefault((guard.code, guard.wants), guard)
    rows = [(f"`{guard.code}`", guard.wants, guard.remedy) for guard in known.values()]
    return (
        "## Guards\n\nA command is refused with the first that does not hold.\n\n"
        + _table(("refused as", "wants that", "otherwise"), rows)
        + "\n"
    )


def _faults() -> str:
    rows = []
    for fault in Fault:
        row = FAULTS[fault]
        rows.append(
            (f"`{fault}`", row.cause, row.reaction, f"{row.safe_ms:,.0f} ms, {row.shows}", row.clears, row.remedy)
        )
    return (
        "## Faults\n\nLatched until `clear-fault`. Several that show at once are named in this order: causes before "
        "what follows of them. The reaction is on its way by the time that is stated, from when the fault is there and "
        "shows; 50 ms are the device's own timeout, a tick is 1 ms.\n\n"
        + _table(("fault", "means", "reaction", "by", "is cleared by", "remedy"), rows)
        + "\n"
    )


def _limits() -> str:
    rows = []
    for limit in Limit:
        row = LIMITS[limit]
        rows.append((f"`{limit}`", row.cause, row.reaction, f"{row.safe_ms:,.0f} ms, {row.shows}", row.remedy))
    return "## Limits\n\nThey come and go by themselves.\n\n" + _table(
        ("limit", "means", "reaction", "told by", "remedy"), rows
    )


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
