"""`tormagctl firmware`: who is at the other end of the wire, and how well the wire carries."""

import sys

from tormagd.ctl.outcome import Colour, Outcome
from tormagd_client.blocking import Client
from tormagd_client.messages import ClockReport, LinkReport, RoundTripReport
from tormagd_client.wire import understood

UNKNOWN = "-"
COUNTERS = ("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations")


def firmware(client: Client) -> Outcome:
    """The daemon's report on its link: the keys of `--json` are those of `link` in the status."""
    result = client.request("status")
    known = understood(result).link
    return Outcome(result["link"], firmware_text(known, Colour(sys.stdout)))


def firmware_text(link: LinkReport, colour: Colour) -> str:
    """The report in half a dozen lines; what is not known shows as `-`."""
    paint = colour.green if link.state == "RUNNING" else colour.yellow
    lines = [f"link        {paint(link.state)} on {link.port} ({link.backend})"]
    lines += [f"            {colour.yellow(link.cause)}"] if link.cause else []
    lines += [f"            next: {link.remedy}"] if link.remedy else []
    last = f", the last: {link.last_loss}" if link.last_loss else ""
    ours, theirs = link.daemon_schema, link.firmware_schema
    fits = (
        UNKNOWN if theirs is None else "the daemon's too" if theirs == ours else colour.red(f"the daemon's is {ours}")
    )
    lines += [
        f"firmware    {_shown(link.firmware)}, device {_shown(link.serial_number)}",
        f"schema      {_shown(theirs)} ({fits}), protocol {link.protocol_version}",
        f"losses      {link.losses} since the daemon started{last}",
        f"received    {', '.join(f'{_shown(getattr(link, name))} {name}' for name in COUNTERS)}",
        f"refused     {', '.join(f'{name}: {why}' for name, why in sorted(link.refused.items())) or 'nothing'}",
        f"round trip  {_round_trip(link.round_trip_us)}",
        f"quality     {_quality(link)}",
        f"clock       {_clock(link.clock)}",
    ]
    return "\n".join(lines)


def _shown(value: str | int | None) -> str:
    return UNKNOWN if value is None else str(value)


def _round_trip(known: RoundTripReport | None) -> str:
    if known is None:
        return "not known yet"
    return f"{known.p50:.0f} us (p50), {known.p99:.0f} us (p99), {known.least:.0f} us at least"


def _quality(link: LinkReport) -> str:
    if link.unanswered_share is None or link.damaged_share is None:
        return "not known yet"
    return (
        f"{link.unanswered_share:.1%} of the Drives unanswered, {link.damaged_share:.1%} of the frames damaged in the "
        f"last second; {_shown(link.unsent)} messages found the wire full"
    )


def _clock(known: ClockReport | None) -> str:
    if known is None:
        return "not known yet: a fit takes some seconds"
    return (
        f"{known.drift_ppm:+.1f} ppm, host - device {known.offset_s:.6f} s, {known.residual_us:.1f} us around "
        f"the line ({known.windows} windows, {known.outliers} outliers)"
    )
