"""Quantities over time in a file: a force that is sent, asked for or designed for, or a hand's motion."""

from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from tormagd.ground.table import FORCE, QUANTITIES, Quantity, Table, TableError, Wanted, read_table
from tormagd_client.messages import AROUND_ZERO_N, MAX_DISPLACEMENT_MM, MAX_FORCE_N, MAX_RATE_MM_S, NO_PUSH

OPTIONAL_COLUMNS = ("displacement_mm", "rate_mm_s")
ALLOWED = {
    "time_s": (-1e10, 1e10, "s"),  # seconds since 1970 are allowed
    "force_N": (0.0, MAX_FORCE_N, "N"),
    "displacement_mm": (0.0, MAX_DISPLACEMENT_MM, "mm"),
    "rate_mm_s": (-MAX_RATE_MM_S, MAX_RATE_MM_S, "mm/s"),
}
"Least, most and unit of each quantity."
LEAST_STEP_S: Final = 1e-9
MAX_FILE_BYTES: Final = 16_000_000
"Over a quarter of an hour at 1 kHz."
OPTIONS: Final = {"time_s": "--time-column ", "force_N": "--column "}


def stated_columns(force: str | None, time: str | None) -> dict[str, str]:
    """Return the columns that a person states, by quantity."""
    return {name: text for name, text in (("force_N", force), ("time_s", time)) if text is not None}


def read_forces(path: Path, stated: Mapping[str, str] | None = None) -> Table:
    """Read times and forces, and the OPTIONAL_COLUMNS that the file has by these names; None: nobody can state any."""
    table = _read(path, FORCE, stated)
    forces_N = table.values["force_N"]
    under = [place for place, force_N in enumerate(forces_N) if -AROUND_ZERO_N <= force_N < 0.0]
    for place in under:
        forces_N[place] = 0.0
    if under:
        table.told.append(f"{len(under)} forces within {AROUND_ZERO_N * 1e3:g} mN under 0 are taken as 0")
    _require(path, table, ALLOWED)
    return table


def read_column(path: Path, stated: Mapping[str, str], *, has_unit: bool) -> Table:
    """Read times and one column, in newtons if it `has_unit`, else as it is."""
    table = _read(path, FORCE if has_unit else {}, stated)
    _require(path, table, {"time_s": ALLOWED["time_s"], "force_N": (-1e9, 1e9, "")})
    return table


def _read(path: Path, units: Mapping[str, float], stated: Mapping[str, str] | None) -> Table:
    needed = {"time_s": QUANTITIES["time_s"], "force_N": QUANTITIES["force_N"]._replace(units=units)}
    optional = {name: Quantity((name,)) for name in OPTIONAL_COLUMNS}
    wanted = Wanted(needed, optional, stated or {}, {} if stated is None else OPTIONS)
    return read_table(path, wanted, MAX_FILE_BYTES)


def read_motion(path: Path) -> tuple["array[float]", "array[float]"]:
    """Read times, s, and positions, mm."""
    table = read_table(path, Wanted({name: QUANTITIES[name] for name in ("time_s", "displacement_mm")}), MAX_FILE_BYTES)
    _require(path, table, {"time_s": ALLOWED["time_s"], "displacement_mm": (-1e6, 1e6, "mm")})
    return table.values["time_s"], table.values["displacement_mm"]


def _require(path: Path, table: Table, allowed: Mapping[str, tuple[float, float, str]]) -> None:
    """Refuse a row that lacks a value, is out of range or does not follow the row before."""
    if table.missing:
        raise TableError(f"{path}: row {table.missing[0]} lacks a value: fill it in, or delete the row")
    for name, values in table.values.items():
        least, most, unit = allowed.get(name, ALLOWED[name])
        for row, value in zip(table.rows, values, strict=True):
            if not least <= value <= most:
                why = f"; {NO_PUSH}" if unit == "N" and value < least else ""
                raise TableError(f"{path}: row {row}, {name} = {value:g}: allowed is {least:g}..{most:g} {unit}{why}")
    times_s, rows = table.values["time_s"], table.rows
    for place in range(1, len(rows)):
        if times_s[place] - times_s[place - 1] < LEAST_STEP_S:
            raise TableError(
                f"{path}: row {rows[place]}, time_s = {times_s[place]:g}: allowed is above the row before, "
                f"{times_s[place - 1]:g}, by {LEAST_STEP_S:g} s or more"
            )
