"""The rows of the risk page: one of each fault, limit, cause without a code, and check of the conformance kit."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from fault_matrix.cases import MATRIX

from firmware_protocol.conformance.check import Hazard
from firmware_protocol.conformance.examination import CHECKS
from risk.named_tests import Named
from tormagd.control.safety.codes import FAULTS, LIMITS, Explanation
from tormagd.control.safety.hazards import CAUSES, FAULTS_OF, HARMLESS, LIMITS_OF
from tormagd.ground.toml_file import convert

VERDICTS = ("named", "safe", "in_time", "recovered")
KIT = "firmware_protocol/test_conformance.py"
WORDED = "tools/test_faults.py"
"Tests that call codes by words, as the matrix does."
Text = Annotated[str, msgspec.Meta(max_length=60)]


class Judged(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A person's judgement of a row, by a scale of their own; empty: nothing yet."""

    severity: Text = ""
    probability: Text = ""


class Row(NamedTuple):
    """One row. What is empty of hazard, control, code, tests and evidence is missing."""

    name: str
    hazard: Hazard | None
    cause: str
    control: str
    code: str
    tests: str
    evidence: str
    judged: Judged = Judged()

    @property
    def missing(self) -> tuple[str, ...]:
        return tuple(name for name in ("hazard", "control", "code", "tests", "evidence") if not getattr(self, name))


def rows(named: Named, cells: Sequence[Mapping[str, Any]], judged: Mapping[str, Judged]) -> list[Row]:
    told = _told(cells)
    made = [*_of_codes("fault", FAULTS_OF, FAULTS, named, told), *_of_codes("limit", LIMITS_OF, LIMITS, named, told)]
    made += [*_of_causes(named, told), *_of_kit(named)]
    if unknown := judged.keys() - {row.name for row in made}:
        raise ValueError(f"{min(unknown)}: no row of the risk page has this name; take it out, or rename it")
    return [row._replace(judged=judged.get(row.name, row.judged)) for row in made]


def judgement(path: Path) -> dict[str, Judged]:
    tables = convert(path, dict[str, dict[str, Judged]])
    return {f"{kind}.{name}": judged for kind, table in tables.items() for name, judged in table.items()}


def _told(cells: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """Return how many held cells show each present row of the matrix, and each code that they were to show."""
    told: Counter[str] = Counter()
    known = {injection.name for injection in MATRIX}
    for cell in cells:
        if cell["fault"] in known and all(cell[verdict] for verdict in VERDICTS):
            wanted = {name.replace("device:", "DEVICE_") for name in cell["must_be_named"]}
            faults = {*cell["host_faults"], *(f"DEVICE_{name}" for name in cell["device_faults"])}
            told.update(f"fault.{name}" for name in faults & wanted)
            told.update(f"limit.{name}" for name in wanted.intersection(cell["limits"]))
            told[cell["fault"]] += 1
    return told


def _of_codes(
    kind: str, hazards: Mapping[Hazard, str], table: Mapping[Any, Explanation], named: Named, told: Counter[str]
) -> Iterator[Row]:
    of_code = {name: hazard for hazard, names in hazards.items() for name in names.split()}
    for code in dict.fromkeys((*of_code, *(str(code) for code in table if code not in HARMLESS.split()))):
        name, row = f"{kind}.{code}", table.get(code)
        files = named.get(name, Counter[str]()).copy()
        if code not in FAULTS or code not in LIMITS:  # otherwise a word may mean either
            files[WORDED] += named.get(code, Counter())[WORDED]
        tests, evidence, hazard = _listed(files), _in_cells(told[name]), of_code.get(code)
        if row is None:
            yield Row(name, hazard, "", "", "", tests, evidence)
        else:
            shows = "" if row.shows == "at once" else f", {row.shows}"
            control = f"{row.reaction} within {row.safe_ms:,.0f} ms{shows}"
            yield Row(name, hazard, row.cause, control, code, tests, evidence)


def _of_causes(named: Named, told: Counter[str]) -> Iterator[Row]:
    for each in CAUSES:
        tests = _listed(named.get(each.test or "no test", {}))
        yield Row(f"cause.{each.name}", each.hazard, each.cause, each.control, "-", tests, _in_cells(told[each.cell]))


def _of_kit(named: Named) -> Iterator[Row]:
    """Yield the rows of the kit's checks; their tests plant the error that they must find, which is the evidence."""
    for check in CHECKS:
        tests = KIT if KIT in named.get(check.name, ()) else ""
        evidence = "planted error found" if tests else ""
        yield Row(
            f"kit.{check.name}", check.hazard, f"not kept: {check.page}", check.expected, check.name, tests, evidence
        )


def _listed(files: Mapping[str, int]) -> str:
    return ", ".join(f"{file} ({count})" if count > 1 else file for file, count in sorted(files.items()) if count)


def _in_cells(count: int) -> str:
    return "" if count == 0 else "1 cell" if count == 1 else f"{count} cells"
