"""How well many consoles followed, what held them back, and how their devices drift, from their recordings.

Workers read every `.mcap` in the folder, or under a URL that fsspec knows (`s3://bucket/recordings` takes the package
s3fs). Files that they cannot read are named. The table has a line for each device and insert; `--out` keeps a row for
each recording. `SERIAL.json` of `tormagctl commission` in the same place adds the day and what failed there.
"""

import argparse
import datetime
import os
import re
import sys
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from typing import Any, BinaryIO

import fsspec
import msgspec
import numpy as np
import pyarrow
import pyarrow.parquet

from tormag_lab import executors
from tormag_lab.arrays import rms
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.told import table
from tormagd.commission.sequence import MAX_BYTES, Report
from tormagd.ground.terminal import write_line
from tormagd.record.overview import Floats, OverviewBuilder, glance
from tormagd.record.reader import Shown, read_open
from tormagd_client.printable import printable

DAY_S = 86_400.0
MIN_DAYS, MIN_RECORDINGS = 1.0, 3
"Least days and recordings for a drift per day."
SUFFIX = ".mcap"
READ = re.compile(r"(.*\.mcap|(.*/)?[0-9a-f]{8}\.json)", re.IGNORECASE)
"Recordings, and the reports of `tormagctl commission` by serial number."
FIGURES = (
    "trim", "device_clock_drift", "device_temperature_C", "left_current_A", "right_current_A", "lateness_us",
)  # fmt: skip
"Numbers of a tick that a summary covers."


Wanted = glance(*FIGURES)


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one recording; what was not recorded is null or an empty text. `trim` is the device's force over its
    model's, `current_A` the RMS of the motor that needed more. `trim`, clock drift and temperature are medians while
    ENABLED."""

    serial_number: int | None
    insert: str
    scene: str
    version: str
    start_s: float
    "Since 1970."
    duration_s: float
    enabled_s: float
    is_complete: bool
    tracking_rms_N: float | None
    late_p99_us: float | None
    limits_s: dict[str, float]
    "How long each limit acted."
    faults_at_s: dict[str, float]
    "When each fault first came, since the start."
    trim: float | None
    clock_drift_ppm: float | None
    temperature_C: float | None
    current_A: float | None


def summarise(file: BinaryIO, name: str) -> Summary:
    builder, enabled = OverviewBuilder(), {name: array("d") for name in FIGURES}

    def take(seen: Shown) -> None:
        builder.add(seen.t_ns, seen.is_tick, seen.message)
        if seen.is_tick and seen.message.get("operating_state") in (None, "ENABLED"):
            for name, values in enabled.items():
                value = seen.message.get(name)
                if value is not None:
                    values.append(value)

    recording = read_open(file, name, Wanted, take)
    overview = builder.made()
    if not overview.ticks and not overview.snapshots:
        raise ValueError(f"{name}: the recording has no messages")
    scene = recording.described("scene", dict[str, Any]) or {}
    insert, codes = scene.get("insert", {}), overview.codes

    def figure(name: str, of: Callable[[Floats], Any]) -> float | None:
        return float(of(np.array(enabled[name]))) if enabled[name] else None

    currents_A = [figure(name, rms) for name in ("left_current_A", "right_current_A")]
    drift = figure("device_clock_drift", np.median)
    return Summary(
        serial_number=recording.described("serial_number", int),
        insert=str(insert.get("name", "")) if isinstance(insert, dict) else "",
        scene=str(scene.get("name", "")),
        version=recording.metadata.get("version", ""),
        start_s=overview.start_ns * 1e-9,
        duration_s=overview.duration_s,
        enabled_s=codes["operating_state"]["ENABLED"].held_ns * 1e-9 if "ENABLED" in codes["operating_state"] else 0.0,
        is_complete=recording.is_complete,
        tracking_rms_N=None if overview.following is None else overview.following.rms_N,
        late_p99_us=figure("lateness_us", lambda values: np.percentile(values, 99.0)),
        limits_s={name: each.held_ns * 1e-9 for name, each in codes["limits"].items()},
        faults_at_s={name: each.spans_ns[0][0] * 1e-9 for name, each in codes["faults"].items()},
        trim=figure("trim", np.median),
        clock_drift_ppm=None if drift is None else drift * 1e6,
        temperature_C=figure("device_temperature_C", np.median),
        current_A=max((each for each in currents_A if each is not None), default=None),
    )


def files(url: str) -> dict[str, str]:
    """Return the full address of each file that matches READ, sorted by its path under the folder or URL."""
    system, root = fsspec.core.url_to_fs(url)
    if not system.exists(root):
        raise FileNotFoundError(f"{url}: no such folder or file")
    folder = root if system.isdir(root) else root.rpartition("/")[0]
    found = sorted(path for path in system.find(root) if READ.fullmatch(path))
    return {path.removeprefix(folder).lstrip("/"): system.unstrip_protocol(path) for path in found}


def read(url: str) -> Summary | Report | str:
    """Return a recording's summary, a commissioning's report, or the reason why there is neither."""
    name = url.rpartition("/")[2]
    try:
        system, path = fsspec.core.url_to_fs(url)
        if not system.isfile(path):
            return "it is no regular file"
        with system.open(path, "rb") as file:
            if name.lower().endswith(SUFFIX):
                return summarise(file, name)
            return msgspec.json.decode(file.read(MAX_BYTES), type=Report)
    except (OSError, ValueError, RecursionError) as error:
        return str(error).removeprefix(f"{name}: ")


def read_all(urls: dict[str, str], executor: Executor) -> tuple[dict[str, Summary], dict[str, Report], dict[str, str]]:
    """Read all files, and return summaries, reports and reasons for failure, each by name."""
    found: dict[str, Summary | Report | str] = {}
    for url, future in executors.finished(executor, read, urls.values(), "recording"):
        error = future.exception()
        found[url] = future.result() if error is None else f"the worker that read it failed: {error}"
    ordered = [(name, found[url]) for name, url in urls.items()]
    return (
        {name: each for name, each in ordered if isinstance(each, Summary)},
        {name: each for name, each in ordered if isinstance(each, Report)},
        {name: each for name, each in ordered if isinstance(each, str)},
    )


class Drift(msgspec.Struct, frozen=True):
    """A quantity of a device, first and newest, and its change per day along a fitted line."""

    first: float
    newest: float
    per_day: float | None


class Console(msgspec.Struct, frozen=True, kw_only=True):
    """All recordings of one device with one insert; unknown is None or an empty text."""

    serial_number: int | None
    insert: str
    recordings: int
    enabled_s: float
    tracking_rms_N: float | None
    worst_rms_N: float | None
    limits: dict[str, float]
    "Share of the time ENABLED."
    faults: dict[str, int]
    "Number of recordings with each fault."
    trim: Drift | None
    current_A: Drift | None
    clock_drift_ppm: Drift | None
    commissioned: Report | None
    "The device's newest, with whatever insert."


def consoles(summaries: Iterable[Summary], reports: Iterable[Report]) -> list[Console]:
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
    """Return the RMS over all parts, each a duration and its RMS."""
    if not errors:
        return None
    weights, rms_N = np.array(errors).T
    return float(np.sqrt(np.average(rms_N**2, weights=weights if weights.any() else None)))


def _drift(values: list[tuple[float, float | None]]) -> Drift | None:
    known = [(start_s, value) for start_s, value in values if value is not None]
    if not known:
        return None
    at_s, shown = np.array(known).T
    days = (at_s - at_s[0]) / DAY_S
    is_told = len(known) >= MIN_RECORDINGS and days[-1] >= MIN_DAYS
    return Drift(known[0][1], known[-1][1], float(np.polyfit(days, shown, 1)[0]) if is_told else None)


HEADINGS = (
    "device",
    "insert",
    "files",
    "enabled",
    "RMS, worst mN",
    "trim",
    "current A",
    "clock ppm",
    "commissioned",
    "held back by",
)
MIN_SHARE, MAX_LIMITS = 0.001, 3
"A person is shown at most so many limits, and none with a smaller share of the time."
KINDS = {
    str: pyarrow.string(),
    bool: pyarrow.bool_(),
    int | None: pyarrow.int64(),
    float: pyarrow.float64(),
    float | None: pyarrow.float64(),
    dict[str, float]: pyarrow.map_(pyarrow.string(), pyarrow.float64()),
}
"Parquet type of a column, by the type of its figure."


def write_parquet(summaries: dict[str, Summary], url: str) -> None:
    fields = msgspec.structs.fields(Summary)
    columns = [("file", pyarrow.string()), *((field.name, KINDS[field.type]) for field in fields)]
    rows = [{"file": name, **msgspec.structs.asdict(each)} for name, each in summaries.items()]
    table = pyarrow.Table.from_pylist(rows, pyarrow.schema(columns))
    with fsspec.open(url, "wb", auto_mkdir=False) as file:
        pyarrow.parquet.write_table(table, file)


def _cells(console: Console) -> tuple[str, ...]:
    errors_N = (console.tracking_rms_N, console.worst_rms_N)
    held = [f"{code} {share:.1%}" for code, share in console.limits.items() if share >= MIN_SHARE][:MAX_LIMITS]
    faults = [f"{code} in {count}" for code, count in console.faults.items()]
    return (
        "unknown" if console.serial_number is None else f"{console.serial_number:08x}",
        printable(console.insert) or "unknown",
        str(console.recordings),
        f"{console.enabled_s:.0f} s",
        ", ".join("unknown" if error_N is None else f"{1e3 * error_N:.1f}" for error_N in errors_N),
        _shown(console.trim, ".3f"),
        _shown(console.current_A, ".2f"),
        _shown(console.clock_drift_ppm, ".0f"),
        "unknown" if console.commissioned is None else printable(_judged(console.commissioned)),
        printable(", ".join([*held, *faults])) or "nothing",
    )


def _shown(drift: Drift | None, form: str) -> str:
    if drift is None:
        return "unknown"
    first, newest = f"{drift.first:{form}}", f"{drift.newest:{form}}"
    if first == newest:
        return first
    return f"{first}..{newest}" + ("" if drift.per_day is None else f" ({drift.per_day:+.1g}/day)")


def _judged(report: Report) -> str:
    day = datetime.datetime.fromtimestamp(report.began_ns * 1e-9, datetime.UTC).date()
    short = [] if report.is_whole else ["not whole"]
    return ", ".join([f"{day}", *short, *(f"{each.name} {each.shown}" for each in report.failed)])


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recordings", metavar="FOLDER|URL", help="where they are, in folders of their own or not")
    parser.add_argument("--out", metavar="FILE|URL", help="Parquet: one row of a recording")
    executors.add_options(parser, os.cpu_count() or 1, needed="tormag-lab[fleet], and to reach the recordings")


def run(options: argparse.Namespace) -> Found:
    if (options.out or "").endswith(SUFFIX):
        raise LabError(f"--out {options.out}: allowed is a name that does not end with {SUFFIX}: that is a recording")
    try:
        urls = files(options.recordings)
    except (ValueError, ImportError) as error:
        raise LabError(str(error)) from error
    if not urls:
        raise LabError(f"{options.recordings}: no {SUFFIX} in it; `tormagctl record` makes them")
    with executors.chosen(options) as executor:
        summaries, reports, left_out = read_all(urls, executor)
    for name, reason in left_out.items():
        write_line(f"tormag-lab fleet: left out {printable(name)}: {printable(reason)}", sys.stderr)
    exit_code = 1 if left_out else 0
    try:
        if options.out is not None:
            write_parquet(summaries, options.out)
    except (OSError, ValueError, ImportError) as error:
        write_line(f"tormag-lab fleet: {printable(str(error))}", sys.stderr)
        exit_code = 2
    found = consoles(summaries.values(), reports.values())
    result = {"consoles": found, "recordings": summaries, "left_out": left_out}
    rows = (dict(zip(HEADINGS, _cells(console), strict=True)) for console in found)
    return Found(msgspec.to_builtins(result), table(rows), exit_code)
