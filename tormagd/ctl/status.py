"""`tormagctl status` and `firmware`: the daemon's status and its link's report, as JSON or as text."""

import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

from firmware_protocol.build import COST, REMEDY
from tormagd.ctl.outcome import Colour, Exit, Outcome, folded
from tormagd.record.force_following import in_words
from tormagd.view.believed import as_said
from tormagd_client.blocking import Client
from tormagd_client.messages import (
    BeliefReport,
    Explained,
    LinkReport,
    PeersReport,
    PlayoutReport,
    RateReport,
    SetpointReport,
    SourceReport,
    Status,
    WayReport,
)
from tormagd_client.wire import understood

UNKNOWN, NOT_YET = "-", "not known yet"
RECOMMISSION = "tormagctl commission FOLDER writes a new one; then systemctl reload tormagd"
OLD_MS = 1_000.0
"An older setpoint may still be valid; its age is shown."
SURE_WINDOWS = 20
"Ten seconds of windows, after which a clock's drift is shown."
SETPOINT_COUNTS = ("accepted", "refused", "dropped")
LINK_COUNTS = ("losses", "frames", "corrupt", "lost", "repeated", "resynchronisations")
LINK_COUNTERS = ("frames", "bytes", "corrupt", "lost", "repeated", "resynchronisations")


def status(client: Client) -> Outcome:
    result = client.request("status")
    known = understood(result, Status)
    code = Exit.FAULT if known.operating_state == "FAULT" else Exit.DONE
    return Outcome(result, folded(status_text(known, Colour(sys.stdout))), code)


def status_text(known: Status, colour: Colour) -> str:
    """Return a status as labelled lines of text, the most important first."""
    state = known.operating_state
    paint = {"ENABLED": colour.green, "PAUSED": colour.yellow, "FAULT": colour.red}.get(state, colour.bold)
    is_running = known.link.state == "RUNNING"
    flags = [
        "homed" if known.is_homed else colour.yellow("not homed"),
        *(["busy"] if known.is_busy else []),
        *(["open"] if known.is_open else []),
    ]
    lines = [
        f"state     {paint(state)}, {', '.join(flags)}",
        *_codes(known.faults, known.fault_details, "fault", colour.red),
        # without a device none of them would be taken: the link says what comes first
        *([f"next      tormagctl arm: {', '.join(known.next_commands)}"] if known.next_commands and is_running else []),
        *_codes(known.limits, known.limit_details, "held by", colour.yellow),
        f"force     asked {_number(known.setpoint_cf, 'N')}{_long_ago(known)}, "
        f"governed {_number(known.governed_cf, 'N')}, measured {_number(known.measured_cf, 'N')}"
        f"{torque(known.measured_cf, known.roller_radius_mm)}",
        *_said("followed  ", in_words(known.following), str),
        f"gap       {_number(known.gap_mm, 'mm', 2)}, wanted {_number(known.gap_setpoint_mm, 'mm', 2)}, "
        f"skew {_number(known.skew_mm, 'mm', 3)}",
        f"setpoint  {_number(known.setpoint_age_ms, 'ms', 0)} old, {_counts(known.setpoints, SETPOINT_COUNTS)}",
        *(line for name, source in known.setpoints.by_source.items() for line in _source(name, source, colour)),
        *_said("playout   ", played(known.setpoints.playout), str),
        *_way(None if known.setpoint_cf is None else known.way, colour),
        *_peers(known.peers, colour),
        *_device(known, colour),
        f"link      {known.link.state}, {_counts(known.link, LINK_COUNTS)}",
        *_explained(known.link.cause, known.link.remedy, colour.yellow),
        *(line for each in known.not_granted for line in _said("kernel    ", f"did not grant {each}", colour.yellow)),
        *_explained("", "tormagctl doctor" if known.not_granted else "", str),
        *(_rate(name, group, colour) for name, group in known.rates.items()),
        *([f"field     of a search {known.search_age_ms:.0f} ms ago"] if known.search_age_ms else []),
        *_late_ticks(known.late_ticks_by),
        f"daemon    {known.version}, scene {known.scene}, up {_number(known.uptime_s, 's', 0)}",
        *([f"terms out {', '.join(known.terms_out)}"] if known.terms_out else []),
        *_core(known.build, colour),
        *_said("black box ", known.black_box.newest, str),
        *_said("black box ", known.black_box.folder and known.black_box.refusal, colour.yellow),
        *_said("refused   ", known.setpoints.last_refusal, colour.yellow),
    ]
    return "\n".join(lines)


def _peers(peers: PeersReport, colour: Colour) -> list[str]:
    return [
        *_said("peers     ", peers.refused and f"{peers.refused} refused", colour.yellow),
        *_said("peers     ", peers.dropped and f"{peers.dropped} messages not read", colour.yellow),
        *(
            f"          {it.endpoint}: {it.address}{f', key {it.key}' if it.key else ''}: {it.reason} ({it.count})"
            for it in (*peers.refusals, *peers.drops)
        ),
    ]


def _device(known: Status, colour: Colour) -> list[str]:
    """Return lines on what the device has shown of itself: scale, offset, sensor's zero."""
    shown, kept = known.device, known.profile
    age = "" if kept.age_s is None else f", kept {kept.age_s / 3600.0:.1f} h ago"
    # without a folder nothing was to be kept
    refusal = kept.refusal if kept.folder else ""
    return [
        f"device    {shown.scale:.2f} ± {shown.scale_sd:.2f} times the model {shown.offset_N:+.3f} N, sensor's zero "
        f"{shown.sensor_zero_N:+.3f} ± {shown.sensor_zero_sd_N:.3f} N{age}",
        *_said("believed  ", believed(known.belief, ("scale", "offset", "sensor_zero")), str),
        *_explained(refusal, refusal and "tormagctl calibrate --device, which keeps a new profile", colour.yellow),
        *_said("calibrated", known.calibration.file and f" by {known.calibration.file}", str),
        *_explained(known.calibration.refusal, known.calibration.refusal and RECOMMISSION, colour.yellow),
    ]


def _long_ago(known: Status) -> str:
    age_ms = known.setpoint_age_ms
    return "" if known.setpoint_cf is None or age_ms is None or age_ms < OLD_MS else f" {age_ms * 1e-3:.0f} s ago"


def played(report: PlayoutReport | None) -> str:
    if report is None:
        return ""
    return (
        f"{report.playout_ms:g} ms after the stamp: adds {report.held_us.p50 * 1e-3:.1f} ms (p50), takes out "
        f"{report.jitter_us * 1e-3:.1f} ms of jitter, {report.late} of {report.setpoints} came too late"
    )


def refused(not_granted: Iterable[str]) -> dict[str, str]:
    """Return the kernel's refusals by configuration key."""
    return {re.split("[ :]", each, maxsplit=1)[0]: each for each in not_granted}


def torque(force_N: float | None, roller_radius_mm: float | None) -> str:
    """Return a force at the roller as torque at the handle's shaft, in brackets."""
    if force_N is None or roller_radius_mm is None:
        return ""
    return f" ({force_N * roller_radius_mm:.1f} mNm)"


def believed(belief: Mapping[str, BeliefReport], but: Collection[str] = ()) -> str:
    """Return the beliefs that act in one line."""
    told = as_said({name: it for name, it in belief.items() if name not in but})
    return ", ".join(f"{name} {value}" for name, value in told.items())


def _core(build: str, colour: Colour) -> list[str]:
    """Return lines on the core's build; none for an older daemon."""
    if build in ("", "compiled"):
        return _said("core      ", build, str)
    return [f"core      {colour.yellow(build)}", *_explained(COST, REMEDY, str)]


def _number(value: float | None, unit: str, digits: int = 3) -> str:
    return UNKNOWN if value is None else f"{value:.{digits}f} {unit}"


def _counts(report: LinkReport | SetpointReport, names: tuple[str, ...]) -> str:
    numbers = [(getattr(report, name), name) for name in names]
    return ", ".join(f"{number} {name}" for number, name in numbers if number is not None)


def _source(name: str, source: SourceReport, colour: Colour) -> list[str]:
    paint = {"holds": colour.green, "refused": colour.yellow}.get(source.state, str)
    delay, behind = source.delay_us, source.clock_behind_ms
    words = {"holds": "holds the brake", "refused": "refused", "stale": f"silent for {source.silent_ms * 1e-3:.1f} s"}
    parts = [
        paint(words.get(source.state, source.state)),
        f"delay {delay.p50 * 1e-3:.1f} ms (p50) {delay.p99 * 1e-3:.1f} ms (p99)",
        f"jitter {source.jitter_us * 1e-3:.1f} ms",
        f"{source.lost} lost",
        "clock not known yet"
        if behind is None
        else f"clock {abs(behind):.1f} ms {'behind' if behind >= 0.0 else 'ahead'}",
    ]
    if source.clock is not None and source.clock.windows >= SURE_WINDOWS:
        parts[-1] += f", {source.clock.drift_ppm:+.0f} ppm"
    if source.restarts:
        parts.append(f"{source.restarts} restarts")
    if source.raised:
        parts.append(f"{source.raised} around zero taken as 0")
    return [f"source    {name!r}: {', '.join(parts)}", *_explained(source.cause, source.remedy, colour.yellow)]


def _way(way: WayReport | None, colour: Colour) -> list[str]:
    """Return lines on the delay from a setpoint's stamp to its force, part by part."""
    if way is None or way.to_duty_us.max == 0.0:
        return []
    to_duty, total_ms = way.to_duty_us, way.total_ms
    paint = colour.yellow if total_ms is not None and total_ms > way.budget_ms else str
    parts = [
        f"{paint(_number(total_ms, 'ms', 1))} of {way.budget_ms:g} ms",
        f"stamp to duty {to_duty.p50 * 1e-3:.1f} ms (p50) {to_duty.p99 * 1e-3:.1f} ms (p99)",
        f"device {_number(None if way.device_us is None else way.device_us * 1e-3, 'ms', 1)}",
        f"carriages {_number(way.carriages_ms, 'ms', 1)}",
    ]
    lines = [f"way       {', '.join(parts)}"]
    if total_ms is not None and total_ms > way.budget_ms:
        shares = {
            "from the stamp to the duty: look at the delay of the source, and at the playout": to_duty.p99 * 1e-3,
            "at the device: look at the round trip in tormagctl firmware": (way.device_us or 0.0) * 1e-3,
            "in the carriages: ask for slower changes, or look at the motors": way.carriages_ms or 0.0,
        }
        lines += _explained("the force comes too late", f"most is {max(shares, key=lambda part: shares[part])}", str)
    return lines


def _codes(codes: Sequence[str], details: Sequence[Explained], label: str, paint: Callable[[str], str]) -> list[str]:
    why = {each.code: _explained(each.cause, each.remedy, str) for each in details}
    return [line for code in codes for line in (f"{label:<9} {paint(code)}", *why.get(code, ()))]


def _explained(cause: str, remedy: str, paint: Callable[[str], str]) -> list[str]:
    return [*_said(" " * 10, cause, paint), *_said(" " * 10, remedy and f"next: {remedy}", str)]


def _said(label: str, text: str | int | None, paint: Callable[[str], str]) -> list[str]:
    return [f"{label}{paint(str(text))}"] if text else []


def _rate(name: str, group: RateReport, colour: Colour) -> str:
    paint = {"warning": colour.yellow, "error": colour.red}.get(group.grade, str)
    lateness = group.lateness_us
    return (
        f"{name:<9} {paint(group.grade)}, {group.hz:.0f} Hz, late {lateness.p50:.0f} us (p50) {lateness.p99:.0f} us "
        f"(p99), overruns {group.overruns}, stalls {group.stalls}, merged {group.merged}"
    )


def _late_ticks(blamed: Mapping[str, int]) -> list[str]:
    worst_first = sorted(blamed, key=lambda name: (-blamed[name], name))
    return [f"late by   {', '.join(f'{blamed[name]} {name}' for name in worst_first)}"] if blamed else []


def firmware(client: Client) -> Outcome:
    """Report the daemon's link, with the keys of `link` in the status."""
    result = client.request("status")
    return Outcome(result["link"], folded(firmware_text(understood(result, Status).link, Colour(sys.stdout))))


def firmware_text(link: LinkReport, colour: Colour) -> str:
    paint = colour.green if link.state == "RUNNING" else colour.yellow
    last = f", the last: {link.last_loss}" if link.last_loss else ""
    ours, theirs = link.daemon_schema, link.firmware_schema
    fits = (
        UNKNOWN if theirs is None else "the daemon's too" if theirs == ours else colour.red(f"the daemon's is {ours}")
    )
    lines = [
        f"link        {paint(link.state)} on {link.port} ({link.backend})",
        *_said(" " * 12, link.cause, colour.yellow),
        *_said(" " * 12, link.remedy and f"next: {link.remedy}", str),
        f"firmware    {_shown(link.firmware)}, device {_shown(link.serial_number)}",
        f"schema      {_shown(theirs)} ({fits}), protocol {link.protocol_version}",
        f"losses      {link.losses} since the daemon started{last}",
        f"received    {', '.join(f'{_shown(getattr(link, name))} {name}' for name in LINK_COUNTERS)}",
        f"refused     {', '.join(f'{name}: {why}' for name, why in sorted(link.refused.items())) or 'nothing'}",
        *_wire(link),
    ]
    return "\n".join(lines)


def _shown(value: str | int | None) -> str:
    return UNKNOWN if value is None else str(value)


def _wire(link: LinkReport) -> list[str]:
    """Return lines on how well the wire carries: round trip, the last second's losses, the device's clock."""
    trip, clock = link.round_trip_us, link.clock
    time_us, lost, drift = NOT_YET, NOT_YET, f"{NOT_YET}: a fit takes some seconds"
    if trip is not None:
        time_us = f"{trip.p50:.0f} us (p50), {trip.p99:.0f} us (p99), {trip.least:.0f} us at least"
    if link.unanswered_share is not None and link.damaged_share is not None:
        lost = (
            f"{link.unanswered_share:.1%} of the Drives unanswered, {link.damaged_share:.1%} of the frames damaged in "
            f"the last second; {_shown(link.unsent)} messages found the wire full"
        )
    if clock is not None:
        drift = (
            f"{clock.drift_ppm:+.1f} ppm, host - device {clock.offset_s:.6f} s, {clock.residual_us:.1f} us around "
            f"the line ({clock.windows} windows, {clock.outliers} outliers)"
        )
    return [f"round trip  {time_us}", f"quality     {lost}", f"clock       {drift}"]
