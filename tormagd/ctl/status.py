"""`tormagctl status`: the daemon's own snapshot, as it is or as text."""

import sys
from collections.abc import Mapping
from typing import Any

from tormagd.ctl.client import Client
from tormagd.ctl.outcome import Colour, Exit, Outcome

UNKNOWN = "-"
SETPOINT_COUNTS = ("accepted", "refused", "dropped", "oversize")
LINK_COUNTS = ("losses", "frames", "corrupt", "lost", "repeated", "resynchronisations")


def status(client: Client) -> Outcome:
    """What the daemon is doing. The exit code is FAULT while the device is in FAULT."""
    result = client.request("status")
    code = Exit.FAULT if result.get("operating_state") == "FAULT" else Exit.DONE
    return Outcome(result, status_text(result, Colour(sys.stdout)), code)


def status_text(result: Mapping[str, Any], colour: Colour) -> str:
    """The snapshot in a dozen lines, most important first; what the daemon did not say shows as `-`."""
    state = str(result.get("operating_state", UNKNOWN))
    paint = {"ENABLED": colour.green, "PAUSED": colour.yellow, "FAULT": colour.red}.get(state, colour.bold)
    flags = [
        "homed" if result.get("is_homed") else colour.yellow("not homed"),
        *(["busy"] if result.get("is_busy") else []),
    ]
    link = _table(result, "link")
    link_state = str(link.get("state", UNKNOWN))
    lines = [
        f"state     {paint(state)}, {', '.join(flags)}",
        *_codes(result, "faults", "fault_details", "fault", colour.red),
        *_codes(result, "limits", "limit_details", "held by", colour.yellow),
        f"force     asked {_number(result, 'setpoint_cf', 'N')}, governed {_number(result, 'governed_cf', 'N')}, "
        f"measured {_number(result, 'measured_cf', 'N')}",
        f"gap       {_number(result, 'gap_mm', 'mm', 2)}, wanted {_number(result, 'gap_setpoint_mm', 'mm', 2)}, "
        f"skew {_number(result, 'skew_mm', 'mm', 3)}",
        f"setpoint  {_number(result, 'setpoint_age_ms', 'ms', 0)} old, "
        f"{_counts(_table(result, 'setpoints'), SETPOINT_COUNTS)}",
        f"link      {link_state}, {_counts(link, LINK_COUNTS)}",
        *_explained(link.get("cause"), link.get("remedy"), colour.yellow),
        *_rates(_table(result, "rates"), colour),
        *_late_ticks(_table(result, "late_ticks_by")),
        f"daemon    {result.get('version', UNKNOWN)}, scene {result.get('scene', UNKNOWN)}, "
        f"up {_number(result, 'uptime_s', 's', 0)}",
    ]
    refusal = _table(result, "setpoints").get("last_refusal")
    if refusal:
        lines.append(f"refused   {colour.yellow(str(refusal))}")
    return "\n".join(lines)


def _table(result: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = result.get(name)
    return value if isinstance(value, Mapping) else {}


def _number(result: Mapping[str, Any], name: str, unit: str, digits: int = 3) -> str:
    value = result.get(name)
    return f"{value:.{digits}f} {unit}" if isinstance(value, int | float) else UNKNOWN


def _counts(table: Mapping[str, Any], names: tuple[str, ...]) -> str:
    numbers = [f"{table[name]} {name}" for name in names if isinstance(table.get(name), int)]
    return ", ".join(numbers) or UNKNOWN


def _codes(result: Mapping[str, Any], names: str, details: str, label: str, paint: Any) -> list[str]:
    known = {entry["code"]: entry for entry in result.get(details) or () if isinstance(entry, dict) and "code" in entry}
    lines = []
    for code in result.get(names) or ():
        lines.append(f"{label:<9} {paint(str(code))}")
        entry = known.get(code, {})
        lines += _explained(entry.get("cause"), entry.get("remedy"), str)
    return lines


def _explained(cause: object, remedy: object, paint: Any) -> list[str]:
    lines = [f"          {paint(str(cause))}"] if cause else []
    return [*lines, f"          next: {remedy}"] if remedy else lines


def _rates(rates: Mapping[str, Any], colour: Colour) -> list[str]:
    lines = []
    for name in rates:
        group = _table(rates, name)
        lateness = _table(group, "lateness_us")
        grade = str(group.get("grade") or UNKNOWN)
        paint = {"warning": colour.yellow, "error": colour.red}.get(grade, str)
        lines.append(
            f"{name:<9} {paint(grade)}, {_number(group, 'hz', 'Hz', 0)}, "
            f"late {_number(lateness, 'p50', 'us', 0)} (p50) {_number(lateness, 'p99', 'us', 0)} (p99), "
            f"overruns {group.get('overruns', UNKNOWN)}, stalls {group.get('stalls', UNKNOWN)}, "
            f"merged {group.get('merged', UNKNOWN)}"
        )
    return lines


def _late_ticks(blamed: Mapping[str, Any]) -> list[str]:
    """Who made control ticks late, the one who made most of them first; nothing while none was late."""
    counted = {name: count for name, count in blamed.items() if isinstance(count, int)}
    worst_first = sorted(counted, key=lambda name: (-counted[name], name))
    return [f"late by   {', '.join(f'{counted[name]} {name}' for name in worst_first)}"] if counted else []
