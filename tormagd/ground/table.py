"""A table of quantities in a text file, as test machines, spreadsheets and programs write it.

The names stand in the last row above the numbers; a row of units may follow them. A unit is stated in the name ([mN],
(mN), _mN), in that row, or by a person; a column without one is refused. The text is UTF-8, UTF-16 with a byte order
mark, or else Windows' cp1252. A comma is decimal where some number of the table can mean nothing else.
"""

import codecs
import contextlib
import csv
import io
import itertools
import math
import re
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from tormagd.ground.files import read_bounded

MIN_ROWS: Final = 2
SAMPLE: Final = 1000
"Rows that may stand above the names; rows that show how cells are separated, and which mark is decimal."
LONGEST_NAME: Final = 200
"A longer heading names no unit: looking for one takes the square of its length."
ABSENT: Final = ("", "nan", "-")
"Cells without a value, in lower case."
COMMENT: Final = ("#", "%")


class Quantity(NamedTuple):
    """Names in lower case, single letters as they are, and factors to our unit; without units, any is taken."""

    names: tuple[str, ...]
    units: Mapping[str, float] = {}


CLOCK: Final = "h:m:s"
LENGTH: Final = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1e3, "in": 25.4}
FORCE: Final = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "kgf": 9.80665, "lbf": 4.4482216152605}
FIELD: Final = {"mT": 1.0, "T": 1e3, "uT": 1e-3, "G": 0.1, "kG": 100.0}
TIME: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, CLOCK: 1.0}
RATE: Final = {f"{unit}/s": factor for unit, factor in LENGTH.items()}
QUANTITIES: Final = {
    "force_N": Quantity(("force", "load", "kraft", "F"), FORCE),
    "field_mT": Quantity(("field", "flux density", "feld", "B"), FIELD),
    "rate_mm_s": Quantity(("rate", "speed", "velocity", "geschwindigkeit", "v"), RATE),
    "displacement_mm": Quantity(("displacement", "disp", "position", "travel", "weg", "x", "X"), LENGTH),
    "time_s": Quantity(("time", "elapsed time", "x_value", "zeit", "t"), TIME),
    "cip_percent": Quantity(("cip", "iron"), {"%": 1.0, "percent": 1.0}),
    "cycle": Quantity(("cycle", "run", "sweep")),
}

_UNITS = {unit for quantity in QUANTITIES.values() for unit in quantity.units}
_SPELLED = {spelled: unit for unit in _UNITS for spelled in (unit, unit.replace("/", "_"))}
_SPELLED |= {"sec": "s", "Sec": "s", "seconds": "s", "inch": "in"}
_HEADING = re.compile(
    rf"(.+?)(?:\s*[\[({{](.*)[\])}}]|(?:\s+in\s+|[ _,/]+)({'|'.join(map(re.escape, _SPELLED))}))", re.DOTALL
)
_SPACES = "'\u00a0\u202f "
_GROUPS = {mark: rf"\d{{1,3}}(?:[{other}{_SPACES}]\d{{3}})+" for mark, other in (".,", ",.")}
_GROUPED = {mark: re.compile(rf"[+-]?{groups}(?:[{mark}]\d*)?") for mark, groups in _GROUPS.items()}
_PROOF = {
    mark: re.compile(rf"(?![+-]?[1-9]\d{{0,2}}[{mark}]\d{{3}}$)[+-]?(?:\d*|{groups})[{mark}]\d*(?:[eE][+-]?\d+)?")
    for mark, groups in _GROUPS.items()
}
"Numbers whose mark cannot group thousands."
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)")
_NUMERIC = re.compile(rf"[+-]?[.,]?\d(?:[\d.,{_SPACES}]*[\d.])?(?:[eE][+-]?\d+)?|{_TIME_OF_DAY.pattern}")


class TableError(ValueError):
    """A table that cannot be read as meant: the message names file, row, column, value and remedy."""


class Wanted(NamedTuple):
    """What is read, what may be, a person's NAME[:UNIT] by quantity, and the options that state one."""

    needed: Mapping[str, Quantity]
    optional: Mapping[str, Quantity] = {}
    stated: Mapping[str, str] = {}
    option: Mapping[str, str] = {}


class Table(NamedTuple):
    values: dict[str, "array[float]"]
    "Columns of equal length by quantity, in our units."
    rows: "array[int]"
    "Where they stand in the file."
    taken: dict[str, str]
    "Column and unit by quantity."
    missing: list[int]
    "Rows without one of the values."
    told: list[str]
    "What was converted or left out."


class _Column(NamedTuple):
    place: int
    name: str
    unit: str
    factor: float


_Rows = Iterator[tuple[int, list[str]]]


def read_table(path: Path, wanted: Wanted, most_bytes: int) -> Table:
    """Read the wanted quantities of a file. Raises TableError."""
    text, told = _text(path, most_bytes)
    rows = _rows(text)
    try:
        header, columns, first = _header(path, rows, wanted, told)
        sample = [first, *itertools.islice(rows, SAMPLE)]
        mark = _mark(path, sample, {column.place for column in columns.values()})
        table = Table({name: array("d") for name in columns}, array("q"), {}, [], told)
        for line, cells in itertools.chain(sample, rows):
            _take(f"{path}: row {line}", line, cells, header, columns, mark, table)
    except csv.Error as error:
        raise TableError(f"{path}: not CSV: {error}; close its quotes, or save it anew as CSV") from error
    if len(table.rows) < MIN_ROWS:
        lacks = f" (row {table.missing[0]} lacks one)" if table.missing else ""
        raise TableError(f"{path}: {len(table.rows)} rows with all values{lacks}: allowed is at least {MIN_ROWS}")
    table.taken.update({name: f"{column.name} ({column.unit})" for name, column in columns.items()})
    told += [*_converted(header, columns), *(["its commas are decimal"] if mark == "," else [])]
    return table


def _converted(header: list[str], columns: Mapping[str, _Column]) -> Iterator[str]:
    """Yield what becomes of the columns, unless they are taken as they are."""
    for quantity, column in columns.items():
        if column.factor != 1.0:
            yield f"{quantity} is {column.factor:g} times {column.name!r}"
    places = {column.place for column in columns.values()}
    if others := [name for place, name in enumerate(header) if name and place not in places]:
        yield f"columns that are left out: {', '.join(others)[:200]}"


def _text(path: Path, most_bytes: int) -> tuple[str, list[str]]:
    """Return a file's text, and what is to be told of its encoding."""
    try:
        data = read_bounded(path, most_bytes)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from error
    is_utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16",) if is_utf_16 else ("utf-8-sig", "cp1252"):
        with contextlib.suppress(UnicodeDecodeError):
            if "\0" not in (text := data.decode(encoding)):
                return text, [] if encoding == "utf-8-sig" else [f"its text is {encoding}"]
    raise TableError(f"{path}: neither UTF-8 text nor UTF-16 with a byte order mark nor cp1252: save it as CSV UTF-8")


def _rows(text: str) -> _Rows:
    """Yield number and cells of each row that is not blank, comments among them."""
    first, _, rest = text.partition("\n")
    named = re.fullmatch(r'"?sep=(.)"?\s*', first)
    delimiter = named[1] if named else _delimiter(text[-100_000:].splitlines()[-SAMPLE:])
    lines: Iterator[str] = io.StringIO(f"\n{rest}" if named else text, newline="")
    if delimiter == " ":
        lines, delimiter = ("\t".join(line.split()) for line in lines), "\t"
    lines = (line.replace('"', "") if line.lstrip().startswith(COMMENT) else line for line in lines)
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    for row in reader:
        cells = [cell.strip(" '\t") for cell in row]
        if any(cells):
            yield reader.line_num, cells


def _delimiter(lines: list[str]) -> str:
    """Return what separates at least two numbers in most lines; before the comma, which may be decimal, the others."""

    def numbers(delimiter: str, line: str) -> int:
        cells = line.split() if delimiter == " " else next(csv.reader([line], delimiter=delimiter), [])
        return sum(_is_numeric(cell.strip()) for cell in cells)

    shown = {delimiter: sum(numbers(delimiter, line) > 1 for line in lines) for delimiter in ";\t| ,"}
    best = max(shown, key=shown.__getitem__)
    return best if shown[best] else ","


def _header(
    path: Path, rows: _Rows, wanted: Wanted, told: list[str]
) -> tuple[list[str], dict[str, _Column], tuple[int, list[str]]]:
    """Take rows until numbers stand below two wanted names; return the names, their columns and the first numbers."""
    above: list[tuple[int, list[str]]] = [(0, [])]
    nearest: tuple[list[str], list[str], list[str]] | None = None
    most, enough = -1, min(2, len(wanted.needed))
    for line, cells in itertools.islice(rows, SAMPLE):
        is_below = any(map(_is_numeric, cells)) > cells[0].startswith(COMMENT)
        for (at, header), units in ((above[-1], []), (above[0], above[-1][1])) if is_below else ():
            found = len([name for name in {**wanted.needed, **wanted.optional} if _places(header, name, wanted)])
            if found >= enough:
                told += [f"{at - 1} rows above the names are left out"][: at - 1]
                return header, _columns(path, header, units, cells, wanted), (line, cells)
            if found > most and len(header) > sum(map(_is_numeric, header)) + 1:
                nearest, most = (header, units, cells), found
        above = [*above[-1:], (line, [cell.lstrip("#% ") for cell in cells])]
    if nearest is not None:
        _columns(path, *nearest, wanted)
    names = ",".join(wanted.needed)
    raise TableError(f"{path}: no numbers stand right below a row of names: allowed is such a row, as {names}")


def _is_numeric(cell: str) -> bool:
    return _NUMERIC.fullmatch(cell) is not None


def _split(cell: str) -> tuple[str, str | None]:
    """Return a heading's name, in lower case if it is a word, and its unit as we spell it."""
    match = _HEADING.fullmatch(cell) if len(cell) <= LONGEST_NAME else None
    name, unit = (cell, None) if match is None else (match[1], match[3] if match[2] is None else match[2])
    return name if len(name) == 1 else name.lower(), _unit(unit)


def _unit(text: str | None) -> str | None:
    unit = (text or "").strip().replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    return None if unit in ABSENT else _SPELLED.get(unit, unit)


def _places(header: list[str], quantity: str, wanted: Wanted) -> list[int]:
    """Return where the names of a quantity stand, or the name that a person states for it."""
    known = {**wanted.needed, **wanted.optional}[quantity].names
    if (text := wanted.stated.get(quantity)) is None:
        return [place for place, cell in enumerate(header) if cell in known or _split(cell)[0] in known]
    if text in header:
        return [place for place, cell in enumerate(header) if cell == text]
    names = {text.lower(), text.rpartition(":")[0].lower()}
    return [place for place, cell in enumerate(header) if cell and names & {cell.lower(), _split(cell)[0].lower()}]


def _columns(path: Path, header: list[str], units: list[str], first: list[str], wanted: Wanted) -> dict[str, _Column]:
    """Return the column of each quantity, or refuse what lacks a name or a unit, all at once."""
    columns, wrong, remedies = {}, [], []
    for quantity, known in {**wanted.needed, **wanted.optional}.items():
        places = _places(header, quantity, wanted)
        if len(places) == 1:
            found = _column(places[0], quantity, known, header, units, first, wanted)
            if isinstance(found, _Column):
                columns[quantity] = found
                continue
        elif places:
            found = f"{header[places[0]]!r} and {header[places[1]]!r} may both be {quantity}"
        elif quantity in wanted.stated:
            found = f"no column is called {wanted.stated[quantity]!r}"
        elif quantity in wanted.needed:
            found = f"no column is {quantity} ({', '.join(known.names)})"
        else:
            continue
        wrong.append(found)
        name = header[places[0]] if len(places) == 1 else "NAME"
        remedies.append(
            f"{wanted.option[quantity]}{name}:UNIT" if quantity in wanted.option else f"the name {quantity}"
        )
    if wrong:
        there = ", ".join(filter(None, header))[:200]
        raise TableError(f"{path}: {'; '.join(wrong)}. Its columns are {there}: state {' and '.join(remedies)}")
    return columns


def _column(
    place: int, quantity: str, known: Quantity, header: list[str], units: list[str], first: list[str], wanted: Wanted
) -> _Column | str:
    """Return the column at a place, or why it cannot be this quantity."""
    name, text = header[place], wanted.stated.get(quantity, "")
    if not known.units:
        return _Column(place, name, "as it is", 1.0)
    said = _split(name)[1] or _unit("".join(units[place : place + 1])) or _clock("".join(first[place : place + 1]))
    stated = _unit(text.rpartition(":")[2]) if ":" in text and text != name else None
    unit = stated or said or ""
    if (factor := known.units.get(unit)) is None:
        what = f"has the unit {unit!r}" if unit else "states no unit"
        return f"{name!r} {what}: {quantity} is in {', '.join(known.units)}"
    if known.units.get(said or "", factor) != factor:
        return f"{name!r} is in {said} by its file, not in {unit}"
    return _Column(place, name, unit, factor)


def _clock(text: str) -> str | None:
    return CLOCK if _TIME_OF_DAY.fullmatch(text) else None


def _mark(path: Path, rows: list[tuple[int, list[str]]], places: set[int]) -> str:
    """Return the decimal mark of a table's numbers, and "" where no number shows which it is."""
    cells = [cell for _, row in rows for place, cell in enumerate(row) if place in places]
    proofs = {mark: next(filter(_PROOF[mark].fullmatch, cells), None) for mark in ".,"}
    if proofs["."] and proofs[","]:
        raise TableError(
            f"{path}: {proofs['.']!r} and {proofs[',']!r} use two decimal marks: use one in the whole file"
        )
    unclear = next((cell for cell in cells if "," in cell), None)
    if unclear and not any(proofs.values()):
        raise TableError(
            f"{path}: {unclear!r} may be a thousand or a fraction: save it without separators of thousands"
        )
    return next((mark for mark, proof in proofs.items() if proof), "")


def _take(
    where: str, line: int, cells: list[str], header: list[str], columns: Mapping[str, _Column], mark: str, table: Table
) -> None:
    """Append a row's values, or its number if one is missing."""
    if cells[0].startswith(COMMENT):
        return
    _require_width(where, cells, len(header), max(column.place for column in columns.values()))
    if any(cells[column.place].lower() in ABSENT for column in columns.values()):
        table.missing.append(line)
        return
    for quantity, column in columns.items():
        text = cells[column.place]
        value = _number(text, mark) * column.factor if ":" not in text else _seconds(text, column.unit)
        if not math.isfinite(value):
            raise TableError(f"{where}, {column.name} = {text[:40]!r}: allowed is a finite number")
        table.values[quantity].append(value)
    table.rows.append(line)


def _require_width(where: str, cells: list[str], width: int, last: int) -> None:
    """Refuse a row that ends before the `last` place, or has values without a name."""
    if len(cells) <= last or any(cells[width:]):
        hint = "; decimal commas need ; or tab between the values" if len(cells) > width else ""
        raise TableError(f"{where} has {len(cells)} values: allowed is {width}{hint}")


def _number(text: str, mark: str) -> float:
    if mark and _GROUPED[mark].fullmatch(text):
        text = re.sub(rf"[{_SPACES}{'.' if mark == ',' else ','}]", "", text)
    elif mark == "," and "." in text:
        return math.nan
    try:  # Python reads 1_5 as 15; a table means something else
        return math.nan if "_" in text else float(text.replace(",", ".") if mark == "," else text)
    except ValueError:
        return math.nan


def _seconds(text: str, unit: str) -> float:
    """Return a time of day in seconds, and not a number for any other text."""
    match = _TIME_OF_DAY.fullmatch(text)
    if match is None or unit != CLOCK:
        return math.nan
    return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3].replace(",", "."))
