"""Make training data of measured CSV files: find columns, units and signs, and say what was taken for what.

tormag-lab import-data FILE.csv ... --cip 40 --out rows.csv

Needed are force, field, and the rate, or time and displacement. Comments, a preamble, decimal commas and a row of units
are understood. The force becomes positive against the motion, and the displacement the travel since the handle turned,
up to 2 mm.
"""

import argparse
import csv
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tormagd.element.model.displacement import MOBILISED_MM
from tormagd.ground.files import read_bounded
from tormagd.lab.arrays import Array, Mask
from tormagd.lab.errors import LabError
from tormagd.lab.main import Found, within
from tormagd.lab.pages import subplots
from tormagd.lab.training.dataset import ALLOWED, Dataset, records, write_csv

MAX_FILE_BYTES = 1 << 28
LENGTH = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1e3}
UNITS = {
    "force_N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "field_mT": {"mT": 1.0, "T": 1e3, "G": 0.1},
    "rate_mm_s": {f"{unit}/s": factor for unit, factor in LENGTH.items()},
    "displacement_mm": LENGTH,
    "time_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "cip_percent": {"%": 1.0, "percent": 1.0},
    "cycle": {"": 1.0},
}
"Factors to our units; a file that states no unit has the first."
NAMES = {
    "force_N": ("force", "load", "f"),
    "field_mT": ("field", "flux density", "b"),
    "rate_mm_s": ("rate", "speed", "velocity", "v"),
    "displacement_mm": ("displacement", "position", "travel", "x"),
    "time_s": ("time", "t"),
    "cip_percent": ("cip", "iron"),
    "cycle": ("cycle", "run", "sweep"),
}
MIN_NAMED = 2
"A row with so many known names is the header."
ABSENT = ("", "nan", "-")
"Cells without a value, in lower case."
MIN_ROWS = 2
MIN_FIELD_MT = 5.0
"A smaller maximum without a stated unit is more likely in tesla."
SIGN_SHARE = 0.95
"Least share of the rows beyond the noise that agree on the force's sign."
QUIET = 0.05
"A sign is noise below this share of the greatest force or rate."
OUTLIER_SDS, OUTLIER_OF_RANGE = 12.0, 0.05
"An outlier is so far from its neighbours' median: in their deviations, and in the range of forces."
NEIGHBOURS = 5
MAX_OUTLIERS = 0.02
GAP_OF_RANGE = 0.25
"A gap of this share of the range, of rates on a logarithmic scale, is missing data."
RATES_MM_S = (0.5, 300.0)


class Column(NamedTuple):
    name: str
    unit: str
    factor: float
    "From its unit to ours."
    has_unit: bool


Stated = tuple[str, str | None]
"A column's name and unit, as a person states them; None is the usual unit."


class Imported(NamedTuple):
    data: Dataset
    taken: dict[str, str]
    "Column and unit, by quantity."
    made: list[str]
    "What was turned round or computed, in words."
    left_out: dict[str, int]
    "Rows by reason."


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.csv", help="several are one cycle each")
    parser.add_argument("--out", type=Path, required=True, metavar="ROWS.csv", help="for train-model, a new file")
    parser.add_argument("--cip", type=within(0.0, 100.0, "%"), metavar="PERCENT", help="iron, where no column has it")
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="QUANTITY=NAME[:UNIT]",
        help=f"take this column; quantities are {', '.join(UNITS)}",
    )
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw what is there and what is missing")


def run(options: argparse.Namespace) -> Found:
    if options.out.exists():
        raise LabError(f"{options.out} exists; allowed is a new file")
    if options.picture is not None and options.picture.suffix != ".png":
        raise LabError(f"--picture {options.picture}: allowed is a name that ends with .png")
    stated = dict(_stated(text) for text in options.column)
    parts: list[Imported] = []
    for cycle, path in enumerate(options.files):
        part = _imported(path, stated, options.cip, cycle if len(options.files) > 1 else None)
        if parts and part.taken != parts[0].taken:
            raise LabError(f"{path}: its columns are not taken as those of {options.files[0]}: {part.taken}")
        parts.append(part)
    columns = [part.data.columns() for part in parts]
    data = Dataset.of({name: np.concatenate([each[name] for each in columns]) for name in columns[0]})
    missing = _missing(data)
    write_csv(options.out, data)
    if options.picture is not None:
        _draw(options.picture, data, missing)
    return Found(
        {
            "out": str(options.out),
            "rows": len(data),
            "taken": parts[0].taken,
            "made": sorted({told for part in parts for told in part.made}),
            "left_out": {why: sum(part.left_out[why] for part in parts) for why in parts[0].left_out},
            "ranges": data.ranges(),
            "missing": missing,
        }
    )


def _imported(path: Path, stated: Mapping[str, Stated], cip_percent: float | None, cycle: int | None) -> Imported:
    """Return the rows of a file as training data; `cip_percent` and `cycle` replace missing columns."""
    columns, quantities, missing = _read(path, stated)
    if cip_percent is None and "cip_percent" not in quantities:
        raise LabError(f"{path}: no column has the share of iron; state it by --cip PERCENT")
    quantities, duplicates = _without_duplicates(quantities)
    force_N = quantities["force_N"]
    for name, value in (("cip_percent", cip_percent), ("cycle", cycle)):
        if value is not None and name not in quantities:
            quantities[name] = np.full(len(force_N), float(value))
    made = [f"force_N {_sign(path, quantities)}", *_motion(path, quantities)]
    far = quantities["displacement_mm"] >= MOBILISED_MM  # where a handle turns, forces leap from row to row
    if far.any():
        far[far] = _outliers(path, quantities["force_N"][far])
    for name, values in quantities.items():
        least, most = ALLOWED[name]
        if not (values.min() >= least and values.max() <= most):
            seen = f"{name} from {values.min():g} to {values.max():g}"
            raise LabError(f"{path}: {seen}: allowed is {least:g}..{most:g}; is its unit another?")
    left_out = {"missing": missing, "duplicate": duplicates, "outlier": int(np.count_nonzero(far))}
    taken = {name: f"{column.name} ({column.unit})" for name, column in columns.items()}
    return Imported(Dataset.of(quantities).subset(~far), taken, made, left_out)


def _stated(text: str) -> tuple[str, Stated]:
    """Parse the option `QUANTITY=NAME[:UNIT]`."""
    quantity, equals, column = text.partition("=")
    name, colon, unit = column.rpartition(":")
    if not colon:
        name, unit = column, ""
    if quantity not in UNITS or not equals or (colon and unit not in UNITS[quantity]):
        known = "; ".join(f"{each} in {', '.join(units)}" for each, units in UNITS.items() if each != "cycle")
        raise LabError(f"--column {text[:80]}: allowed is QUANTITY=NAME[:UNIT] with {known}")
    return quantity, (name, unit or None)


def _read(path: Path, stated: Mapping[str, Stated]) -> tuple[dict[str, Column], dict[str, Array], int]:
    """Return columns and values by quantity, in our units, and how many rows lacked one."""
    rows = _rows(path)
    header, columns = _header(path, rows, stated)
    places = {name: header.index(column.name) for name, column in columns.items()}
    values: dict[str, list[float]] = {name: [] for name in columns}
    missing = 0
    for line, row in rows:
        if len(row) != len(header):
            told = f"{len(row)} values, {len(header)} columns; decimal commas need ; or tab between cells"
            raise LabError(f"{path}: row {line}: {told}")
        cells = {name: row[place] for name, place in places.items()}
        numbers = {name: _number(cell) for name, cell in cells.items()}
        if any(cell.lower() in ABSENT for cell in cells.values()):
            missing += 1
        elif not values["force_N"] and set(numbers.values()) == {None}:  # a row of units
            named = _columns(path, [f"{name} [{unit}]" for name, unit in zip(header, row, strict=True)], stated)
            columns = {name: column._replace(name=columns[name].name) for name, column in named.items()}
        else:
            for name, number in numbers.items():
                if number is None:
                    raise LabError(f"{path}: row {line}, {columns[name].name}: {cells[name][:40]!r} is no number")
                values[name].append(number * columns[name].factor)
    if len(values["force_N"]) < MIN_ROWS:
        raise LabError(f"{path}: {len(values['force_N'])} rows; at least {MIN_ROWS} are needed")
    found = {name: np.array(column) for name, column in values.items()}
    _refuse_unlikely(path, columns, found)
    return columns, found, missing


def _header(
    path: Path, rows: Iterator[tuple[int, list[str]]], stated: Mapping[str, Stated]
) -> tuple[list[str], dict[str, Column]]:
    """Take rows until one names MIN_NAMED quantities, and return its cells and the columns."""
    header: list[str] = []
    columns: dict[str, Column] = {}
    for _, header in rows:
        columns = _columns(path, header, stated)
        if len(columns) >= MIN_NAMED:
            break
    if lacking := [f"{name} ({', '.join(NAMES[name])})" for name in ("force_N", "field_mT") if name not in columns]:
        there = ", ".join(header)[:200]
        raise LabError(f"{path}: no column is {' or '.join(lacking)}; its columns are {there}: state --column")
    return header, columns


def _refuse_unlikely(path: Path, columns: Mapping[str, Column], found: Mapping[str, Array]) -> None:
    """Refuse fields that are likely in tesla, and a time that falls within a cycle."""
    field, most_mT = columns["field_mT"], found["field_mT"].max()
    if not field.has_unit and most_mT < MIN_FIELD_MT:
        raise LabError(
            f"{path}: {field.name} has no unit and is {most_mT:g} at most; state --column field_mT={field.name}:T if "
            "these are tesla, :mT if not"
        )
    if "time_s" not in found:
        return
    fallen = np.flatnonzero(np.diff(found["time_s"]) < 0.0)
    for place in fallen[np.diff(found.get("cycle", found["time_s"] * 0.0))[fallen] == 0.0][:1]:
        before_s = found["time_s"][place]
        raise LabError(
            f"{path}: {columns['time_s'].name} falls after {before_s:g} s; allowed is to rise, and to begin anew with "
            "each cycle, a column"
        )
    if min(rows.stop - rows.start for rows in records(found["time_s"])) < MIN_ROWS:
        raise LabError(f"{path}: a cycle of one row; at least {MIN_ROWS} are needed")


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield each row's line number and cells, without comments and empty rows."""
    try:
        text = read_bounded(path, MAX_FILE_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise LabError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise LabError(f"{path}: not a text file in UTF-8 ({error.reason} at byte {error.start})") from error
    numbered = enumerate(text.splitlines(), 1)
    lines = [(line, row) for line, row in numbered if row.strip() and row.lstrip()[0] not in "#%"]
    # a decimal comma may be as frequent as the semicolon beside it
    delimiter = max((";", "\t", ","), key=lambda each: sum(each in row for _, row in lines))
    for line, row in lines:
        [cells] = csv.reader([row], delimiter=delimiter)
        yield line, [cell.strip() if delimiter == "," else cell.strip().replace(",", ".") for cell in cells]


def _columns(path: Path, header: list[str], stated: Mapping[str, Stated]) -> dict[str, Column]:
    found: dict[str, Column] = {}
    for cell in header:
        match = re.fullmatch(r"([A-Za-z ]+?)[ _]*(?:[\[(](.*)[\])]|_([A-Za-z_/%]+))?", cell)
        name = "" if match is None else match[1].strip().lower()
        quantity = next((each for each, names in NAMES.items() if name in names), None)
        if match is None or quantity is None or quantity in stated:
            continue
        if quantity in found:
            raise LabError(f"{path}: {found[quantity].name!r} and {cell!r} may both be {quantity}: state --column")
        unit = (match[2] or match[3] or "").strip().replace("_s", "/s").replace("\N{MICRO SIGN}", "u")
        found[quantity] = _column(path, quantity, cell, unit or None)
    for quantity, (name, unit) in stated.items():
        if name in header:
            found[quantity] = _column(path, quantity, name, unit)
        elif len(found) >= MIN_NAMED:
            raise LabError(f"{path}: no column {name!r} for {quantity}; there are {', '.join(header)[:200]}")
    return found


def _column(path: Path, quantity: str, name: str, unit: str | None) -> Column:
    units = UNITS[quantity]
    taken = next(iter(units)) if unit is None else unit
    if taken not in units:
        raise LabError(f"{path}: column {name!r}: unit {taken!r} of {quantity} is not known, only {', '.join(units)}")
    return Column(name, taken, units[taken], unit is not None)


def _number(text: str) -> float | None:
    try:
        number = np.nan if "_" in text else float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _without_duplicates(quantities: Mapping[str, Array]) -> tuple[dict[str, Array], int]:
    table = np.column_stack(list(quantities.values()))
    kept = np.sort(np.unique(table, axis=0, return_index=True)[1])
    return {name: values[kept] for name, values in quantities.items()}, len(table) - len(kept)


def _outliers(path: Path, force_N: Array) -> Mask:
    """Return a mask of the forces far from the median of their neighbours in time."""
    half = NEIGHBOURS // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(force_N, half, mode="edge"), NEIGHBOURS)
    off_N = np.abs(force_N - np.median(around, axis=1))
    range_N = np.subtract(*np.percentile(force_N, (98.0, 2.0)))
    most_N = max(OUTLIER_SDS * 1.4826 * float(np.median(off_N)), OUTLIER_OF_RANGE * float(range_N))
    # rows of an unordered table jump everywhere, so neighbours name no outlier there
    far: Mask = (off_N > most_N) & (np.median(off_N) <= OUTLIER_OF_RANGE * range_N)
    if (share := float(far.mean())) > MAX_OUTLIERS:
        raise LabError(f"{path}: {share:.1%} of the forces are far from the next ones; allowed is {MAX_OUTLIERS:.0%}")
    return far


def _sign(path: Path, quantities: dict[str, Array]) -> str:
    """Make the force positive against the motion, in place, and return what was done."""
    force_N, rate = quantities["force_N"], quantities.get("rate_mm_s")
    if rate is None:
        rate = np.gradient(quantities["displacement_mm"]) if "displacement_mm" in quantities else np.ones(len(force_N))
    loud = np.abs(force_N) > QUIET * np.abs(force_N).max()
    moving = loud & (np.abs(rate) > QUIET * np.abs(rate).max())
    for told, way, rows in (
        ("as it was", np.ones(len(force_N)), loud),
        ("turned round", -np.ones(len(force_N)), loud),
        ("against the motion: it had the rate's sign", np.sign(rate), moving),
        ("against the motion: it had the rate's opposite sign", -np.sign(rate), moving),
    ):
        if rows.any() and float(np.mean(force_N[rows] * way[rows] > 0.0)) >= SIGN_SHARE:
            quantities["force_N"] = force_N * np.where(way == 0.0, 1.0, way)
            return told
    raise LabError(f"{path}: the force's sign follows neither the rate's nor one way; is something taken off it?")


def _motion(path: Path, quantities: dict[str, Array]) -> list[str]:
    """Make the rate a magnitude and the displacement the travel since the turn, and return what was done."""
    made = []
    place, time_s = quantities.get("displacement_mm"), quantities.get("time_s")
    if "rate_mm_s" not in quantities:
        if place is None or time_s is None:
            raise LabError(f"{path}: no column is rate_mm_s; needed is that, or time_s and displacement_mm")
        rates = [np.gradient(place[rows], time_s[rows]) for rows in records(time_s)]
        quantities["rate_mm_s"] = np.concatenate(rates)
        made.append("rate_mm_s from displacement_mm over time_s")
    rate = quantities["rate_mm_s"]
    if place is None:
        quantities["displacement_mm"] = np.full(len(rate), MOBILISED_MM)
        made.append(f"displacement_mm = {MOBILISED_MM:g}: every row is taken as sliding")
    elif place.min() < 0.0 or place.max() > MOBILISED_MM:
        has_turned = np.diff(np.sign(rate), prepend=np.sign(rate[0])) != 0.0
        begins = np.maximum.accumulate(np.where(has_turned, np.arange(len(rate)), 0))
        quantities["displacement_mm"] = np.minimum(np.abs(place - place[begins]), MOBILISED_MM)
        made.append("displacement_mm from positions: travel since the last turn")
    quantities["rate_mm_s"] = np.abs(rate)
    return made


def _missing(data: Dataset) -> list[str]:
    """Return in words the gaps in field and rate, and the missing ends of what a handle meets."""
    fields_mT = np.unique(data.features[:, 2])
    rates = np.log10(np.unique(np.clip(data.features[:, 1], RATES_MM_S[0], None)))
    missing = []
    for name, values, shown in (("field_mT", fields_mT, fields_mT), ("rate_mm_s", rates, 10.0**rates)):
        gaps = np.diff(values)
        if not gaps.size:
            missing.append(f"no {name} but {shown[0]:.3g}")
        elif gaps.max() > GAP_OF_RANGE * (values[-1] - values[0]):
            widest = int(gaps.argmax())
            missing.append(f"no {name} between {shown[widest]:.3g} and {shown[widest + 1]:.3g}")
    least, most = float(data.features[:, 1].min()), float(data.features[:, 1].max())
    if least > 2.0 * RATES_MM_S[0]:
        missing.append(f"no rate_mm_s below {least:.3g} mm/s: a model is asked down to {RATES_MM_S[0]:g}")
    if most < RATES_MM_S[1] / 2.0:
        missing.append(f"no rate_mm_s above {most:.3g} mm/s: a scene with a faster handle is refused")
    return missing


def _draw(path: Path, data: Dataset, missing: list[str]) -> None:
    figure, axes = subplots((8.0, 5.0))
    points = axes.scatter(data.features[:, 2], data.features[:, 1], c=data.force_N, s=6)
    title = "\n".join(missing) or "fields and rates are covered"
    axes.set(xlabel="field, mT", ylabel="rate, mm/s", yscale="log", title=title)
    figure.colorbar(points, label="force, N")
    figure.savefig(path, dpi=90)
