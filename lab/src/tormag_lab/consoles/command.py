"""How well many consoles followed, what held them back, and how their devices drift, from their recordings.

Workers read every `.mcap` in the folder, or under a URL that fsspec knows (`s3://bucket/recordings` takes the package
s3fs). Files that they cannot read are named. The table has a line for each device and insert; `--out` keeps a row for
each recording. `SERIAL.json` of `tormagctl commission` in the same place adds the day and what failed there.
"""

import argparse
import datetime
import os
import sys

import fsspec
import msgspec
import pyarrow
import pyarrow.parquet

from tormag_lab import executors
from tormag_lab.consoles.summary import SUFFIX, Console, Drift, Summary, consoles, files, read_all
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.told import table
from tormagd.commission.sequence import Report
from tormagd.ground.terminal import write_line
from tormagd_client.printable import printable

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
