"""Devices over many recordings: how well each followed, what held it back, and how it drifts."""

from collections import Counter, defaultdict
from collections.abc import Iterable

import msgspec
import numpy as np

from tormagd.commission.sequence import Report
from tormagd.lab.consoles.summary import Summary

DAY_S = 86_400.0
MIN_DAYS, MIN_RECORDINGS = 1.0, 3
"Fewest days and recordings of which a drift per day is told."


class Drift(msgspec.Struct, frozen=True):
    """A quantity of a device in its first and newest recording, and its change per day by a straight line through all.

    `per_day` is null where the recordings are too few or of one day.
    """

    first: float
    newest: float
    per_day: float | None


class Console(msgspec.Struct, frozen=True, kw_only=True):
    """All recordings of one device with one insert; unknown is None, or an empty text for the insert.

    `tracking_rms_N` is over all time ENABLED, `worst_rms_N` of the worst recording.
    """

    serial_number: int | None
    insert: str
    recordings: int
    enabled_s: float
    tracking_rms_N: float | None
    worst_rms_N: float | None
    limits: dict[str, float]
    "Each limit's share of the time ENABLED."
    faults: dict[str, int]
    "In how many recordings each fault came."
    trim: Drift | None
    current_A: Drift | None
    clock_drift_ppm: Drift | None
    commissioned: Report | None
    "The device's newest commissioning, whatever its insert was."


def consoles(summaries: Iterable[Summary], reports: Iterable[Report]) -> list[Console]:
    """Return one console for each device and insert, sorted by serial number and insert.

    Recordings of unknown devices count as one device, which comes first. A device that was only commissioned has a
    console, too, with an empty text as insert and 0 recordings. Each console of a device has the newest of its reports,
    None without one. Empty for no input.
    """
    groups: dict[tuple[int, str], list[Summary]] = defaultdict(list)
    for each in summaries:
        groups[-1 if each.serial_number is None else each.serial_number, each.insert].append(each)
    newest = {each.serial_number: each for each in sorted(reports, key=lambda each: each.began_ns)}
    for serial_number in newest.keys() - {known for known, _ in groups}:
        groups[serial_number, ""] = []
    return [
        _console(serial_number, insert, sorted(group, key=lambda each: each.start_s), newest.get(serial_number))
        for (serial_number, insert), group in sorted(groups.items())
    ]


def _console(serial_number: int, insert: str, group: list[Summary], commissioned: Report | None) -> Console:
    """Return the console of a group of recordings; what none of them says is None.

    The group is in order of time, which is not checked, and may be empty. A `serial_number` below 0 is unknown. The
    error over all is weighted by the time ENABLED. `commissioned` is taken as it is.
    """
    enabled_s = sum(each.enabled_s for each in group)
    errors = [(each.enabled_s, each.tracking_rms_N) for each in group if each.tracking_rms_N is not None]
    limits_s: Counter[str] = Counter()
    for each in group:
        limits_s.update(each.limits_s)
    return Console(
        serial_number=None if serial_number < 0 else serial_number,
        insert=insert,
        recordings=len(group),
        enabled_s=enabled_s,
        tracking_rms_N=_pooled(errors),
        worst_rms_N=max((rms_N for _, rms_N in errors), default=None),
        limits={code: of_s / enabled_s for code, of_s in limits_s.most_common()} if enabled_s > 0.0 else {},
        faults=dict(Counter(code for each in group for code in each.faults_at_s)),
        trim=_drift([(each.start_s, each.trim) for each in group]),
        current_A=_drift([(each.start_s, each.current_A) for each in group]),
        clock_drift_ppm=_drift([(each.start_s, each.clock_drift_ppm) for each in group]),
        commissioned=commissioned,
    )


def _pooled(errors: list[tuple[float, float]]) -> float | None:
    """Return the RMS over all parts from (duration, RMS) of each, weighted by duration; None without parts.

    Where all durations are 0, parts weigh alike.
    """
    if not errors:
        return None
    weights, rms_N = np.array(errors).T
    return float(np.sqrt(np.average(rms_N**2, weights=weights if weights.any() else None)))


def _drift(values: list[tuple[float, float | None]]) -> Drift | None:
    """Return the drift of (start, s, value) pairs in order of time, ignoring None; None where no value is known.

    Its `per_day` is None for under MIN_RECORDINGS known values or MIN_DAYS from the first to the newest.
    """
    known = [(start_s, value) for start_s, value in values if value is not None]
    if not known:
        return None
    at_s, shown = np.array(known).T
    days = (at_s - at_s[0]) / DAY_S
    is_told = len(known) >= MIN_RECORDINGS and days[-1] >= MIN_DAYS
    return Drift(known[0][1], known[-1][1], float(np.polyfit(days, shown, 1)[0]) if is_told else None)
