"""The pages that are made of tables and of evidence are what these make of them."""

import json
from pathlib import Path

import pytest
import safety_pages
from fault_matrix.cases import MATRIX

from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.safety.operating_state import ROWS, Refusal
from tormagd.scenes.scene import load_scene

RECORD = json.loads(safety_pages.EVIDENCE.read_text(encoding="utf-8"))
CELLS = RECORD["figures"]["cells"]


@pytest.mark.parametrize(
    ("page", "expected"),
    [(safety_pages.STATES, safety_pages.states_page()), (safety_pages.MATRIX, safety_pages.matrix_page(RECORD))],
    ids=["of the tables", "of the evidence"],
)
def test_a_page_is_that_of_what_it_is_made_of(page: Path, expected: str) -> None:
    assert page.read_text(encoding="utf-8") == expected, "python tools/safety_pages.py writes it anew"


def test_the_page_of_states_has_every_code_and_every_event() -> None:
    page = safety_pages.states_page()
    for code, row in (*FAULTS.items(), *LIMITS.items()):
        assert f"| `{code}` | {row.cause} | {row.reaction} |" in page
    assert [code for code in (*Fault, *Limit) if f"`{code}`" not in page] == []
    for transition in ROWS:
        if not isinstance(transition, Refusal):
            assert f"    {transition.source} --> {transition.target}: " in page


def test_the_evidence_is_of_the_matrix_that_there_is() -> None:
    """A row that came, went or changed what is stated of it takes `python tools/evidence.py faults`."""
    expected = {(item.name, bus): item for item in MATRIX for bus in item.buses}
    known = {(cell["fault"], cell["bus"]): cell for cell in CELLS}
    assert set(known) == set(expected)
    for place, item in expected.items():
        cell = known[place]
        assert (cell["expected"], cell["excitation"], tuple(cell["must_be_named"])) == (
            item.safe,
            item.excitation,
            item.names,
        )


@pytest.mark.parametrize("verdict", ["named", "safe", "in_time", "recovered"])
def test_every_cell_of_the_evidence_held(verdict: str) -> None:
    assert [f"{cell['fault']} on {cell['bus']}" for cell in CELLS if not cell[verdict]] == []


def test_no_cell_loses_a_force_faster_than_the_scene_allows() -> None:
    assert max(cell["loss_N_s"] for cell in CELLS) <= load_scene("coronary").force.most_release_N_s


def test_what_is_seen_at_once_is_stated_so() -> None:
    """50 ms and one tick for wire and host, 100 ms for what is visible at once; the others say what they take."""
    for fault in (Fault.LINK_LOST, Fault.HOST_STALL, Fault.DEVICE_COMMAND_TIMEOUT):
        assert FAULTS[fault].safe_ms == 51.0
    late = [code for code, row in FAULTS.items() if row.safe_ms > 100.0 and row.shows.startswith("at once")]
    assert late == [Fault.SENSE_STALE, Fault.STATUS_STALE], "streams that are missed after 100 ms of nothing"
