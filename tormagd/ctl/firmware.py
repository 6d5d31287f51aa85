"""`tormagctl firmware`: who is at the other end of the wire, and how well the wire carries."""

import sys
from collections.abc import Mapping
from typing import Any

from tormagd.ctl.client import Client
from tormagd.ctl.outcome import Colour, Outcome

UNKNOWN = "-"
COUNTERS = ("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations")


def firmware(client: Client) -> Outcome:
    """The daemon's report on its link: the keys of `--json` are those of `link` in the status."""
    status = client.request("status")
    link = status.get("link")
    result = dict(link) if isinstance(link, dict) else {}
    return Outcome(result, firmware_text(result, Colour(sys.stdout)))


def firmware_text(link: Mapping[str, Any], colour: Colour) -> str:
    """The report in half a dozen lines; what is not known shows as `-`."""
    state = _shown(link, "state")
    paint = colour.green if state == "RUNNING" else colour.yellow
    lines = [f"link        {paint(state)} on {_shown(link, 'port')} ({_shown(link, 'backend')})"]
    if link.get("cause"):
        lines.append(f"            {colour.yellow(str(link['cause']))}")
    if link.get("remedy"):
        lines.append(f"            next: {link['remedy']}")
    ours, theirs = link.get("daemon_schema"), link.get("firmware_schema")
    fits = (
        UNKNOWN if theirs is None else "the daemon's too" if theirs == ours else colour.red(f"the daemon's is {ours}")
    )
    losses = f"{_shown(link, 'losses')} since the daemon started"
    if link.get("last_loss"):
        losses += f", the last: {link['last_loss']}"
    lines += [
        f"firmware    {_shown(link, 'firmware')}, device {_shown(link, 'serial_number')}",
        f"schema      {_shown(link, 'firmware_schema')} ({fits}), protocol {_shown(link, 'protocol_version')}",
        f"losses      {losses}",
        f"received    {', '.join(f'{_shown(link, name)} {name}' for name in COUNTERS)}",
        f"round trip  {_round_trip(link.get('round_trip_us'))}",
        f"clock       {_clock(link.get('clock'))}",
    ]
    return "\n".join(lines)


def _shown(link: Mapping[str, Any], name: str) -> str:
    value = link.get(name)
    return UNKNOWN if value is None else str(value)


def _round_trip(known: Any) -> str:
    if not isinstance(known, Mapping):
        return "not known yet"
    return f"{known['p50']:.0f} us (p50), {known['p99']:.0f} us (p99), {known['least']:.0f} us at least"


def _clock(known: Any) -> str:
    if not isinstance(known, Mapping):
        return "not known yet: a fit takes some seconds"
    return (
        f"{known['drift_ppm']:+.1f} ppm, host - device {known['offset_s']:.6f} s, {known['residual_us']:.1f} us around "
        f"the line ({known['windows']} windows, {known['outliers']} outliers)"
    )
