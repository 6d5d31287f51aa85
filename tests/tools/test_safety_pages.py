"""The pages that are made of tables and of evidence are up to date."""

import json
import re
from pathlib import Path

import pytest
import safety_pages
from judge import risk
from judge.injections import MATRIX
from judge.risk import named_tests, page as risk_page, red_rows

from tormagd.control.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.control.safety.operating_state import ROWS, OperatingState, Refusal
from tormagd.scenes.scene import load_scene

RECORD = json.loads(safety_pages.EVIDENCE.read_text(encoding="utf-8"))
CELLS = RECORD["figures"]["cells"]
RISKS = safety_pages.risk_rows(RECORD)
RED = """
fault: PLAN_FAILED FOLLOWING_ERROR NOT_FINITE DEVICE_UNCOMMANDED_MOTION DEVICE_SCHEMA_MISMATCH DEVICE_HOMING_FAILED SKEW
limit: CEILING TAKEOVER DEVICE_SILENT SOURCE_LOSS SOURCE_SELDOM SOURCE_LATE SOURCE_JITTER LOW_CONFIDENCE TRIM
limit: MODEL_RANGE SENSOR_ZERO OFFSET_UNKNOWN
cause: no_supply flood turns_round homes_shut worn_out scale real_device
kit: overcurrent retract_failed uncommanded_motion supply temperature watchdog
"""
"No cell of the matrix, nothing that can be done, or a check that takes a bench."


@pytest.mark.parametrize(
    ("page", "expected"),
    [
        (safety_pages.STATES, safety_pages.states_page()),
        (safety_pages.MATRIX, safety_pages.matrix_page(RECORD)),
        (safety_pages.RISK, risk_page(RISKS)),
    ],
    ids=["of the tables", "of the evidence", "of both and the tests"],
)
def test_a_page_is_that_of_what_it_is_made_of(page: Path, expected: str) -> None:
    assert page.read_text(encoding="utf-8") == expected, "python tools/safety_pages.py writes it anew"


def test_the_page_of_states_has_every_code_and_every_event() -> None:
    page = safety_pages.states_page()
    for code, row in (*FAULTS.items(), *LIMITS.items()):
        assert f"| `{code}` | {row.cause} | {row.reaction} |" in page
    assert [code for code in (*Fault, *Limit) if f"`{code}`" not in page] == []
    leads = {
        event: cells.split(" | ") for event, cells in re.findall(r"^\| [`*](.+?)[`*] \| (.+)$", page, re.MULTILINE)
    }
    for each in ROWS:
        expected = f"`{each.code}`" if isinstance(each, Refusal) else each.target
        assert dict(zip(OperatingState, leads[each.event], strict=False))[each.source] == expected


def test_the_evidence_is_of_the_matrix_that_there_is() -> None:
    expected = {(item.name, bus): item for item in MATRIX for bus in item.buses}
    known = {(cell["fault"], cell["bus"]): cell for cell in CELLS}
    assert set(known) == set(expected)
    for place, item in expected.items():
        cell = known[place]
        assert (cell["expected"], tuple(cell["must_be_named"])) == (item.safe, item.names)


@pytest.mark.parametrize("verdict", ["named", "safe", "in_time", "recovered"])
def test_every_cell_of_the_evidence_held(verdict: str) -> None:
    assert [f"{cell['fault']} on {cell['bus']}" for cell in CELLS if not cell[verdict]] == []


def test_no_cell_loses_a_force_faster_than_the_scene_allows() -> None:
    assert max(cell["loss_N_s"] for cell in CELLS) <= load_scene("coronary").force.most_release_N_s


def test_what_is_seen_at_once_is_stated_so() -> None:
    at_once = (Fault.LINK_LOST, Fault.HOST_STALL, Fault.DEVICE_COMMAND_TIMEOUT)
    assert {FAULTS[fault].safe_ms for fault in at_once} == {51.0}
    late = [code for code, row in FAULTS.items() if row.safe_ms > 100.0 and row.shows.startswith("at once")]
    assert late == [Fault.SENSE_STALE, Fault.STATUS_STALE], "streams that are missed after 100 ms of nothing"


def test_no_row_is_red_but_those_that_are_known() -> None:
    kinds = (line.split(": ") for line in RED.split("\n") if line)
    known = {f"{kind}.{name}" for kind, names in kinds for name in names.split()}
    red = red_rows(RISKS)
    assert {name: red.get(name, "no more") for name in red.keys() ^ known} == {}


def test_a_row_that_loses_what_it_is_made_of_turns_red(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = Fault.DEVICE_SKEW
    monkeypatch.setattr(risk, "FAULTS", {code: row for code, row in FAULTS.items() if code is not gone})
    unstated = {code: row._replace(hazard="") for code, row in LIMITS.items() if row.hazard != "NONE"}
    monkeypatch.setattr(risk, "LIMITS", LIMITS | unstated)
    monkeypatch.setattr(risk, "MATRIX", [row for row in MATRIX if row.device != "overheated"])
    named = named_tests(safety_pages.ROOT / "tests")
    red = red_rows(risk.rows(named, [cell | {"safe": "CLOCK" not in cell["limits"]} for cell in CELLS], {}))
    assert (red[f"fault.{gone}"], red["fault.DEVICE_TEMPERATURE"], red["limit.CLOCK"], red["limit.STALE"]) == (
        ("hazard", "control", "code"),
        ("evidence",),
        ("hazard", "evidence"),
        ("hazard",),
    )
    assert red_rows(risk.rows({}, CELLS, {})).keys() == {row.name for row in RISKS}, "without any test"


def test_a_file_names_what_it_says_outside_its_docstrings(tmp_path: Path) -> None:
    test = tmp_path / "daemon" / "test_one.py"
    test.parent.mkdir()
    test.write_text(
        "NAMES = [Fault.SKEW, 'no CLOCK']\n\n\ndef test_a():\n    'Not OUT_OF_STROKE.'\n    return Limit.RATE\n"
    )
    named = named_tests(tmp_path)
    for name in ("fault.SKEW", "CLOCK", "limit.RATE", "daemon/test_one.py::test_a"):
        assert named[name] == {"daemon/test_one.py"}
    assert "OUT_OF_STROKE" not in named


def test_a_person_judges_rows_that_there_are(tmp_path: Path) -> None:
    judged = tmp_path / "risk.toml"
    judged.write_text("[fault.SKEW]\nseverity = 'minor <1>'\n")
    assert "<td>minor &lt;1&gt;</td><td></td></tr>" in risk_page(risk.rows({}, [], risk.judgement(judged)))
    judged.write_text("[fault.SKEWED]\nprobability = 'remote'\n")
    with pytest.raises(ValueError, match=r"fault\.SKEWED: no row"):
        risk.rows({}, [], risk.judgement(judged))
    for wrong in ("kind = 'x'", "severity = 3", f"severity = '{'x' * 61}'"):
        judged.write_text(f"[fault.SKEW]\n{wrong}\n")
        with pytest.raises(ValueError, match=r"severity|kind"):
            risk.judgement(judged)
