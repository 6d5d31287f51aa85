"""Make training data of measured CSV files: find columns, units and signs, and say what was taken for what.

tormag-lab import-data FILE.csv ... --cip 40 --out rows.csv

Needed are force, field, and the rate, or time and displacement. Comments, a preamble, decimal commas and a row of units
are understood. The force becomes positive against the motion, and the displacement the travel since the handle turned,
up to 2 mm.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter

from tormag_lab.arrays import MAX_TABLE_BYTES, Array, Mask
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.pages import subplots
from tormag_lab.training.dataset import ALLOWED, Dataset, records, write_csv
from tormagd.element.model.displacement import MOBILISED_MM
from tormagd.ground.command_line import Within
from tormagd.ground.files import new_file
from tormagd.ground.table import MIN_ROWS, QUANTITIES, Table, Wanted, read_table

if TYPE_CHECKING:
    from tormagd.view.drawing import Figure

NEEDED, MOTION = ("force_N", "field_mT"), ("rate_mm_s", "time_s", "displacement_mm")
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
    parser.add_argument(
        "--cip", type=Within(0.0, 100.0, " %").__call__, metavar="PERCENT", help="iron, where no column has it"
    )
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="QUANTITY=NAME[:UNIT]",
        help=f"take this column; quantities are {', '.join(QUANTITIES)}",
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
    with new_file(options.out):
        write_csv(options.out, data)
    if options.picture is not None:
        from tormagd.view.plot import save_plot

        save_plot(_drawn(data, missing), options.picture, *options.files)
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


def _imported(path: Path, stated: Mapping[str, str], cip_percent: float | None, cycle: int | None) -> Imported:
    """Return the rows of a file as training data; `cip_percent` and `cycle` replace missing columns."""
    table = _read(path, stated)
    quantities = {name: np.array(values) for name, values in table.values.items()}
    if cip_percent is None and "cip_percent" not in quantities:
        raise LabError(f"{path}: no column has the share of iron; state it by --cip PERCENT")
    quantities, duplicates = _without_duplicates(quantities)
    force_N = quantities["force_N"]
    for name, value in (("cip_percent", cip_percent), ("cycle", cycle)):
        if value is not None and name not in quantities:
            quantities[name] = np.full(len(force_N), float(value))
    told, rate_mm_s = _rate(path, quantities)
    how, way = _sign(path, quantities, rate_mm_s)
    made = [*table.told, f"force_N {how}", *told, *_motion(quantities, rate_mm_s, way)]
    far = quantities["displacement_mm"] >= MOBILISED_MM  # where a handle turns, forces leap from row to row
    if far.any():
        far[far] = _outliers(path, quantities["force_N"][far])
    for name, values in quantities.items():
        least, most = ALLOWED[name]
        if not (values.min() >= least and values.max() <= most):
            seen = f"{name} from {values.min():g} to {values.max():g}"
            raise LabError(f"{path}: {seen}: allowed is {least:g}..{most:g}; is its unit another?")
    left_out = {"missing": len(table.missing), "duplicate": duplicates, "outlier": int(np.count_nonzero(far))}
    return Imported(Dataset.of(quantities).subset(~far), table.taken, made, left_out)


def _stated(text: str) -> tuple[str, str]:
    """Parse the option `QUANTITY=NAME[:UNIT]`."""
    quantity, _, column = text.partition("=")
    if quantity not in QUANTITIES or not column:
        known = "; ".join(f"{name} in {', '.join(each.units)}" for name, each in QUANTITIES.items() if each.units)
        raise LabError(f"--column {text[:80]}: allowed is QUANTITY=NAME[:UNIT] with {known}")
    return quantity, column


def _read(path: Path, stated: Mapping[str, str]) -> Table:
    needed = {name: QUANTITIES[name] for name in NEEDED}
    optional = {name: each for name, each in QUANTITIES.items() if name not in needed}
    option = {name: f"--column {name}=" for name in QUANTITIES}
    table = read_table(path, Wanted(needed, optional, stated, option), MAX_TABLE_BYTES)
    if "time_s" in table.values:
        _require_rising(path, table)
    return table


def _require_rising(path: Path, table: Table) -> None:
    time_s, cycle = table.values["time_s"], table.values.get("cycle")
    for place in range(1, len(table.rows)):
        if time_s[place] < time_s[place - 1] and (cycle is None or cycle[place] == cycle[place - 1]):
            raise LabError(
                f"{path}: row {table.rows[place]}: {table.taken['time_s']} falls after {time_s[place - 1]:g}; "
                "allowed is to rise, and to begin anew with each cycle, a column"
            )
    if min(rows.stop - rows.start for rows in records(np.array(time_s))) < MIN_ROWS:
        raise LabError(f"{path}: a cycle of one row; at least {MIN_ROWS} are needed")


def _without_duplicates(quantities: Mapping[str, Array]) -> tuple[dict[str, Array], int]:
    table = np.column_stack(list(quantities.values()))
    kept = np.sort(np.unique(table, axis=0, return_index=True)[1])
    return {name: values[kept] for name, values in quantities.items()}, len(table) - len(kept)


def _outliers(path: Path, force_N: Array) -> Mask:
    """Return a mask of the forces far from the median of their neighbours in time."""
    off_N = np.abs(force_N - median_filter(force_N, NEIGHBOURS, mode="nearest"))
    range_N = np.subtract(*np.percentile(force_N, (98.0, 2.0)))
    most_N = max(OUTLIER_SDS * 1.4826 * float(np.median(off_N)), OUTLIER_OF_RANGE * float(range_N))
    # rows of an unordered table jump everywhere, so neighbours name no outlier there
    far: Mask = (off_N > most_N) & (np.median(off_N) <= OUTLIER_OF_RANGE * range_N)
    if (share := float(far.mean())) > MAX_OUTLIERS:
        raise LabError(f"{path}: {share:.1%} of the forces are far from the next ones; allowed is {MAX_OUTLIERS:.0%}")
    return far


def _rate(path: Path, quantities: Mapping[str, Array]) -> tuple[list[str], Array]:
    """Return what was done to get the rate, and the rate with the sign that it has."""
    if (rate := quantities.get("rate_mm_s")) is not None:
        return [], rate
    place, time_s = quantities.get("displacement_mm"), quantities.get("time_s")
    if place is None or time_s is None:
        lacking = [name for name in MOTION if name not in quantities]
        known = " or ".join(f"{name} ({', '.join(QUANTITIES[name].names)})" for name in lacking)
        raise LabError(f"{path}: no column is {known}: needed is rate_mm_s, or time_s and displacement_mm")
    cycles = records(time_s)
    if min(float(np.diff(time_s[rows], prepend=-np.inf, append=np.inf).min()) for rows in cycles) <= 0.0:
        raise LabError(f"{path}: time_s stands still at some rows, and gives no rate there: state a column rate_mm_s")
    rates = [np.gradient(place[rows], time_s[rows]) for rows in cycles]
    return ["rate_mm_s from displacement_mm over time_s"], np.concatenate(rates)


def _sign(path: Path, quantities: dict[str, Array], rate: Array) -> tuple[str, Array]:
    """Make the force positive against the motion, in place; return what was done, and the motion's sign."""
    force_N, way = quantities["force_N"], np.sign(rate)
    loud = np.abs(force_N) > QUIET * np.abs(force_N).max()
    moving = loud & (np.abs(rate) > QUIET * np.abs(rate).max())
    for told, has_way, sign in (
        ("as it was", False, 1.0),
        ("turned round", False, -1.0),
        ("against the motion: it had the rate's sign", True, 1.0),
        ("against the motion: it had the rate's opposite sign", True, -1.0),
    ):
        rows, agrees_N = (moving, sign * way * force_N) if has_way else (loud, sign * force_N)
        if rows.any() and float(np.mean(agrees_N[rows] > 0.0)) >= SIGN_SHARE:
            if has_way:
                way = np.where(_turns(rate), sign * np.sign(force_N), way)
                agrees_N = sign * way * force_N
            quantities["force_N"] = agrees_N
            return told, way
    raise LabError(f"{path}: the force's sign follows neither the rate's nor one way; is something taken off it?")


def _turns(rate: Array) -> Mask:
    """Return a mask of the rows where the motion rests or turns: the rate's own sign says nothing, the force's does."""
    speed, back = np.abs(rate), np.sign(rate)
    fastest = maximum_filter1d(speed, 2 * NEIGHBOURS + 1, mode="nearest")
    turned = back[1:] != back[:-1]
    beside = np.concatenate([turned, [False]]) | np.concatenate([[False], turned])
    turning: Mask = beside | (speed <= QUIET * np.maximum(fastest, np.median(speed)))
    return turning


def _motion(quantities: dict[str, Array], rate: Array, way: Array) -> list[str]:
    """Make the rate a magnitude and the displacement the travel since the turn, and return what was done."""
    made = []
    place = quantities.get("displacement_mm")
    if place is None:
        quantities["displacement_mm"] = np.full(len(rate), MOBILISED_MM)
        made.append(f"displacement_mm = {MOBILISED_MM:g}: every row is taken as sliding")
    elif place.min() < 0.0 or place.max() > MOBILISED_MM:
        has_turned = np.diff(way, prepend=way[0]) != 0.0
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


def _drawn(data: Dataset, missing: list[str]) -> "Figure":
    figure, axes = subplots((8.0, 5.0))
    points = axes.scatter(data.features[:, 2], data.features[:, 1], c=data.force_N, s=6)
    title = "\n".join(missing) or "fields and rates are covered"
    axes.set(xlabel="field, mT", ylabel="rate, mm/s", yscale="log", title=title)
    figure.colorbar(points, label="force, N")
    return figure
